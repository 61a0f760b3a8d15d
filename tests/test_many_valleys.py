"""Many sensors, each in its right valley: found as for one alone, the rest left together."""

from __future__ import annotations

import numpy as np
import pytest

from casest import Residual, Run, attempt, calibrate_many, exp, inf, model, param, signal, sin
from casest.declaration.shapes import Array
from casest.estimate.reasons import CORRELATED
from casest.fleet.neighbours import scatters
from casest.fleet.sums import Sensors
from casest.leastsquares.neighbours import scatter
from casest.leastsquares.problem import Problem


@model
def sine(x=signal(), y=signal(), *, w=param(start=1.0), p=param()):
    return Residual(measured=y, predicted=sin(w * x + p))


@model
def peak(
    x=signal(),
    y=signal(),
    *,
    height=param(start=1.0),
    place=param(start=0.0),
    width=param(start=1.0, bounds=(0.0, inf)),
):
    return Residual(measured=y, predicted=height * exp(-0.5 * ((x - place) / width) ** 2))


@model
def bent(x=signal(), z=signal(), y=signal(2), *, a=param(start=1.0), b=param(2), c=param()):
    return Residual(measured=y, predicted=exp(a * x) + b * z + c)


def waves(w, n=80, noise=0.05, p=0.5, seed=0):
    """Readings of sines, each sensor at times of its own, (S, n) each."""
    rng = np.random.default_rng(seed)
    x = np.sort(rng.uniform(0, 10, (len(w), n)), axis=1)
    y = np.sin(np.asarray(w)[:, None] * x + p) + noise * rng.standard_normal(x.shape)
    return {"x": x, "y": y}


def record(signals, i, count=None):
    columns = {n: v[i, :count].reshape(len(v[i, :count]), -1) for n, v in signals.items()}
    return Run.raw("one", columns, units={})


# -- found -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_frequencies_far_from_the_start_are_found():
    w = np.array([4.2, 13.5])
    found = calibrate_many(sine, waves(w), noise=0.05)
    assert found.trusted.all(), str(found)
    assert np.all(np.abs(found.values["w"] - w) < 5 * found.std["w"])


@pytest.mark.long
def test_what_is_calibrated_alone_is_what_one_calibration_gives():
    signals = waves([9.0])
    found = calibrate_many(sine, signals)
    one = attempt(sine, [record(signals, 0)])
    for name in ("w", "p"):
        assert found.values[name][0] == one.values[name]
        assert found.std[name][0] == one.std[name]
    assert found.reasons[0] == one.certificate.reasons


@pytest.mark.long
def test_a_start_of_ones_own_is_kept_where_a_sensor_is_calibrated_alone():
    """On even rows 5 and 5 + 16π cannot be told apart: the start says which is meant."""
    x = np.tile(np.linspace(0, 10, 81), (2, 1))
    y = np.sin(5 * x + 0.5) + 0.05 * np.random.default_rng(1).standard_normal(x.shape)
    start = {"w": np.array([5.0, 5 + 16 * np.pi + 0.3]), "p": 0.0}
    found = calibrate_many(sine, {"x": x, "y": y}, start=start)
    assert found.trusted.all(), str(found)
    assert found.values["w"][1] - found.values["w"][0] == pytest.approx(16 * np.pi, abs=0.05)


@pytest.mark.long
def test_the_slowest_of_rates_that_fit_alike_is_given_unless_a_start_says_otherwise():
    x = np.linspace(0, 10, 101)[None]
    y = np.sin(2 * x + 0.5) + 0.05 * np.random.default_rng(1).standard_normal(x.shape)
    fast = sine.having(w=param(start=2 + 20 * np.pi), p=param(start=0.5))
    found = calibrate_many(fast, {"x": x, "y": y})
    assert found.values["w"][0] == pytest.approx(2, abs=0.02)


@pytest.mark.long
def test_bounds_of_a_sensors_own_hold_where_it_is_calibrated_alone():
    rng = np.random.default_rng(0)
    x = np.tile(np.linspace(0, 10, 120), (2, 1))
    hills = [2 * np.exp(-0.5 * ((x - c) / 0.3) ** 2) for c in (4.0, 8.0)]
    y = hills[0] + hills[1] + 0.05 * rng.standard_normal(x.shape)
    place = np.zeros(2), np.array([-1.0, 6.0]), np.array([6.0, 11.0])
    found = calibrate_many(peak, {"x": x, "y": y}, start={"place": place})
    for i, (low, high) in enumerate(zip(*place[1:], strict=True)):
        assert not found.trusted[i] or low <= found.values["place"][i] <= high


# -- what only many are asked is asked again -------------------------------------------------------


def test_a_sensor_that_is_found_alone_and_is_too_noisy_is_refused():
    found = calibrate_many(sine, waves([9.0], noise=0.2), noise=0.05)
    assert not found.trusted.any()
    assert all("larger than the noise=" in reasons[0] for reasons in found.reasons)


def test_a_sensor_that_is_found_alone_and_has_alike_neighbours_is_refused():
    """Beside a level that is not declared: less than noise to the search, not to neighbours."""
    signals = waves([9.0], n=200)
    found = calibrate_many(sine, {**signals, "y": signals["y"] + 0.06})
    assert found.reasons[0] == (CORRELATED,)


def test_few_samples_among_many_that_do_not_count_are_no_time_series():
    """Ninety readings of a slow wave beside a line: fewer than a hundred are not asked."""

    @model
    def line(x=signal(), y=signal(), *, slope=param(), level=param()):
        return Residual(measured=y, predicted=level + slope * x)

    x = np.tile(np.linspace(0, 1, 400), (2, 1))
    y = 1 + 2 * x + 0.1 * np.sin(40 * x)
    found = calibrate_many(line, {"x": x, "y": y}, counts=np.array([90, 400]))
    assert list(found.trusted) == [True, False]


# -- left together ---------------------------------------------------------------------------------


@model
def decay(x=signal(), y=signal(), *, size=param(start=1.0), rate=param(start=0.2)):
    return Residual(measured=y, predicted=size * exp(-rate * x))


def decays(count, noise=0.02, n=60, seed=4):
    rng = np.random.default_rng(seed)
    x, rate = rng.uniform(0, 10, (count, n)), rng.uniform(0.2, 0.6, (count, 1))
    return {"x": x, "y": 2 * np.exp(-rate * x) + noise * rng.standard_normal(x.shape)}


def test_sensors_whose_rows_vouch_for_them_stay_together():
    found = calibrate_many(decay, decays(200))
    assert found.trusted.all()
    # as large by accident as one of a hundred, or half as large again
    assert len(found.reasons.replaced) <= 8


def test_a_sensor_calibrated_alone_moves_no_digit_of_the_others():
    signals = decays(40)
    signals["y"][7] += np.sin(9 * signals["x"][7])
    mixed = calibrate_many(decay, signals)
    others = np.delete(np.arange(40), 7)
    kept = calibrate_many(decay, {n: v[others] for n, v in signals.items()})
    assert 7 in mixed.reasons.replaced
    np.testing.assert_array_equal(mixed.values["rate"][others], kept.values["rate"])
    np.testing.assert_array_equal(mixed.covariance[others], kept.covariance)


# -- the scatter of neighbours, side by side -------------------------------------------------------


def figures(found):
    return [found.neighbours, found.residual, found.spread, found.left, *found.freedom]


def test_the_scatter_of_many_is_that_of_each():
    """Two inputs, two components, one input of a sensor constant, unequal numbers of rows."""
    rng = np.random.default_rng(3)
    x, z = rng.uniform(0, 1, (2, 5, 60))
    z[2] = 0.7
    x[3, ::2] = x[3, 1::2]  # repeated
    y = np.stack([np.exp(1.3 * x) - z, np.exp(1.3 * x) + 2 * z], axis=2)
    signals = {"x": x, "z": z, "y": y + 0.1 * rng.standard_normal(y.shape)}
    counts = np.array([60, 60, 60, 40, 9])
    values: Array = np.tile([[1.2], [-0.9], [2.1], [0.1]], 5)
    samples = np.concatenate([v.reshape(5, 60, -1) for v in signals.values()], axis=2)
    mask = (np.arange(60)[:, None] < counts).astype(float)
    problems = [Problem(bent, (record(signals, i, n),)) for i, n in enumerate(counts)]
    own = {"a": 1.2, "b": [-0.9, 2.1], "c": 0.1}
    costs = np.array([p.cost(p.point(own)) for p in problems])
    sensors = Sensors(np.ascontiguousarray(samples.transpose(2, 1, 0)), mask)
    for problem, found in zip(problems, scatters(bent, values, costs, sensors), strict=True):
        one = scatter(problem, problem.point(own))
        assert (one is None) == (found is None)
        if one is not None and found is not None:
            np.testing.assert_allclose(figures(found), figures(one), rtol=1e-9)
