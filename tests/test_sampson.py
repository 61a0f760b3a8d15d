"""An effect on an implicit model leaves the residual in the unit of its readings."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import simulators as sim

from casest import (
    Residual,
    Run,
    attempt,
    close,
    effect,
    load_runs,
    model,
    norm_2,
    param,
    quantity,
    signal,
)
from casest.diagnose.misfit.variables import variables
from casest.effects import CATALOGUE
from casest.leastsquares.problem import Problem
from casest.results.closing import closing_result
from casest_problems.norm import norm_diagonal, norm_triangular
from casest_problems.pair import norm_pair

SIGMA = 0.3
EFFECTS = {e.name: e for e in CATALOGUE}


@pytest.fixture(autouse=True)
def by_numpy(monkeypatch):
    """What is evaluated once or twice is not compiled for it."""
    monkeypatch.setenv("CASEST_KERNEL", "off")


def along(declared, name, **columns):
    return declared.with_effect(replace(EFFECTS[name], on="corrected"), columns=columns)


def residuals(declared, signals, values):
    run = Run.raw("r", {n: np.reshape(x, (len(x), -1)) for n, x in signals.items()}, units={})
    problem = Problem(declared, (run,))
    return problem.residuals(problem.point(values))[0]


# -- the noise of a residual is that of the reading --------------------------------------------


@pytest.mark.parametrize("gain", [0.4, 2.5])
def test_where_a_gain_follows_a_current_the_noise_of_the_residual_does_not(gain):
    """Half of the readings are made with another gain; the noise comes after it."""
    rng, n = np.random.default_rng(1), 20_000
    sensor = sim.Sensor(
        np.diag([1.1, 0.9, 1.0]) + np.tril(np.full((3, 3), 0.05), -1), np.ones(3), 48
    )
    on = np.arange(n) % 2
    true = 48 * sim.sphere(n, rng) / np.where(on, gain, 1.0)[:, None]
    v = true @ sensor.M.T + sensor.b + SIGMA * rng.standard_normal((n, 3))
    values = {
        "scale": sensor.scale,
        "offset": sensor.b,
        "channel_gain(on).k": np.full(3, gain - 1),
    }
    declared = along(norm_triangular.having(norm=48.0), "channel_gain", channel="on")
    r = residuals(declared, {"v": v, "on": on}, values)[:, 0]
    for state in (0, 1):  # four standard deviations of an estimated one
        assert np.std(r[on == state]) == pytest.approx(SIGMA, rel=4 / np.sqrt(n))


def test_readings_that_bend_have_the_noise_of_the_reading_in_the_residual():
    rng, n, k = np.random.default_rng(2), 20_000, 0.004
    true = 48 * sim.sphere(n, rng)
    bent = (np.sqrt(1 + 4 * k * true) - 1) / (2 * k)  # bent + k·bent² = true
    v = bent + 1.0 + SIGMA * rng.standard_normal((n, 3))
    declared = along(norm_diagonal.having(norm=48.0), "quadratic")
    values = {"scale": np.ones(3), "offset": np.ones(3), "quadratic.k": np.full(3, k)}
    r = residuals(declared, {"v": v}, values)[:, 0]
    order = np.argsort(true.sum(axis=1))
    for part in np.array_split(order, 5):  # slopes differ by a factor of 3 from side to side
        assert np.std(r[part]) == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * len(part)) + 0.01)


@effect(on="v")
def amplified(v, *, k=param()):
    """All of the reading too large."""
    return v * (1 + k)


@effect(on="corrected")
def stretched(c, *, k=param(3)):
    """A gain of each axis, which the declared scale has already."""
    return c * (1 + k)


def test_an_effect_on_the_reading_itself_counts_as_well():
    rng, n = np.random.default_rng(3), 20_000
    v = (48 * sim.sphere(n, rng)) / 1.6 + SIGMA * rng.standard_normal((n, 3))
    declared = norm_diagonal.having(norm=48.0).with_effect(amplified)
    values = {"scale": np.ones(3), "offset": np.zeros(3), "amplified.k": 0.6}
    r = residuals(declared, {"v": v}, values)[:, 0]
    assert np.std(r) == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * n))


def test_effects_on_reading_and_corrected_value_act_together():
    rng, n = np.random.default_rng(4), 20_000
    v = (48 * sim.sphere(n, rng)) / (1.6 * 0.7) + SIGMA * rng.standard_normal((n, 3))
    for order in ((amplified, stretched), (stretched, amplified)):
        declared = norm_diagonal.having(norm=48.0)
        for one in order:
            declared = declared.with_effect(one)
        values = {"scale": np.ones(3), "offset": np.zeros(3), "amplified.k": 0.6,
                  "stretched.k": np.full(3, -0.3)}  # fmt: skip
        r = residuals(declared, {"v": v}, values)[:, 0]
        assert np.std(r) == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * n))


@model
def warm(v=signal(3, "uT"), temperature=signal("K"), *, offset=param(3, "uT"), size=param("uT")):
    """The body does not read the temperature that was recorded beside it."""
    corrected = quantity("corrected", v - offset, "uT")
    return Residual(implicit=norm_2(corrected) - size, unit="uT", corrected=corrected)


@effect(on="corrected")
def warming(c, temperature, *, k=param("1/K")):
    """A gain that follows temperature."""
    return c * (1 + k * temperature)


def test_a_signal_that_only_an_effect_reads_is_as_exact_as_a_column():
    rng, n = np.random.default_rng(9), 20_000
    heat = rng.uniform(-20, 20, n)
    v = 48 * sim.sphere(n, rng) / (1 + 0.02 * heat)[:, None] + SIGMA * rng.standard_normal((n, 3))
    values = {"offset": np.zeros(3), "size": 48.0, "warming.k": 0.02}
    r = residuals(warm.with_effect(warming), {"v": v, "temperature": heat}, values)[:, 0]
    for part in np.array_split(np.argsort(heat), 4):
        assert np.std(r[part]) == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * len(part)))


# -- what cannot be told apart stays so --------------------------------------------------------


@pytest.mark.long
def test_a_gain_that_the_scale_has_already_changes_no_residual_and_is_refused():
    """It would contract the noise without end, were the residual not divided by its slope."""
    rng, sigma = np.random.default_rng(5), 0.02
    sensor = sim.accelerometer(rng)
    v = sensor.read(sim.spread_poses(60, rng), sigma, rng)
    declared = norm_triangular.having(norm=sim.GRAVITY)
    twice = declared.with_effect(stretched)
    one = residuals(declared, {"v": v}, {"scale": sensor.scale, "offset": sensor.b})
    for D in (np.array([0.1, 0.1, 0.1]), np.array([0.3, 2.0, 1.5])):
        values = {"scale": sensor.scale / D[:, None], "offset": sensor.b, "stretched.k": D - 1}
        other = residuals(twice, {"v": v}, values)
        np.testing.assert_allclose(other, one, atol=0.05 * sigma)  # the second order
    found = attempt(twice, [Run.raw("r", {"v": v}, units={"v": "m/s^2"})])
    assert not found.certificate.trusted


@pytest.mark.parametrize(
    ("place", "part"),
    [("force", "accelerometer"), pytest.param("flux", "magnetometer", marks=pytest.mark.long)],
)
def test_of_two_sensors_each_keeps_its_own_noise(place, part):
    """Three residuals of one pose: lengths and dip, with noises in m/s² and µT."""
    rng, n = np.random.default_rng(6), 5_000
    turn = np.array([sim.random_rotation(rng) for _ in range(n)])
    dip, noises = 1.1, {"force": 0.02, "flux": 0.3}
    true = {
        "force": 9.80665 * turn[:, :, 2],
        "flux": 50 * (turn @ np.array([np.cos(dip), 0, -np.sin(dip)])),
    }
    gains = {name: 0.5 if name == place else 1.0 for name in true}
    read = {
        name: true[name] / gains[name] + noises[name] * rng.standard_normal((n, 3)) for name in true
    }
    plain = {f"{s}_scale": np.eye(3) for s in ("accelerometer", "magnetometer")}
    plain |= {f"{s}_offset": np.zeros(3) for s in ("accelerometer", "magnetometer")}
    values = {**plain, "dip": dip, f"stretched@{place}.k": np.full(3, -0.5)}
    declared = norm_pair.with_effect(stretched, on=place)
    r = residuals(declared, {"a": read["force"], "m": read["flux"]}, values)
    # To first order in noise over length, 0.6 %.
    np.testing.assert_allclose(np.std(r, axis=0), noises["force"], rtol=4 / np.sqrt(2 * n))


def test_an_offset_leaves_the_residual_as_the_body_computes_it():
    declared = norm_triangular.having(norm=48.0)
    biased = along(declared, "channel_bias", channel="current")
    body = biased.traced.residual.expression
    assert ca.is_equal(ca.vec(body), ca.vec(biased.traced.expression), 3)


# -- only the reading is noisy -----------------------------------------------------------------


def drone(seed, sigma=SIGMA, skew=True):
    """A magnetometer in a field of 48 µT whose offset follows the motors' current."""
    rng = np.random.default_rng([seed, 5])
    M = np.diag(1 + rng.uniform(-0.05, 0.05, 3))
    M += np.tril(rng.uniform(-0.03, 0.03, (3, 3)), -1) * skew
    sensor = sim.Sensor(M, rng.uniform(-10, 10, 3), 48.0)
    per_ampere = rng.uniform(0.05, 0.5) * sim.sphere(1, rng)[0]
    t, v, current = sim.drone(sensor, per_ampere, sigma, rng)
    run = Run.raw("drone", {"v": v}, units={"v": "uT"}, time=t)
    run = replace(run, columns={"current": current}, column_units={"current": "A"})
    return sensor, per_ampere, run


def z_values(estimate, sensor, per_ampere, current):
    """Errors of all parameters over their standard deviations."""
    scale = np.atleast_2d(estimate.values["scale"])
    kept = np.tril_indices(3) if len(scale) == 3 else (np.arange(3), np.arange(3))
    k = "channel_bias(current).k"
    truth = {
        "offset": sensor.b + per_ampere * current.mean(),
        "scale": sensor.scale[kept],
        k: -sensor.scale @ per_ampere,  # what is taken away, in the corrected frame
    }
    found = {n: np.ravel(estimate.values[n]) for n in ("offset", k)}
    std = {n: np.ravel(estimate.std[n]) for n in ("offset", k)}
    found["scale"] = scale[kept] if len(scale) == 3 else scale[0]
    std["scale"] = estimate.std["scale"][kept] if len(scale) == 3 else estimate.std["scale"]
    return np.concatenate([(found[n] - truth[n]) / std[n] for n in truth])


@pytest.mark.parametrize(
    ("declared", "seeds"),
    [
        pytest.param(norm_diagonal, range(3), id="norm-diagonal", marks=pytest.mark.long),
        pytest.param(norm_triangular, range(3), id="norm-triangular", marks=pytest.mark.long),
    ],
)
def test_a_motors_current_beside_a_magnetometer_is_found_and_what_is_left_is_noise(declared, seeds):
    z = []
    for seed in seeds:
        sensor, per_ampere, run = drone(seed, skew=declared is norm_triangular)
        closing = close(declared.having(norm=sensor.norm), [run])
        result = closing_result(closing, model_name=declared.name, data=())
        assert [(e.name, e.column) for e in result.effects] == [("channel_bias", "current")]
        assert result.verdict == "extended"
        z.append(z_values(closing.after, sensor, per_ampere, run.columns["current"]))
    z = np.concatenate(z)
    assert np.abs(z).max() < 4
    assert np.sqrt(np.mean(z**2)) < 1.5


@model
def balanced(v=signal(3, "uT"), current=signal("A"), *, k=param(3, "uT/A"), size=param("uT")):
    """The current is a signal of the body here, and a reading like any other."""
    corrected = quantity("corrected", v - k * current, "uT")
    return Residual(implicit=norm_2(corrected) - size, unit="uT", corrected=corrected)


def test_a_column_that_an_effect_reads_is_exact_and_a_signal_of_the_body_is_not():
    biased = along(norm_triangular, "channel_bias", channel="current")
    assert [s.name for s in biased.readings] == ["v"]
    assert [s.name for s in balanced.readings] == ["v", "current"]


def test_what_a_residual_is_compared_with_does_not_hold_its_noise():
    """Many readings of one true value: where the residual is large, the quantities are not."""
    rng, n = np.random.default_rng(8), 20_000
    sensor, per_ampere = sim.magnetometer(rng, counts_per_gauss=1.0), np.array([0.3, -0.2, 0.1])
    truth = np.tile(sim.sphere(1, rng), (n, 1))
    v = sensor.read(truth, 0.002, rng) + 1.5 * per_ampere
    current = np.full(n, 1.5)
    declared = along(norm_triangular.having(norm=sensor.norm), "channel_bias", channel="current")
    signals = {"v": v, "current": current[:, None]}
    problem = Problem(declared, (Run.raw("r", signals, units={}),))
    values = {"scale": sensor.scale, "offset": sensor.b}
    point = problem.point({**values, "channel_bias(current).k": -sensor.scale @ per_ampere})
    r = problem.residuals(point)[0][:, 0]
    found = [x for x in variables(problem, point, ()) if x.name.startswith("corrected")]
    assert len(found) == 3
    for each in found:
        assert abs(np.corrcoef(each.values[0], r)[0, 1]) < 4 / np.sqrt(n)


def test_a_response_that_only_contracts_the_noise_of_a_measured_record_gains_nothing(shared_data):
    """Undivided, k·u·|u| lowered this magnetometer's residual by 10 %, with slopes of 0.83."""
    declared = norm_triangular.having(norm=1.0)
    path = shared_data / "qmc5883l-tomisuarez" / "filtered_raw_data.csv"
    runs = load_runs([path], declared.signals, columns={"v": ("mx", "my", "mz")}, rate=50)
    before = attempt(declared, runs)
    after = attempt(along(declared, "signed_quadratic"), runs)
    assert 0.99 * before.rmse < after.rmse <= before.rmse
