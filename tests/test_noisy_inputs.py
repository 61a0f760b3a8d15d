"""A recorded input has noise of its own: what only that noise shows is no cause.

The slopes are taken at the inputs as they were recorded. On a ramp at an even pace time tells the
reference better than a noisy meter did, and a cause that follows time would explain the meter.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from casest import Residual, calibrate, close, model, param, quantity, signal
from casest.effects import low_pass, signal_lag

GAIN, OFFSET = 3.0, 0.2


def course(kind, rows):
    k = np.arange(rows)
    return k * 10 / rows if kind == "ramp" else 5 + 5 * np.sin(12 * k / rows)


def bench(seed, kind, rows, added=0.0):
    """A straight line whose reference is known to 0.01, and its reading to 0.005."""
    rng = np.random.default_rng([20261123, seed])
    x = course(kind, rows)
    return {
        "t": np.arange(rows, dtype=float),
        "reference": x + rng.normal(0, 0.01, rows),
        "reading": OFFSET + GAIN * x + added + rng.normal(0, 0.005, rows),
    }


@pytest.mark.parametrize(
    ("kind", "rows", "records"),
    [
        ("ramp", 15, 2),
        ("ramp", 600, 2),
        ("sine", 600, 1),
        pytest.param("ramp", 15, 8, marks=pytest.mark.long),
        pytest.param("ramp", 30, 8, marks=pytest.mark.long),
        pytest.param("ramp", 60, 8, marks=pytest.mark.long),
        pytest.param("ramp", 600, 8, marks=pytest.mark.long),
        pytest.param("sine", 600, 8, marks=pytest.mark.long),
    ],
)
def test_noise_of_the_reference_is_no_cause(kind, rows, records):
    """Before, bias_drift was named on every ramp, a lag and a low pass on the sine."""
    for seed in range(records):
        closing = close("linear", bench(seed, kind, rows))
        assert not closing.effects
        assert closing.after.values["gain"] == pytest.approx(GAIN, rel=0.01)


@pytest.mark.parametrize("seed", [5000, 5009])
def test_a_long_lag_that_averages_noise_is_no_cause(seed):
    """Half a sample late is the mean of two readings, of half the noise; on a ramp any lag fits."""
    assert close("linear", bench(seed, "ramp", 60)).result.verdict == "adequate"


@pytest.mark.long
def test_what_is_more_than_that_noise_is_found():
    drift = 0.001 * np.arange(600)
    closing = close("linear", bench(7, "sine", 600, drift))
    assert [e.candidate.label for e in closing.effects] == ["bias_drift"]
    assert closing.after.values["bias_drift.k"] == pytest.approx(0.001, rel=0.05)


@pytest.mark.parametrize("rows", [15, 60])
def test_noise_of_the_resistance_is_no_cause(rows):
    """A thermistor in a bath that warms at an even pace: either of the two may be the noisy one."""
    T = 283.15 + 60 * np.arange(rows) / rows
    for noisy in ("resistance", "temperature"):
        rng = np.random.default_rng([rows, len(noisy)])
        R = 1e4 * np.exp(3950 * (1 / T - 1 / 298.15))
        met = T.copy()
        if noisy == "resistance":
            R *= 1 + rng.normal(0, 2e-3, rows)
        else:
            met += rng.normal(0, 0.04, rows)
        given = {"t": np.arange(rows, dtype=float), "resistance": R, "temperature": met}
        assert close("thermistor-beta", given).result.verdict == "adequate"


@model
def two(cell=signal(1, "count"), ref=signal(1, "count"), *, gain=param(), offset=param(1, "count")):
    return Residual(measured=cell, predicted=quantity("p", gain * ref + offset, "count"))


def cells(seed, lag=0.0, rows=900):
    """A load that is held, taken off for a while, and swings; two cells of one noise each."""

    def load(t):
        amplitude = np.where((t > 15) & (t < 70), 600 * np.exp(-(t - 15) / 25), 0.0)
        off = 4000 * (np.tanh(2 * (t - 4)) - np.tanh(2 * (t - 12)))
        return 9000 + amplitude * np.cos(4.4 * (t - 15)) - off

    rng, t = np.random.default_rng([20261127, seed]), 0.1 * np.arange(rows)
    ref, cell = load(t), 1000 + 0.9 * load(t - lag)
    return {
        "t": t,
        "ref": np.round(ref + rng.normal(0, 75, rows)),
        "cell": np.round(cell + rng.normal(0, 75, rows)),
    }


@pytest.mark.parametrize("noise", [None, {"ref": 75, "cell": 75}])
@pytest.mark.parametrize("seed", [0, 1, pytest.param(2, marks=pytest.mark.long)])
def test_noise_of_a_reference_that_is_held_is_no_misfit(seed, noise):
    """In the order of its readings the residual falls within each level, and a play of a width like
    the noise takes that noise away: before, hysteresis with p = 2e-29, or a course over `p`."""
    closing = close(two, cells(seed), sensor_noise=noise)
    assert closing.result.verdict == "adequate"
    if noise is None:
        asked = close(two, cells(seed), known={"hysteresis"})
        assert asked.result.verdict == "adequate"
        assert "noise of the inputs" in {s.name: s.reason for s in asked.refused}["hysteresis"]


@pytest.mark.parametrize(
    ("effect", "on"),
    [(signal_lag, "ref"), (low_pass, "p")],
    ids=lambda e: getattr(e, "name", ""),
)
def test_stated_noise_of_an_input_counts_once_beside_a_memory(effect, on):
    """Chi-square of a right model, with what is not there beside it; before, 1716 of 897
    beside the low pass."""
    found = calibrate(
        two.with_effect(effect, on=on), cells(3), sensor_noise={"ref": 75, "cell": 75}
    ).noise.chi_square
    assert 0.001 < chi2.cdf(found.value, found.degrees_of_freedom) < 0.999


@pytest.mark.long
@pytest.mark.parametrize("noise", [None, {"ref": 75, "cell": 75}])
def test_a_lag_is_found_whether_the_noise_of_its_input_is_stated_or_not(noise):
    """Before, "too uncertain for its intervals": its cost is no parabola, since a signal that was
    taken between two samples has less noise than either. That also draws it by a part of a sample.
    """
    closing = close(two, cells(3, 1.0), sensor_noise=noise)
    assert [e.candidate.label for e in closing.effects] == ["signal_lag(ref)"]
    assert closing.result.verdict == "extended"
    assert closing.after.values["signal_lag(ref).delay"] == pytest.approx(1.0, abs=0.025)
    assert closing.after.values["gain"] == pytest.approx(0.9, abs=0.006)
