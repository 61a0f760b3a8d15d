"""Many sensors at once: what one calibration gives, for each of them, and none disturbs another."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import simulators as sim

from casest import (
    DataError,
    Residual,
    Run,
    UsageError,
    attempt,
    calibrate_many,
    exp,
    model,
    param,
    signal,
    unit_vector,
)
from casest.results.find import find_model
from casest_problems.norm import automatic_start, closed_form_many, norm_diagonal, norm_triangular

NORM = norm_triangular.having(norm=sim.GRAVITY)
MODELS = Path(__file__).parent / "models"


def recorded(v):
    return (Run.raw("one", {"v": v}, units={"v": "m/s^2"}),)


def flat(scale, offset):
    rows, columns = np.tril_indices(3)
    return np.concatenate([scale[..., rows, columns], offset], axis=-1)


def line(count, seed, poses=24, sigma=0.01):
    """Readings (S, N, 3) of a production line, with the true unknowns (S, 9)."""
    rng = np.random.default_rng(seed)
    sensors = [sim.accelerometer(rng) for _ in range(count)]
    v = [s.read(sim.spread_poses(poses, rng), sigma, rng) for s in sensors]
    return np.array(v), np.array([flat(s.scale, s.b) for s in sensors])


def bad_ones():
    """A reading missing, poses in a plane, nothing but zeros, one pose only: each by its name."""
    rng, (good, _) = np.random.default_rng(8), line(5, 7)
    good[0, 3, 1] = np.nan
    good[1] = sim.accelerometer(rng).read(sim.ring(24, rng), 0.01, rng)
    good[2] = 0.0
    good[3] = good[3, :1]
    good[4] = sim.accelerometer(rng).read(sim.cap(24, rng), 0.01, rng)
    return dict(zip(("missing", "ring", "zeros", "one pose", "cap"), good, strict=True))


# -- the same as one by one ------------------------------------------------------------------------


@cache
def fifty():
    v, _ = line(50, 1)
    return v, [attempt(NORM, recorded(own)) for own in v]


@pytest.mark.parametrize("start", [closed_form_many, None, {"scale": 0.9, "offset": 0.1}])
def test_values_and_spread_are_those_of_one_calibration(start):
    v, alone = fifty()
    found = calibrate_many(NORM, {"v": v}, start=start)
    assert found.trusted.all()
    for i, one in enumerate(alone):
        assert one.certificate.trusted
        std = np.sqrt(np.diag(one.covariance))
        away = (flat(found.values["scale"][i], found.values["offset"][i]) - one.point.x) / std
        assert np.abs(away).max() < 1e-6
        correlations = (found.covariance[i] - one.covariance) / np.outer(std, std)
        assert np.abs(correlations).max() < 1e-4
        np.testing.assert_allclose(found.std["offset"][i], one.std["offset"], rtol=1e-4)
        assert found.sigma[i] == pytest.approx(one.noise.sigma, rel=1e-9)
        assert found.rmse[i] == pytest.approx(one.rmse, rel=1e-9)


def test_a_shipped_model_knows_where_many_sensors_start():
    v, _ = line(40, 3)
    found = calibrate_many(NORM, {"v": v})
    told = calibrate_many(NORM.starting(automatic_start), {"v": v}, start=closed_form_many)
    np.testing.assert_array_equal(found.values["scale"], told.values["scale"])
    plain = calibrate_many(NORM.starting(automatic_start), {"v": v})
    away = (found.values["offset"] - plain.values["offset"]) / found.std["offset"]
    assert np.abs(away).max() < 1e-5
    assert found.trusted.all()


@pytest.mark.long
def test_the_verdict_is_that_of_one_calibration():
    rng, records = np.random.default_rng(3), []
    directions = [
        *(sim.spread_poses(24, rng) for _ in range(4)),
        sim.ring(24, rng),
        *(sim.cap(24, rng, a) for a in np.radians([45, 70, 90, 120])),
        np.resize(sim.spread_poses(8, rng), (24, 3)),
    ]
    for k, poses in enumerate(directions):
        sigma = (0.003, 0.01, 0.03, 0.3)[k % 4]
        records.append(sim.accelerometer(rng).read(poses, sigma, rng))
    records.append(bad_ones()["one pose"])
    records.append(np.clip(records[0], -6.0, 6.0))  # saturated
    found = calibrate_many(NORM, {"v": np.array(records)}, start=closed_form_many)
    alone = [attempt(NORM, recorded(own)).certificate for own in records]
    differ = [
        (i, found.reasons[i], one.reasons)
        for i, one in enumerate(alone)
        if one.trusted != found.trusted[i]
    ]
    assert differ == []
    assert 0 < found.trusted.sum() < len(records)


def test_few_poses_are_refused_by_what_they_lack():
    v, _ = line(3, 5, poses=9)
    assert "no redundancy" in calibrate_many(NORM, {"v": v}).reasons[0][0]


# -- truth -----------------------------------------------------------------------------------------


def test_intervals_hold_the_truth_as_often_as_they_say():
    from scipy.stats import t

    v, truth = line(5000, 2)
    found = calibrate_many(NORM, {"v": v}, start=closed_form_many)
    assert found.trusted.mean() > 0.999
    away = flat(found.values["scale"], found.values["offset"]) - truth
    width = t.ppf(0.975, 24 - 9) * flat(found.std["scale"], found.std["offset"])
    inside = np.abs(away) <= width
    assert 0.94 < inside[found.trusted].mean() < 0.96


@pytest.mark.long
def test_what_is_trusted_is_near_the_truth_however_poor_the_poses():
    from scipy.stats import t

    rng, records, truth = np.random.default_rng(4), [], []
    for k in range(800):
        sensor = sim.accelerometer(rng)
        poses = sim.cap(24, rng, np.radians(rng.uniform(5, 180))) if k % 2 else sim.ring(24, rng)
        records.append(sensor.read(poses, 10 ** rng.uniform(-3, -1), rng))
        truth.append(flat(sensor.scale, sensor.b))
    found = calibrate_many(NORM, {"v": np.array(records)}, start=closed_form_many)
    away = np.abs(flat(found.values["scale"], found.values["offset"]) - truth)
    far = away / flat(found.std["scale"], found.std["offset"]) > t.isf(5e-5, 15)
    assert 100 < found.trusted.sum() < 700
    # 9 unknowns at a probability of 1e-4 each
    assert far[found.trusted].any(axis=1).mean() < 0.01


# -- each on its own -------------------------------------------------------------------------------


def numbers(found, i):
    parts = [
        found.covariance[i],
        found.sigma[i],
        found.rmse[i],
        *(x[i] for x in found.values.values()),
    ]
    return b"".join(np.asarray(p).tobytes() for p in parts)


@pytest.mark.parametrize("start", [closed_form_many, None])
def test_a_bad_sensor_is_refused_alone_and_moves_no_digit_of_the_others(start):
    v, _ = line(70, 6)
    bad = list(bad_ones().values())
    mixed = np.concatenate([bad[:2], v[:40], bad[2:], v[40:]])
    places = [*range(2, 42), *range(45, 75)]
    found = calibrate_many(NORM, {"v": mixed}, start=start)
    alone = calibrate_many(NORM, {"v": v}, start=start)
    single = calibrate_many(NORM, {"v": v[:1]}, start=start)
    assert alone.trusted.all()
    assert list(np.flatnonzero(found.trusted)) == places
    assert [numbers(found, i) for i in places] == [numbers(alone, k) for k in range(70)]
    assert numbers(single, 0) == numbers(alone, 0)
    assert [found.reasons[i] for i in places] == list(alone.reasons)


def test_the_order_of_the_sensors_moves_no_digit():
    v, _ = line(5000, 9)  # more than are calibrated side by side
    order = np.random.default_rng(0).permutation(len(v))
    found = calibrate_many(NORM, {"v": v}, start=closed_form_many)
    turned = calibrate_many(NORM, {"v": v[order]}, start=closed_form_many)
    assert all(numbers(turned, k) == numbers(found, i) for k, i in enumerate(order))


@pytest.mark.parametrize("far", [slice(None, None, 2), slice(4)])
def test_sensors_that_begin_near_and_far_move_no_digit_of_each_other(far):
    """Few steps lead from a start near the solution, many from one far away."""
    v, _ = line(40, 12)
    told = calibrate_many(NORM, {"v": v})
    start = {name: told.values[name] + 3e-3 * told.std[name] for name in ("scale", "offset")}
    start["offset"][far] += 0.3
    found = calibrate_many(NORM, {"v": v}, start=start)
    assert found.trusted.all()
    for i in (0, 1, 2, 39):
        own = {name: values[i : i + 1] for name, values in start.items()}
        alone = calibrate_many(NORM, {"v": v[i : i + 1]}, start=own)
        for name in start:
            np.testing.assert_array_equal(found.values[name][i], alone.values[name][0])
        np.testing.assert_array_equal(found.covariance[i], alone.covariance[0])
        off = np.abs(found.values["offset"][i] - told.values["offset"][i])
        assert (off / told.std["offset"][i]).max() < 1e-6


def test_a_refused_sensor_has_reasons_in_place_of_numbers():
    bad = bad_ones()
    found = calibrate_many(NORM, {"v": np.array(list(bad.values()))}, start=closed_form_many)
    assert not found.trusted.any()
    assert np.isnan(found.values["scale"]).all()
    assert np.isnan(found.std["offset"]).all()
    assert np.isnan(found.covariance).all()
    said = dict(zip(bad, found.reasons, strict=True))
    assert "sample 3 is not finite" in said["missing"][0]
    assert "not determined" in said["ring"][0]
    assert "not determined" in said["one pose"][0]
    assert "0 of 5 sensors trusted" in str(found)
    assert "sample 3 is not finite" in str(found)


def test_a_sensor_noisier_than_a_sound_one_is_refused():
    v, _ = line(40, 10)
    v[7] += 0.2 * np.random.default_rng(0).standard_normal(v[7].shape)
    found = calibrate_many(NORM, {"v": v}, start=closed_form_many, noise=0.01)
    assert list(np.flatnonzero(~found.trusted)) == [7]
    assert "larger than the noise=" in found.reasons[7][0]


def test_refused_sensors_may_be_tried_again_one_by_one():
    v, _ = line(3, 11)
    start = {"offset": np.array([[0.0, 0, 0], [np.nan] * 3, [0, 0, 0]])}
    assert list(calibrate_many(NORM, {"v": v}, start=start).trusted) == [True, False, True]
    found = calibrate_many(NORM, {"v": v}, start=start, retry=1)
    assert found.trusted.all()
    one = attempt(NORM, recorded(v[1]))
    np.testing.assert_array_equal(found.values["offset"][1], one.values["offset"])
    np.testing.assert_array_equal(found.std["scale"][1], one.std["scale"])


def test_sensors_with_fewer_samples_are_as_if_they_were_alone():
    v, _ = line(6, 12)
    counts = np.array([24, 20, 24, 16, 12, 24])
    full = v.copy()
    for i, count in enumerate(counts):
        full[i, count:] = np.nan
    found = calibrate_many(NORM, {"v": full}, start=closed_form_many, counts=counts)
    assert found.trusted.all()
    for i, count in enumerate(counts):
        one = attempt(NORM, recorded(v[i, :count]))
        away = (found.values["offset"][i] - one.values["offset"]) / one.std["offset"]
        assert np.abs(away).max() < 1e-6
        assert found.sigma[i] == pytest.approx(one.noise.sigma, rel=1e-9)


# -- other models ----------------------------------------------------------------------------------


def test_a_diagonal_scale_and_a_known_one():
    rng = np.random.default_rng(13)
    sensors = [sim.accelerometer(rng, skew=False) for _ in range(20)]
    v = np.array([s.read(sim.spread_poses(12, rng), 0.01, rng) for s in sensors])
    plain = norm_diagonal.having(norm=sim.GRAVITY)
    found = calibrate_many(plain, {"v": v}, start=closed_form_many)
    assert found.trusted.all()
    one = attempt(plain, recorded(v[3]))
    assert np.abs((found.values["scale"][3] - one.values["scale"]) / one.std["scale"]).max() < 1e-6
    known = norm_triangular.having(norm=sim.GRAVITY, scale=np.diag([1.01, 0.99, 1.0]))
    found = calibrate_many(known, {"v": v}, start=closed_form_many)
    one = attempt(known, recorded(v[3]))
    assert found.trusted[3] == one.certificate.trusted
    assert (
        np.abs((found.values["offset"][3] - one.values["offset"]) / one.std["offset"]).max() < 1e-6
    )


def test_a_users_own_explicit_model():
    thermistor = find_model(str(MODELS / "thermistor.py"))
    rng = np.random.default_rng(14)
    reference = 273.15 + rng.uniform(0, 80, (30, 15))
    r25, beta = rng.uniform(9500, 10500, (30, 1)), rng.uniform(3300, 4100, (30, 1))
    ohms = r25 * np.exp(beta * (1 / reference - 1 / 298.15)) + 5.0 * rng.standard_normal((30, 15))
    found = calibrate_many(thermistor, {"resistance": ohms, "reference": reference})
    assert found.trusted.all()
    run = Run.raw(
        "one", {"resistance": ohms[4, :, None], "reference": reference[4, :, None]},
        units={"resistance": "ohm", "reference": "K"},
    )  # fmt: skip
    one = attempt(thermistor, [run])
    for name in ("r25", "beta"):
        assert abs(found.values[name][4] - one.values[name]) < 1e-6 * one.std[name]
    assert np.mean(np.abs(found.values["beta"] - beta[:, 0]) / found.std["beta"] < 3) > 0.9


@model
def straight(x=signal(), y=signal(), *, slope=param(), level=param()):
    return Residual(measured=y, predicted=level + slope * x)


def test_a_line_is_numpys_line_and_noise_free_data_are_no_trouble():
    rng = np.random.default_rng(15)
    x, y = rng.standard_normal((2, 9, 12))
    y[4] = 1 + 2 * x[4]
    found = calibrate_many(straight, {"x": x, "y": y})
    assert found.trusted.all()
    for i in range(9):
        slope, level = np.polyfit(x[i], y[i], 1)
        assert abs(found.values["slope"][i] - slope) < 1e-6 * found.std["slope"][i] + 1e-12
        assert abs(found.values["level"][i] - level) < 1e-6 * found.std["level"][i] + 1e-12


@model
def capped(x=signal(), y=signal(), *, slope=param(start=0.5, bounds=(0.0, 1.0)), level=param()):
    return Residual(measured=y, predicted=level + slope * x)


def test_a_value_beyond_its_bound_is_refused_and_one_inside_is_not():
    rng = np.random.default_rng(16)
    x = rng.standard_normal((2, 12))
    y = np.array([[0.7], [1.4]]) * x + 0.01 * rng.standard_normal((2, 12))
    found = calibrate_many(capped, {"x": x, "y": y})
    assert list(found.trusted) == [True, False]
    assert "`slope` ended on its bound" in found.reasons[1][0]


def test_a_time_series_with_correlated_noise_is_refused():
    rng = np.random.default_rng(18)
    x, white = rng.standard_normal((2, 2, 400))
    noise = white.copy()
    for k in range(1, 400):
        noise[1, k] += 0.6 * noise[1, k - 1]
    found = calibrate_many(straight, {"x": x, "y": 1 + 2 * x + 0.1 * noise})
    assert list(found.trusted) == [True, False]
    assert "neighbouring samples are alike" in found.reasons[1][0]


# -- what cannot be done, in words -----------------------------------------------------------------


@model
def own_level(x=signal(), y=signal(), *, slope=param(), level=param(per="run")):
    return Residual(measured=y, predicted=level + slope * x)


@model
def direction(v=signal(3), *, up=param(unit_vector)):
    return Residual(measured=v, predicted=9.8 * up)


@model
def decay(x=signal(), y=signal(), *, k=param(start=1.0)):
    return Residual(measured=y, predicted=exp(-k * x))


@pytest.mark.parametrize(
    ("declared", "signals", "options", "error", "words"),
    [
        (own_level, {}, {}, UsageError, "has a level per run"),
        (direction, {}, {}, UsageError, "direction or rotation up"),
        (straight.having(slope=1.0, level=0.0), {}, {}, UsageError, "nothing left to estimate"),
        (decay, {"x": np.ones((2, 3))}, {}, UsageError, "needs the signal 'y'"),
        (decay, {"z": np.ones((2, 3))}, {}, UsageError, "has no signal 'z'"),
        (NORM, {"v": np.ones((24, 3))}, {}, DataError, r"shape \(24, 3\)"),
        (NORM, {"v": np.ones((0, 24, 3))}, {}, DataError, "no sensors"),
        (NORM, {"v": [np.ones((24, 3)), np.ones((23, 3))]}, {}, DataError, "say counts="),
        (decay, {"x": np.ones((2, 3)), "y": np.ones((2, 4))}, {}, DataError, "2 sensors of 4"),
        (NORM, {"v": np.ones((2, 24, 3))}, {"counts": [24]}, DataError, r"give \(2,\)"),
        (NORM, {"v": np.ones((2, 24, 3))}, {"counts": [24, 25]}, DataError, r"counts\[1\] is 25"),
        (NORM, {"v": np.ones((2, 24, 3))}, {"start": {"b": 1}}, UsageError, "has no parameter 'b'"),
        (
            NORM, {"v": np.ones((2, 24, 3))}, {"start": {"offset": np.ones((3, 3))}}, UsageError,
            r"start\['offset'\] has shape \(3, 3\)",
        ),
    ],
)  # fmt: skip
def test_errors_name_the_thing_and_the_way_out(declared, signals, options, error, words):
    with pytest.raises(error, match=words):
        calibrate_many(declared, signals, **options)
