"""A recorded input has noise of its own: what only that noise shows is no cause.

The slopes are taken at the inputs as they were recorded. On a ramp at an even pace time tells the
reference better than a noisy meter did, and a cause that follows time would explain the meter.
"""

from __future__ import annotations

import numpy as np
import pytest

from casest import close

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
