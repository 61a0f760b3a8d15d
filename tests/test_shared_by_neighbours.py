"""A course that neighbouring rows share and a bent model does not have is no noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from casest import Residual, Run, cos, exp, model, param, quantity, signal
from casest.diagnose.loop import close


@model
def ringing(
    t=signal("s"),
    x=signal("V"),
    *,
    rest=param("V", start=0.5),
    size=param("V", start=0.2),
    phase=param("rad", start=0.0),
    rate=param("rad/s", start=1.0),
    decay=param("1/s", start=0.01),
):
    """A balance that rings down."""
    wave = rest + size * exp(-decay * t) * cos(rate * t + phase)
    return Residual(measured=x, predicted=quantity("ringing", wave, "V"))


def in_a_draught(t, force, seed):
    """A damped mass on a spring that air moves at random, step by step as it is exactly."""
    step, rng = t[1] - t[0], np.random.default_rng(seed)
    onward = expm(np.array([[0.0, 1.0], [-(1.01**2), -0.2]]) * step)
    y, found = np.zeros(2), np.empty(len(t))
    for k in range(len(t)):
        found[k] = y[0]
        y = onward @ y + np.array([0.0, force * np.sqrt(step)]) * rng.standard_normal()
    return found


T = np.arange(0, 100, 0.14)
WAVE = 0.55 + 0.2 * np.exp(-0.004 * T) * np.cos(1.01 * T + 0.3)


def recorded(x):
    columns = {"t": T[:, None], "x": x[:, None]}
    return [Run.raw("ring", columns, units={"t": "s", "x": "V"}, time=T)]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_balance_in_a_draught_is_not_adequate(seed):
    """It swings by 0.05 V for another reason; readings are good to 0.002 V."""
    noise = 0.002 * np.random.default_rng(seed).standard_normal(len(T))
    closing = close(ringing, recorded(WAVE + in_a_draught(T, 0.04, seed) + noise))
    assert closing.verdict == "unexplained"
    assert "between rows with nearly the same inputs" in closing.misfit.where


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
def test_noise_that_neighbours_share_for_five_samples_is_noise(seed):
    """A wave below noise that remembers as exp(−k/5): neighbours share nine tenths of that too."""
    rng, kin = np.random.default_rng(seed), np.exp(-1 / 5)
    noise = lfilter([np.sqrt(1 - kin**2)], [1, -kin], rng.standard_normal(len(T) + 200))[200:]
    closing = close(ringing, recorded(WAVE + 0.1 * noise))
    assert closing.after.evidence.misfit  # by neighbours alone it would be one
    assert closing.verdict == "adequate"
