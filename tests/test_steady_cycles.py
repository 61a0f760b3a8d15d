"""Friction in steady strokes: to a likelihood lines are noise however large, to what is held out
they are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from casest import close

pytestmark = pytest.mark.long
FRICTION, GAIN, GIVES = 6.45, 0.15, 0.5


def strokes(rng, count):
    """An actuator to and fro, 25 mm at 0.494 Hz: a spring, friction that gives way over half a
    millimetre (P. Dahl, 1968), and noise with a memory of 0.3 s."""
    t = 0.01 * np.arange(count)
    turns = (0.494 * t + 0.1) % 1
    x = gaussian_filter1d(12.5 * (2 - 2 * np.abs(2 * turns - 1)), 20)
    given = np.zeros(count)
    for k in range(1, count):
        given[k] = np.clip(given[k - 1] + x[k] - x[k - 1], -GIVES, GIVES)
    noise = 0.05 * rng.standard_normal(count)
    wander = gaussian_filter1d(rng.standard_normal(count), 15) * np.sqrt(2 * np.sqrt(np.pi) * 15)
    y = 50 + GAIN * x + FRICTION * given / GIVES + noise + 0.8 * wander
    return np.column_stack([t, np.round(x, 3), y])


@pytest.mark.parametrize("seed", [2, 3])
def test_friction_comes_before_a_lag_that_leaves_more_of_what_is_held_out(tmp_path, seed):
    """A lag of a fifth of a stroke, and a gain six times too large, were likelier: a public bench
    record of an actuator (studies/strangers.md)."""
    path = tmp_path / "strokes.csv"
    np.savetxt(path, strokes(np.random.default_rng(seed), 5800), delimiter=",",
               header="t [s],reference [mm],reading [N]", comments="", fmt="%.5f")  # fmt: skip
    found = close("linear", path)
    assert found.effects[0].candidate.label == "hysteresis"
    gain, std = float(found.after.values["gain"]), float(found.after.std["gain"])
    assert gain == pytest.approx(GAIN, abs=3 * std)
    assert std < 0.02
    errors = np.concatenate([r.ravel() for r in found.after_held_out])
    assert np.sqrt(np.nanmean(errors**2)) < 1.0
