"""Levels that are read many times: what lies between them, and what rounding makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from casest import calibrate
from casest.diagnose.misfit.left import doubts


def said(level, read, wave=0.0, noise=0.6, seed=0, decimals=0):
    """What is said of a line through readings at so many levels, in blocks."""
    rng = np.random.default_rng([20261127, level, read, seed])
    x = np.repeat(np.arange(level, dtype=float), read)
    y = 10 + 7 * x + wave * np.cos(np.pi * x) + noise * rng.standard_normal(len(x))
    found = calibrate("linear", {"reference": x, "reading": np.round(y, decimals)})
    return [f.where for f in doubts(found) or () if "between positions" in f.where]


@pytest.mark.parametrize(("level", "read", "noise"), [(3, 300, 0.6), (8, 300, 0.6), (4, 100, 0.3)])
def test_rounding_is_no_misfit_between_levels(level, read, noise):
    """Most readings are one step's then, and what is a step off is not far out. Before, in five of
    these six records of eight levels."""
    assert sum(bool(said(level, read, noise=noise, seed=seed)) for seed in range(6)) == 0


@pytest.mark.parametrize(("level", "read"), [(3, 300), (4, 30), (6, 31)])
def test_a_few_levels_show_a_lack_of_fit(level, read):
    """Each is off by a standard deviation, one up and one down. Before, of fewer than seven levels
    nothing was said."""
    assert said(level, read, wave=0.6, decimals=4)
    assert not said(level, read, decimals=4)
