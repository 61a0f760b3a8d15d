"""What could be wrong without showing: of a size that a sensor of that range may have."""

from __future__ import annotations

import numpy as np
import pytest

import casest
from casest.diagnose.detectability import invisible


def closed(counts_per_kg: float) -> dict[str, dict[str, float]]:
    """Counts of a scale, far from zero, as reference: shifts by a hidden effect, in kg of 30."""
    rng = np.random.default_rng(7)
    kg = np.tile(np.linspace(2.0, 20.0, 40), 5)
    counts = counts_per_kg * (10 + kg + 0.02 * rng.standard_normal(len(kg)))
    own = {"t": 0.1 * np.arange(len(kg)), "reference": counts, "reading": kg}
    found = casest.close("linear", own)
    top = {"offset": 1.0, "gain": 30.0 * counts_per_kg}
    return {i.name: {n: v * top[n] for n, v in i.would_move.items()} for i in invisible(found)}


def test_a_bend_that_cannot_be_seen_is_a_share_of_the_range_in_any_unit() -> None:
    small, large = closed(1.0), closed(4.1e5)
    names = {"quadratic", "signed_quadratic", "cubic", "signed_cubic"}
    assert names & set(small) == names & set(large) == {"signed_quadratic"}
    moved = small["signed_quadratic"]
    assert large["signed_quadratic"] == pytest.approx(moved, rel=0.02)
    assert max(moved.values()) < 0.3
