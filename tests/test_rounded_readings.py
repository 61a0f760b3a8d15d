"""Rounding is no noise: it hangs on the input, and is no effect of anything that does."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_what_rounding_leaves_of_a_slow_input_is_no_effect(seed):
    """A load cell of a public record, read to whole millivolts: a dead band was found of 0.1."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(1200)
    load = 1.5 * (1 - np.cos(2 * np.pi * t / 6 + rng.uniform(0, 6)))
    read = np.round(2531.3 - 3.76 * load + 0.03 * rng.standard_normal(t.size))
    assert close("load-cell", {"load": load, "reading": read}).verdict == "adequate"


@pytest.mark.long
def test_what_moves_a_rounded_reading_by_a_step_is_found():
    rng, t = np.random.default_rng(0), 0.01 * np.arange(1200)
    load, warm = 1.5 * (1 - np.cos(2 * np.pi * t / 6)), 20 + 3 * np.sin(2 * np.pi * t / 7)
    read = np.round(2531.3 - 3.76 * load + 0.4 * (warm - 20) + 0.03 * rng.standard_normal(t.size))
    closing = close("load-cell", {"load": load, "reading": read, "temperature": warm})
    assert [e.candidate.label for e in closing.effects] == ["temperature_bias(temperature)"]
