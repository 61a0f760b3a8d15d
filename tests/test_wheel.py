"""Pedersini's wheel: any sensor, either spin direction, from raw readings alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
import simulators as sim
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from casest import Run, attempt, load_runs, param
from casest.cli import run as casest_command
from casest.effects import speed_polynomial
from casest.results.find import find_model
from casest_problems.wheel import (
    closed_form,
    euler,
    find_motion,
    four_step,
    law_misfit,
    remarks,
    wheel,
)

TABLE_1 = sim.TABLE_1
#: Mountings turned about one axis.
SINGLE = [[0.5, 0.0, 0.0], [0.0, 0.0, 0.5]]


def turn(angles):
    """Rx(θ)·Ry(φ)·Rz(ψ): intrinsic x, y, z."""
    return Rotation.from_euler("XYZ", angles).as_matrix()


def spun(truth, rng, sigma=0.08, seconds=30.0, rate=100.0, name="run"):
    t = np.arange(0, seconds, 1 / rate)
    bench = sim.Spin(truth["offset"], truth["gain"], turn(truth["misalignment"]), truth["tilt"])
    v = bench.read(*sim.cubic_motion(t, truth["phase"], truth["speed"]))
    return as_run(t, v + sigma * rng.standard_normal(v.shape), name)


def as_run(t, v, name="run"):
    return Run.raw(name, {"t": t[:, None], "v": v}, units={"t": "s", "v": "m/s^2"}, time=t)


def random_truth(rng, seconds):
    """Any sensor in general position, either direction, losing up to 60 % of its speed."""
    direction = rng.choice([-1, 1])
    start = rng.uniform(5, 20)
    loss = rng.uniform(0.2, 0.6) * start / seconds
    speed = direction * np.array(
        [start, -1.3 * loss, 0.3 * loss / seconds, 1e-3 * loss / seconds**2]
    )
    return {
        "offset": rng.uniform(-1, 1, 3),
        "gain": rng.uniform(0.9, 1.1, 3),
        "misalignment": rng.uniform(0.25, 0.6, 3) * rng.choice([-1, 1], 3),
        "tilt": rng.uniform(0.35, 1.0),
        "phase": rng.uniform(-np.pi, np.pi),
        "speed": speed,
    }


def packed(values):
    names = ("offset", "gain", "misalignment", "tilt", "phase", "speed")
    return np.concatenate([np.ravel(values[n]) for n in names])


def test_the_models_readings_are_those_of_the_bench():
    t = np.linspace(0, 20, 200)
    bench = sim.Spin(
        TABLE_1["offset"], TABLE_1["gain"], turn(TABLE_1["misalignment"]), TABLE_1["tilt"]
    )
    v = bench.read(*sim.cubic_motion(t, TABLE_1["phase"], TABLE_1["speed"]))
    found = wheel(t=t, v=v, **TABLE_1)
    np.testing.assert_allclose(found["residual"], 0, atol=1e-11)


def test_euler_angles_are_those_of_the_rotation():
    angles = np.random.default_rng(0).uniform(-1.4, 1.4, (20, 3))
    for a in angles:
        np.testing.assert_allclose(euler(turn(a)), a, atol=1e-12)


@pytest.mark.parametrize("rate", [50.0, 1000.0])
@pytest.mark.parametrize("speed", [2.5, -20.0])
def test_the_phase_does_not_slip_a_turn(rate, speed):
    """After ninety seconds the phase found is that of the bench, but for its origin and sign."""
    rng = np.random.default_rng(3)
    truth = {**TABLE_1, "speed": np.array([speed, -speed / 300, 0.0, 0.0])}
    run = spun(truth, rng, seconds=90.0, rate=rate, sigma=0.2)
    t = run.time
    angle, *_ = sim.cubic_motion(t, truth["phase"], truth["speed"])
    found = find_motion(t, run.signals["v"]).phase(t)
    found = found * np.sign(found[-1] - found[0]) * np.sign(speed)
    slip = (found - found[0]) - (angle - angle[0])
    assert np.abs(slip).max() < 0.3


def hard_case(seed):
    """A wheel from the corners of what is promised: readings, and the angle behind them."""
    rng = np.random.default_rng(seed)
    seconds, rate = rng.choice([30.0, 120.0]), rng.choice([50.0, 400.0])
    first, last = rng.choice([[20.0, 2.1], [3.0, 2.0], [20.0, 14.0], [8.0, 2.5]])
    fall = (first - last) / seconds
    speed = rng.choice([-1, 1]) * np.array([first, -1.2 * fall, 0.2 * fall / seconds, 0.0])
    t = np.arange(0, seconds, 1 / rate)
    motion = sim.cubic_motion(t, rng.uniform(-np.pi, np.pi), speed)
    bench = sim.Spin(
        rng.uniform(-2, 2, 3),
        rng.uniform(0.8, 1.2, 3),
        sim.random_rotation(rng),
        np.radians(rng.choice([15.0, 75.0])),
    )
    v = bench.read(*motion)
    return t, v + 0.5 * rng.standard_normal(v.shape), motion[0]


@pytest.mark.parametrize("seed", range(12))
def test_the_phase_does_not_slip_at_the_corners_of_what_is_promised(seed):
    """Noise of 0.5 m/s², 15° or 75° of tilt, gains ±20 %, either direction, any mounting."""
    t, v, angle = hard_case(seed)
    found = find_motion(t, v).phase(t)
    found = found * np.sign(found[-1] - found[0]) * np.sign(angle[-1] - angle[0])
    assert np.ptp(found - angle) < 0.5


def test_any_sensor_and_motion_is_calibrated_from_its_readings_alone():
    """Thirty random wheels: all trusted, and jointly as far from the truth as they say."""
    rng, distance, unknowns = np.random.default_rng(1), [], 0
    for k in range(30):
        seconds = float(rng.choice([30, 60]))
        truth = random_truth(rng, seconds)
        found = attempt(wheel, [spun(truth, rng, seconds=seconds)], solver="trust-region", seed=k)
        assert found.certificate.trusted, (k, truth, found.certificate.reasons)
        error = packed(found.values) - packed(truth)
        error[10] = np.angle(np.exp(1j * error[10]))
        distance.append(error @ np.linalg.solve(found.covariance, error))
        unknowns = len(error)
    # A χ² of 15 degrees of freedom, thirty times: its mean within four of its standard errors.
    assert abs(np.mean(distance) - unknowns) < 4 * np.sqrt(2 * unknowns / 30)


def test_with_the_radius_free_one_direction_is_lost_and_it_is_the_papers():
    """Eqs. (9)-(13): r and sin α grow by β, the gains shrink, the offset takes up the rest."""
    run = spun(TABLE_1, np.random.default_rng(0), sigma=0.0)
    free = wheel.having(radius=param("m", start=0.28))
    found = attempt(free, [run], start=TABLE_1)
    assert (found.identifiability.rank, found.identifiability.unknowns) == (15, 16)
    assert not found.certificate.trusted
    (words,) = found.identifiability.unobservable
    assert all(name in words for name in ("radius", "tilt", "gain[0]", "offset[2]"))
    values, null = found.values, found.identifiability.null[:, 0]
    gain, tilt = values["gain"], float(values["tilt"])
    axis = turn(values["misalignment"])[:, 2]
    change = dict.fromkeys(found.names, 0.0)
    for i in range(3):
        change[f"gain[{i}]"] = -gain[i]
        change[f"offset[{i}]"] = gain[i] * axis[i] * sim.GRAVITY / np.cos(tilt)
    change["radius"], change["tilt"] = float(values["radius"]), np.tan(tilt)
    expected = np.array([change[name] for name in found.names])
    expected /= np.linalg.norm(expected)
    assert abs(null @ expected) == pytest.approx(1.0, abs=1e-7)


def test_with_the_tilt_fixed_the_radius_is_determined():
    run = spun(TABLE_1, np.random.default_rng(0))
    declared = wheel.having(radius=param("m", start=0.3), tilt=TABLE_1["tilt"])
    found = attempt(declared, [run])
    assert found.certificate.trusted, found.certificate.reasons
    assert found.identifiability.rank == found.identifiability.unknowns == 15
    assert abs(found.values["radius"] - 0.28) < 4 * found.std["radius"]


@pytest.mark.parametrize(
    "angles",
    [[0.0, 0.0, 0.0], *(pytest.param(a, marks=pytest.mark.long) for a in SINGLE)],
)
def test_a_mounting_turned_about_a_single_axis_is_refused_in_words(angles):
    truth = {**TABLE_1, "misalignment": np.array(angles)}
    found = attempt(wheel, [spun(truth, np.random.default_rng(2))])
    assert not found.certificate.trusted
    assert "determine" in found.certificate.reasons[0]
    assert "offset" in found.certificate.reasons[0]


def test_two_spins_share_the_sensor_and_say_more_about_it_than_one():
    rng = np.random.default_rng(4)
    first = spun(TABLE_1, rng, name="a")
    slower = {**TABLE_1, "speed": TABLE_1["speed"] * 0.7, "phase": -1.0}
    second = spun(slower, rng, name="b")
    both = attempt(wheel, [first, second])
    alone = attempt(wheel, [first])
    assert both.certificate.trusted, both.certificate.reasons
    assert both.values["offset"].shape == (3,)
    assert both.values["speed"].shape == (2, 4)
    assert np.all(both.std["offset"] < alone.std["offset"])
    assert np.all(np.abs(both.values["offset"] - TABLE_1["offset"]) < 4 * both.std["offset"])
    mounted_once = wheel.scoped("misalignment", "all").scoped("tilt", "all")
    shared = attempt(mounted_once, [first, second])
    assert shared.values["misalignment"].shape == (3,)
    assert shared.identifiability.unknowns == both.identifiability.unknowns - 4


def test_the_four_steps_come_near_the_truth_and_are_judged_by_the_optimum():
    """Errors of the order that the paper publishes (Table I), far above the bound's."""
    rng, errors = np.random.default_rng(5), []
    for _ in range(6):
        run = spun(TABLE_1, rng, seconds=90.0, rate=200.0)
        errors.append(packed(four_step(wheel, [run])) - packed(TABLE_1))
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    assert spread[:3].max() < 0.3  # offset, m/s²
    assert spread[3:6].max() < 0.01  # gain
    assert spread[6:9].max() < np.radians(2)
    assert spread[9] < np.radians(0.2)  # tilt
    np.testing.assert_array_less(spread[11:], [1e-3, 1e-4, 2e-6, 2e-8])


def test_the_closed_form_recovers_a_noise_free_wheel():
    """But for the tangential acceleration r·ω̇, which it neglects."""
    truth = {**TABLE_1, "speed": np.array([15.0, -0.02, 0.0, 0.0])}
    values = closed_form(wheel, [spun(truth, np.random.default_rng(0), sigma=0.0, seconds=60.0)])
    assert np.abs(values["speed"] - truth["speed"])[0] < 1e-3
    assert abs(values["tilt"] - truth["tilt"]) < 0.02
    assert np.abs(values["misalignment"] - truth["misalignment"]).max() < 0.1


def test_a_wheel_slowed_by_air_is_fitted_by_the_cubic_for_a_minute():
    """The physical wheel, integrated: within the noise the cubic law holds, as the paper found."""
    rng, t = np.random.default_rng(6), np.arange(0, 60, 0.01)
    bench = sim.Spin(
        TABLE_1["offset"], TABLE_1["gain"], turn(TABLE_1["misalignment"]), TABLE_1["tilt"]
    )
    v = bench.read(*sim.physical_motion(t, 0.5, 10.0))
    found = attempt(wheel, [as_run(t, v + 0.08 * rng.standard_normal(v.shape))])
    assert found.certificate.trusted, found.certificate.reasons
    assert found.rmse == pytest.approx(0.08, rel=0.03)
    assert np.all(np.abs(found.values["offset"] - TABLE_1["offset"]) < 4 * found.std["offset"])


def slowed(seconds, rate, sigma=0.08, seed=0, **losses):
    """A wheel slowed by air and bearing, from `rate` rad/s on, sampled at 50 Hz."""
    rng, t = np.random.default_rng(seed), np.arange(0, seconds, 0.02)
    turned = turn(TABLE_1["misalignment"])
    bench = sim.Spin(TABLE_1["offset"], TABLE_1["gain"], turned, TABLE_1["tilt"])
    v = bench.read(*sim.physical_motion(t, 0.5, rate, **losses))
    return as_run(t, v + sigma * rng.standard_normal(v.shape))


@pytest.mark.parametrize(("seconds", "rate"), [(120, 10.0), (90, 20.0), (150, -20.0)])
def test_a_run_too_long_for_the_cubic_law_is_told_in_words(seconds, rate):
    """The fit is an optimum all the same, with an offset several standard deviations off."""
    found = attempt(wheel, [slowed(seconds, rate)], solver="trust-region")
    (words,) = [note for note in found.notes if "speed_polynomial" in note]
    assert "the cubic speed law does not hold in run" in words


def test_ten_minutes_that_the_cubic_law_misses_by_turns_are_told_in_words():
    """Five whole turns off at the worst: the angle is followed without the law."""
    run = slowed(600, 20.0)
    found = law_misfit(run.time, run.signals["v"])
    assert 25 < found.departure < 35
    assert list(remarks(wheel, [run], {}))


def test_with_higher_speed_terms_in_the_model_the_law_is_no_longer_remarked():
    run = slowed(120, 10.0)
    assert list(remarks(wheel, [run], {}))
    assert not list(remarks(wheel.with_effect(speed_polynomial), [run], {}))


def test_an_unbalanced_wheel_is_not_mistaken_for_a_law_that_fails():
    """An eccentric mass speeds it up and slows it down once per turn: whole turns average that."""
    run = slowed(40, 8.0, sigma=0.02, eccentric=0.05)
    assert not list(remarks(wheel, [run], {}))


@pytest.mark.parametrize("kind", ["white", "correlated", "rounded"])
def test_an_exact_cubic_is_not_said_to_fail(kind):
    """Fifteen runs of each kind of noise: none is remarked on (one in a thousand would be)."""
    rng = np.random.default_rng(12)
    for _ in range(15):
        truth = random_truth(rng, 40.0)
        run = spun(truth, rng, sigma=0.0, seconds=40.0, rate=50.0)
        noise = 0.08 * rng.standard_normal(run.signals["v"].shape)
        if kind == "correlated":
            noise = 0.8 * lfilter([1.0], [1.0, -0.6], noise, axis=0)
        v = run.signals["v"] + noise
        v = 0.2 * np.round(v / 0.2) if kind == "rounded" else v
        assert not list(remarks(wheel, [as_run(run.time, v)], {}))


def test_a_record_that_does_not_turn_is_refused():
    t = np.arange(0, 30, 0.01)
    v = np.ones((len(t), 3)) * [1.0, 2.0, 9.0] + np.outer(np.sin(t), [1, 0, 0])
    certificate = attempt(wheel, [as_run(t, v)]).certificate
    assert not certificate.trusted
    assert "go round" in certificate.reasons[0]


def test_the_wheel_is_found_by_its_name_and_reads_time_in_any_unit(tmp_path):
    run = spun(TABLE_1, np.random.default_rng(7), seconds=30.0, rate=50.0)
    lines = ["time (ms),vx [g],vy [g],vz [g]"]
    g = 9.80665
    for t, v in zip(run.time, run.signals["v"] / g, strict=True):
        lines.append(f"{1000 * t:.1f},{v[0]:.9f},{v[1]:.9f},{v[2]:.9f}")
    path = tmp_path / "spin.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    declared = find_model("wheel")
    (read,) = load_runs(path, declared.signals, columns={"t": ("time",)})
    np.testing.assert_allclose(read.signals["v"], run.signals["v"], atol=1e-7)
    np.testing.assert_allclose(read.signals["t"][:, 0], run.time, atol=1e-9)


def test_the_phase_is_within_a_turn_and_the_angles_are_canonical_from_any_start():
    """Whole turns off, and the other Euler triple of the same rotation: one solution, one name."""
    run = spun(TABLE_1, np.random.default_rng(8))
    theta, phi, psi = TABLE_1["misalignment"]
    other = np.array([theta + np.pi, np.pi - phi, psi + np.pi])
    np.testing.assert_allclose(turn(other), turn(TABLE_1["misalignment"]), atol=1e-12)
    start = {**TABLE_1, "phase": TABLE_1["phase"] + 4 * np.pi, "misalignment": other}
    found = attempt(wheel, [run], start=start)
    assert found.certificate.trusted, found.certificate.reasons
    assert abs(found.values["phase"] - TABLE_1["phase"]) < 0.01
    np.testing.assert_allclose(found.values["misalignment"], TABLE_1["misalignment"], atol=0.01)


def test_of_two_spins_that_read_alike_the_one_of_the_smaller_offset_is_given():
    """The other way round, the sensor turned over: the offset differs by 2g·cos α."""
    run = spun(TABLE_1, np.random.default_rng(9))
    mounting = turn(TABLE_1["misalignment"])
    axle = TABLE_1["gain"] * mounting[:, 2] * sim.GRAVITY * np.cos(TABLE_1["tilt"])
    mirrored = {
        **TABLE_1,
        "offset": TABLE_1["offset"] + 2 * axle,
        "misalignment": Rotation.from_matrix(mounting @ np.diag([1, -1, -1])).as_euler("XYZ"),
        "phase": -TABLE_1["phase"],
        "speed": -TABLE_1["speed"],
    }
    np.testing.assert_allclose(
        spun(mirrored, np.random.default_rng(9)).signals["v"], run.signals["v"], atol=1e-9
    )
    found = attempt(wheel, [run], start=mirrored)
    assert found.certificate.trusted, found.certificate.reasons
    away = np.abs(packed(found.values) - packed(TABLE_1)) / packed(found.std)
    assert away.max() < 5


def test_a_spin_held_out_is_scored_with_its_own_motion_and_the_sensor_kept(tmp_path, capsys):
    """Its motion is fitted to half of its blocks; the score of the other half is the noise."""
    rng = np.random.default_rng(10)
    other = {**TABLE_1, "phase": 1.0, "tilt": 0.9, "speed": np.array([14.0, -0.2, 1e-3, 1e-6])}
    files = []
    for name, truth in (("fitted", TABLE_1), ("apart", other)):
        run = spun(truth, rng, sigma=0.08)
        files.append(tmp_path / f"{name}.csv")
        table = np.column_stack([run.signals["t"], run.signals["v"]])
        np.savetxt(files[-1], table, delimiter=",", header="t,vx,vy,vz", comments="")
    command = ["calibrate", "wheel", str(files[0]), "--holdout", str(files[1]), "--json"]
    assert casest_command(command) == 0
    estimate = json.loads(capsys.readouterr().out)["estimate"]
    assert estimate["rmse_holdout"] == pytest.approx(0.08, rel=0.03)
    assert estimate["rmse_fit"] == pytest.approx(0.08, rel=0.03)
