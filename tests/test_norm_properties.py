"""What physics demands of a calibration, whatever the data: units, frames, order, repetition."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import simulators as sim
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from casest import Run
from casest.estimate.calibrate import attempt
from casest.results.find import find_model

modest = settings(
    max_examples=8,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
seeds = st.integers(0, 10_000)


def fitted(name, v, norm=sim.GRAVITY, unit="m/s^2"):
    """A trusted estimate. Solver: trust-region, for speed."""
    runs = (Run.raw("simulated", {"v": v}, units={"v": unit}),)
    found = attempt(find_model(name).having(norm=norm), runs, solver="trust-region")
    assert found.certificate.trusted, found.certificate.reasons
    return found


def readings(seed, *, skew, sigma=5e-3, poses=20):
    rng = np.random.default_rng(seed)
    sensor = sim.accelerometer(rng, skew=skew)
    return sensor.read(sim.spread_poses(poses, rng), sigma, rng)


def assert_same(found, expected, std, tolerance=1e-5):
    """Equal to within a small fraction of a standard deviation (and rounding)."""
    rounding = 1e-11 * np.max(np.abs(expected))
    assert np.all(np.abs(found - expected) <= tolerance * std + rounding), (found, expected)


@modest
@given(seed=seeds, factor=st.floats(-3, 3).map(lambda e: 10.0**e))
def test_readings_in_another_unit_change_offset_and_scale_by_that_unit_alone(seed, factor):
    v = readings(seed, skew=True)
    one, other = fitted("norm-triangular", v), fitted("norm-triangular", factor * v, unit="count")
    assert_same(other.values["offset"] / factor, one.values["offset"], one.std["offset"])
    assert_same(other.values["scale"] * factor, one.values["scale"], one.std["scale"])
    np.testing.assert_allclose(other.std["offset"] / factor, one.std["offset"], rtol=1e-6)
    np.testing.assert_allclose(other.std["scale"] * factor, one.std["scale"], rtol=1e-6)
    np.testing.assert_allclose(other.noise.sigma / factor, one.noise.sigma, rtol=1e-6)


@modest
@given(seed=seeds)
def test_readings_and_norm_in_g_instead_of_metres_per_second_squared_change_only_the_offset(seed):
    v = readings(seed, skew=True)
    metric, g = fitted("norm-triangular", v), fitted("norm-triangular", v / 9.80665, 1.0, "g")
    assert_same(g.values["scale"], metric.values["scale"], metric.std["scale"])
    assert_same(9.80665 * g.values["offset"], metric.values["offset"], metric.std["offset"])
    np.testing.assert_allclose(9.80665 * g.std["offset"], metric.std["offset"], rtol=1e-6)


@modest
@given(seed=seeds, order=st.sampled_from(list(itertools.permutations(range(3)))))
def test_with_a_diagonal_scale_renamed_axes_rename_the_estimates(seed, order):
    v, order = readings(seed, skew=False), list(order)
    one, other = fitted("norm-diagonal", v), fitted("norm-diagonal", v[:, order])
    for name in ("scale", "offset"):
        assert_same(other.values[name], one.values[name][order], one.std[name][order])
        np.testing.assert_allclose(other.std[name], one.std[name][order], rtol=1e-6)


@modest
@given(seed=seeds, axes=st.lists(st.sampled_from([-1.0, 1.0]), min_size=3, max_size=3))
def test_an_axis_that_points_the_other_way_turns_the_sign_of_its_offset(seed, axes):
    v, sign = readings(seed, skew=False), np.array(axes)
    one, other = fitted("norm-diagonal", v), fitted("norm-diagonal", v * sign)
    assert_same(other.values["offset"], sign * one.values["offset"], one.std["offset"])
    assert_same(other.values["scale"], one.values["scale"], one.std["scale"])


@modest
@given(seed=seeds)
def test_a_rotated_sensor_frame_rotates_the_offset_and_the_ellipsoid(seed):
    """SᵀS, the ellipsoid, is a tensor: R SᵀS Rᵀ; the lengths of its axes and rmse stay."""
    v = readings(seed, skew=True)
    R = sim.random_rotation(np.random.default_rng(seed + 1))
    one, other = fitted("norm-triangular", v), fitted("norm-triangular", v @ R.T)
    spread = np.linalg.norm(one.std["offset"])
    assert_same(other.values["offset"], R @ one.values["offset"], spread, 1e-3)
    ellipsoid = one.values["scale"].T @ one.values["scale"]
    turned = other.values["scale"].T @ other.values["scale"]
    assert_same(turned, R @ ellipsoid @ R.T, np.max(one.std["scale"]), 1e-3)


@modest
@given(seed=seeds)
def test_the_order_of_the_samples_does_not_matter(seed):
    v = readings(seed, skew=True)
    shuffled = v[np.random.default_rng(seed).permutation(len(v))]
    one, other = fitted("norm-triangular", v), fitted("norm-triangular", shuffled)
    for name in ("scale", "offset"):
        assert_same(other.values[name], one.values[name], one.std[name])
        np.testing.assert_allclose(other.std[name], one.std[name], rtol=1e-6)


@modest
@given(seed=seeds)
def test_every_reading_twice_keeps_the_estimate_and_shrinks_the_std_by_the_square_root_of_two(seed):
    """Σ̂ = RSS/(N−n)·(JᵀJ)⁻¹: RSS and JᵀJ double, N−n becomes 2N−n."""
    v, n = readings(seed, skew=True), 9
    one, other = fitted("norm-triangular", v), fitted("norm-triangular", np.vstack([v, v]))
    shrunk = np.sqrt((len(v) - n) / (2 * len(v) - n))
    for name in ("scale", "offset"):
        assert_same(other.values[name], one.values[name], one.std[name])
        # Twice the rows may look alike where half of them do not: of that `std` knows besides.
        np.testing.assert_allclose(other.plain[name], shrunk * one.plain[name], rtol=1e-6)


@modest
@given(seed=seeds, factor=st.floats(1e-3, 1e3))
def test_another_norm_scales_the_scale_alone(seed, factor):
    v = readings(seed, skew=True)
    one, other = fitted("norm-triangular", v), fitted("norm-triangular", v, factor * sim.GRAVITY)
    assert_same(other.values["scale"] / factor, one.values["scale"], one.std["scale"])
    assert_same(other.values["offset"], one.values["offset"], one.std["offset"])
    np.testing.assert_allclose(other.std["offset"], one.std["offset"], rtol=1e-6)


@modest
@given(seed=seeds, shift=st.floats(-3, 3))
def test_a_constant_added_to_an_axis_moves_its_offset_by_as_much(seed, shift):
    v = readings(seed, skew=True)
    moved = v + np.array([shift, 0.0, -shift])
    one, other = fitted("norm-triangular", v), fitted("norm-triangular", moved)
    expected = one.values["offset"] + [shift, 0.0, -shift]
    assert_same(other.values["offset"], expected, one.std["offset"])
    assert_same(other.values["scale"], one.values["scale"], one.std["scale"])


@pytest.mark.parametrize("name", ["norm-diagonal", "norm-triangular"])
def test_magnetometer_counts_are_calibrated_as_well_as_gauss(name):
    """Hard and soft iron in raw counts (offset 720, scale 3e-4): nothing depends on magnitudes."""
    rng = np.random.default_rng(2)
    sensor = sim.magnetometer(rng)
    if name == "norm-diagonal":
        sensor = sim.Sensor(np.diag(np.diag(sensor.M)), sensor.b, sensor.norm)
    found = fitted(name, sensor.read(sim.sphere(500, rng), 3.0, rng), sensor.norm, "count")
    scale = np.diag(sensor.scale) if name == "norm-diagonal" else sensor.scale
    free = found.std["scale"] > 0
    assert np.all(np.abs(found.values["offset"] - sensor.b) < 4 * found.std["offset"])
    assert np.all(np.abs(found.values["scale"] - scale)[free] < 4 * found.std["scale"][free])
    # 500 poses with noise of 3 counts: about 3·√(3/500) = 0.23 counts on each offset
    assert np.all(found.std["offset"] < 0.4)


def test_a_raw_hand_held_record_gives_the_sensor_within_its_uncertainty():
    """Rests of three seconds at 100 Hz with motion between them, found and averaged."""
    from casest.data import at_rest

    rng = np.random.default_rng(21)
    sensor = sim.accelerometer(rng)
    v, rests = sim.handheld(sensor, sim.spread_poses(24, rng), 0.05, rng)
    raw = Run.raw("hand", {"v": v}, units={"v": "m/s^2"}, time=np.arange(len(v)) / 100)
    averaged = at_rest(raw)
    assert len(averaged) == len(rests) == 24
    found = attempt(find_model("norm-triangular").having(norm=sim.GRAVITY), (averaged,))
    assert found.certificate.trusted, found.certificate.reasons
    z = (found.values["offset"] - sensor.b) / found.std["offset"]
    free = np.tri(3, dtype=bool)
    z = np.append(
        z, ((found.values["scale"] - sensor.scale) / np.where(free, found.std["scale"], 1))[free]
    )
    assert np.max(np.abs(z)) < 4
    # white noise of 0.05 over about 300 samples: 0.0029 m/s² per rest, both ways of knowing it
    assert 0.7 * 0.0029 < found.noise.repeats < 1.4 * 0.0029
    assert 0.5 * 0.0029 < found.noise.residual < 1.5 * 0.0029
