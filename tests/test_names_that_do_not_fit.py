"""What a refit found goes by another name: a kink in a smooth bend, a pulse that begins with the
record."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close
from casest.diagnose.closing import Closing

N, STEP = 600, 0.1


def moved(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    """A generator, times, and a slow course through a range of ±2."""
    rng, t = np.random.default_rng(seed), STEP * np.arange(N)
    return rng, t, np.sin(0.9 * t) + np.sin(0.37 * t + 1)


def named(found: Closing) -> list[str]:
    return [e.candidate.label for e in found.effects]


@pytest.mark.parametrize("seed", range(3))
def test_a_smooth_bend_is_no_kink(seed):
    """Force on a pad that gets stiffer over 3 of 8 mm, from 200 to 2500 N/mm, without a corner."""
    rng, u = np.random.default_rng(seed), np.linspace(0, 8, 480)
    y = 200 * u + 2300 * np.log1p(np.exp(1.5 * (u - 4))) / 1.5 + 30 * rng.standard_normal(480)
    found = close("linear", {"reference": u, "reading": y})
    assert not {"floor", "saturation", "dead_band", "dead_zone"} & set(named(found))
    assert found.verdict == "unexplained"


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_kink_is_one(seed):
    rng, t, u = moved(seed)
    y = np.maximum(u, -0.7) + 0.02 * rng.standard_normal(N)
    assert named(close("linear", {"t": t, "reference": u, "reading": y})) == ["floor"]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_shift_up_to_a_moment_is_a_step(seed):
    """Whatever else the first row does."""
    rng, t, u = moved(seed)
    y = 2 * u + 0.3 * (t > 35) + 0.05 * rng.standard_normal(N)
    y[0] += 0.4
    found = close("linear", {"t": t, "reference": u, "reading": y})
    assert "pulse" not in named(found)
    assert "bias_step" in named(found)
