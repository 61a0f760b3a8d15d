"""A filter that is given one sample after the other says what it says of the whole record."""

from __future__ import annotations

import flights
import numpy as np
import pytest
from test_dynamics import turning_gravity

from casest import DataError, Run, UsageError
from casest.dynamics import Estimator, filtered
from casest_problems.bias_gravity import bias_gravity, bias_gravity_magnitude

STEP = 0.02


def record(names, count=120):
    t = STEP * np.arange(count)
    run = flights.record(flights.in_the_air(), t, np.random.default_rng(0))
    signals = {name: run.signals[name] for name in names}
    if "v" in signals:
        signals["v"][50:60] = np.nan
        signals["v"][70, 1] = np.nan
    return Run.raw("flight", signals, units={}, time=t)


AS_READ = pytest.mark.xfail(
    strict=True,
    reason="filtered takes A at an estimate of the rate by the whole record, Estimator at the "
    "reading: what of it is noise only the record tells",
)


@pytest.mark.parametrize("model", [
    bias_gravity, bias_gravity_magnitude, bias_gravity.sensing(a=1e-8),
    pytest.param(bias_gravity.sensing(omega=1e-8, a=1e-8), marks=AS_READ),
    turning_gravity, pytest.param(turning_gravity.sensing(omega=1e-8), marks=AS_READ),
], ids=[
    "linear", "known", "noisy inputs", "noisy rates", "nonlinear", "nonlinear and noisy",
])  # fmt: skip
def test_step_by_step_it_is_the_filter_of_the_record(model):
    run = record([s.name for s in model.signals])
    whole, estimator = filtered(model, run, smooth=False), Estimator(model, STEP)
    for k, t in enumerate(run.time):
        now = estimator.step({name: own[k] for name, own in run.signals.items()}, t)
        np.testing.assert_allclose(now.x, whole.x[k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(now.std, whole.std[k], rtol=1e-9)
    np.testing.assert_array_equal(
        now[model.states[0].name], now.x[model.slices()[model.states[0].name]]
    )


def test_a_gap_is_one_online_too():
    run = record(["a", "omega", "v"])
    time = run.time.copy()
    time[40:] += 3.0
    run = Run.raw("flight", run.signals, units={}, time=time)
    whole, estimator = filtered(bias_gravity, run, smooth=False), Estimator(bias_gravity, STEP)
    for k, t in enumerate(run.time):
        now = estimator.step({name: own[k] for name, own in run.signals.items()}, t)
    np.testing.assert_allclose(now.std, whole.std[-1], rtol=1e-9)


@pytest.mark.parametrize(("sample", "words"), [
    ({"w": 1}, "has no signal 'w'; it has a, omega, v"),
    ({"v": [1, 2]}, "v has 3 numbers, not 2"),
])  # fmt: skip
def test_what_is_no_sample_is_named(sample, words):
    with pytest.raises(UsageError, match=words):
        Estimator(bias_gravity, STEP).step(sample, 0.0)


def test_time_goes_on_and_inputs_are_there():
    estimator, sample = Estimator(bias_gravity, STEP), {"a": np.zeros(3), "omega": np.zeros(3)}
    estimator.step(sample, 1.0)
    with pytest.raises(DataError, match="time repeats"):
        estimator.step(sample, 1.0)
    with pytest.raises(DataError, match="input omega is missing"):
        estimator.step({"a": np.zeros(3)}, 1.1)
    assert np.isfinite(estimator.step(sample, 1.2).x).all()


def test_a_period_is_positive():
    with pytest.raises(UsageError, match="the period 0 s must be positive and finite"):
        Estimator(bias_gravity, 0)
