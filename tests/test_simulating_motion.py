"""Simulated records in motion: true to physics integrated by other code, and followed at once."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from casest import UsageError, load_runs, signal
from casest.cli import run as command
from casest.dynamics import Motion, dynamics, filtered, measured, state
from casest.simulation.motion import simulated_motion
from casest_problems.bias_gravity import bias_gravity, bias_gravity_position

QUIET = bias_gravity.driven(velocity=0.0, gravity=0.0, bias=0.0)
NOISE = ["--sensor-noise", "a=0.005", "--sensor-noise", "omega=0.001", "--sensor-noise", "v=0.01",
         "--intensity", "bias=0"]  # fmt: skip
BIAS = {"bias": [0.1, -0.05, 0.025]}
T = np.arange(0, 20, 0.02)


def made(model=QUIET, t=T, seed=0, noise=0.0, values=BIAS, **more):
    rng = np.random.default_rng(seed)
    return simulated_motion(model, t, rng, noise=noise, values=values, **more)


# -- physics -----------------------------------------------------------------------------------


def test_states_are_those_of_a_rigid_body_in_the_inertial_frame():
    """Attitude and inertial velocity integrated by SciPy along the record's inputs."""
    found = made()
    a, omega = (CubicSpline(T, found.run.signals[name]) for name in ("a", "omega"))
    gravity = np.array([0, 0, 9.80665])

    def rates(t, y):
        R, w = y[:9].reshape(3, 3), omega(t)
        skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.r_[(R @ skew).ravel(), R @ (a(t) - BIAS["bias"]) + gravity]

    start = np.r_[np.eye(3).ravel(), found.states[0, :3]]
    y = solve_ivp(rates, (0, T[-1]), start, "DOP853", T, rtol=1e-10, atol=1e-10).y.T
    body = Rotation.from_matrix(y[:, :9].reshape(-1, 3, 3)).inv()
    np.testing.assert_allclose(found.states[:, :3], body.apply(y[:, 9:]), atol=1e-5)
    np.testing.assert_allclose(found.states[:, 3:6], body.apply(gravity), atol=1e-5)
    np.testing.assert_allclose(found.run.signals["v"], found.states[:, :3], atol=1e-12)
    assert np.ptp(found.states[:, :3], axis=0).min() > 1  # it moves


def test_predator_and_prey_keep_what_the_motion_conserves():
    """Lotka and Volterra's: V = d·x − c·ln x + b·y − a·ln y is constant."""

    @dynamics
    def predation(counted=signal("1"), *, prey=state(start=2.0), predator=state(start=1.0)):
        rates = {"prey": 0.7 * prey - 0.5 * prey * predator,
                 "predator": 0.3 * prey * predator - 0.6 * predator}  # fmt: skip
        return Motion(rates=rates, outputs=(measured(counted, prey, intensity=0.01),))

    x, y = made(predation, np.arange(0, 60, 0.1), values={}).states.T
    kept = 0.3 * x - 0.6 * np.log(x) + 0.5 * y - 0.7 * np.log(y)
    assert np.ptp(x) > 1
    assert np.ptp(kept) < 1e-6


def test_driven_states_and_readings_scatter_as_their_intensities_say():
    """A walk, a process that forgets, and readings at uneven times: variances over many records."""
    q, tau, theta, count = 0.3, 0.8, 0.02, 60

    @dynamics
    def noisy(
        y=signal(60, "m"),
        *,
        walk=state(60, "m", intensity=q, std=1.0),
        leak=state(60, "m", intensity=q, std=1.0),
    ):
        return Motion(rates={"leak": -leak / tau}, outputs=(measured(y, walk, intensity=theta),))

    t = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.06, 100))
    each = [simulated_motion(noisy, t, np.random.default_rng(k)) for k in range(10)]
    end = np.array([e.states[-1] for e in each])
    span, cases = t[-1] - t[0], 10 * count
    band = chi2.ppf([1e-3, 1 - 1e-3], cases) / cases
    forgets = q * tau / 2 * (1 - np.exp(-2 * span / tau))
    for own, variance in ((end[:, :count], q * span), (end[:, count:], forgets)):
        assert band[0] < np.mean(own**2) / variance < band[1]
    left = np.array([e.run.signals["y"] - e.states[:, :count] for e in each])
    squares = np.mean(left**2, axis=(0, 2)) * np.diff(t).mean() / theta
    assert band[0] < squares.min()
    assert squares.max() < band[1]


# -- effects -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "value", "name", "reads"),
    [
        ("bias(omega)", {"omega_bias": [0.01, 0.02, 0.03]}, "omega",
         lambda clean, _: np.add(clean, [0.01, 0.02, 0.03])),
        ("gain(a)", {"a_gain": 0.03}, "a", lambda clean, _: 1.03 * clean),
        ("lever_arm", {"v_lever_arm": [0.3, -0.1, 0.2]}, "v",
         lambda clean, run: clean + np.cross(run.signals["omega"], [0.3, -0.1, 0.2])),
        ("bias(v)", {"v_bias": [0.1, 0, 0]}, "v", lambda clean, _: np.add(clean, [0.1, 0, 0])),
        ("gain(v)", {"v_gain": 0.02}, "v", lambda clean, _: 1.02 * clean),
        ("misalignment(v)", {"v_misalignment": [0, 0, 0.01]}, "v",
         lambda clean, _: clean + np.cross([0, 0, 0.01], clean)),
    ],
)  # fmt: skip
def test_a_sensor_with_an_effect_reads_otherwise(effect, value, name, reads):
    clean, other = made(), made(effects=[effect], values={**BIAS, **value})
    expected = reads(clean.run.signals[name], clean.run)
    np.testing.assert_allclose(other.run.signals[name], expected, atol=1e-9)
    np.testing.assert_allclose(other.states, clean.states, atol=1e-12)


def test_a_late_reading_is_an_earlier_velocity():
    clean, late = made(), made(effects=["time_delay"], values={**BIAS, "v_time_delay": 0.3})
    np.testing.assert_allclose(late.run.signals["v"][15:], clean.run.signals["v"][:-15], atol=1e-6)
    assert np.isfinite(late.run.signals["v"]).all()


def test_noise_with_a_colour_has_its_size_and_its_memory():
    t = np.arange(0, 2000, 0.05)
    said = {"v_colour.correlation_time": 0.5, "v_colour.std": 0.04, **BIAS}
    rest = {n: np.zeros((len(t), 3)) for n in ("a", "omega")}
    still = QUIET.beginning(gravity=0.0, bias=0.0)
    values = {k: v for k, v in said.items() if k != "bias"}
    v = made(still, t, inputs=rest, effects=["coloured_noise"], values=values).run.signals["v"]
    assert abs(np.std(v) / 0.04 - 1) < 0.05
    for lag in (2, 10):
        r = np.mean(v[lag:] * v[:-lag]) / np.mean(v**2)
        assert abs(r - np.exp(-0.05 * lag / 0.5)) < 0.03


# -- the commands ------------------------------------------------------------------------------


def simulated(folder, *arguments, model="bias-gravity"):
    assert command(["simulate", model, *arguments, "-o", str(folder)]) == 0
    truth = json.loads((folder / "truth.json").read_text("utf-8"))
    with (folder / "truth.csv").open() as file:
        rows = list(csv.reader(file))
    return str(folder / "record.csv"), truth, np.array(rows[1:], float)


@pytest.mark.long
def test_a_filter_told_the_same_noise_finds_the_truth(tmp_path, capsys):
    plan = ["--duration", "30", "--rate", "50", "--value", "bias=0.1,-0.05,0.025", *NOISE]
    record, truth, states = simulated(tmp_path, *plan)
    assert truth["states"]["bias"]["start"] == [0.1, -0.05, 0.025]
    assert truth["noise"]["readings"]["v"] == {"std": pytest.approx(0.01), "unit": "m/s"}
    capsys.readouterr()
    assert command(["observe", "bias-gravity", record, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rank"] == 9
    assert command(["filter", "bias-gravity", record, *NOISE, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 3 * 1350) / 1350
    assert low < found["innovations"]["normalised_mean"] < high
    values = np.concatenate([s["value"] for s in found["states"].values()])
    stds = np.concatenate([s["std"] for s in found["states"].values()])
    assert np.sum(((values - states[-1, 1:]) / stds) ** 2) < chi2.ppf(0.9999, 9)


@pytest.mark.long
def test_an_effect_that_was_simulated_is_found(tmp_path, capsys):
    effect = ["--effect", "lever_arm(v)", "--value", "v_lever_arm=0.3,-0.1,0.2"]
    plan = ["--duration", "40", "--rate", "25", *NOISE, *effect]
    record, truth, _ = simulated(tmp_path, *plan)
    assert truth["parameters"]["v_lever_arm"] == {"k": [0.3, -0.1, 0.2], "unit": "m"}
    assert "casest close bias-gravity" in capsys.readouterr().out
    assert command(["close", "bias-gravity", record, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [(e["name"], e["on"]) for e in content["effects"]] == [("lever_arm", "v")]
    arm = content["effects"][0]["parameters"]["k"]
    assert np.all(np.abs(np.subtract(arm["value"], [0.3, -0.1, 0.2])) < 5 * np.array(arm["std"]))


def test_the_published_noise_is_what_its_own_filter_expects(tmp_path, capsys):
    record, _, _ = simulated(tmp_path, "--duration", "60", "--rate", "50")
    capsys.readouterr()
    assert command(["filter", "bias-gravity", record]) == 0
    assert "innovations are as large as the noise intensities say" in capsys.readouterr().out


def test_inputs_of_a_record_are_the_true_ones(tmp_path):
    a = np.array([0.1, 0, -9.80665]) + 0.2 * np.sin(T)[:, None]
    table = np.c_[T, a, 0.3 * np.cos(T)[:, None] * [1, 0, 1], 1 + T]
    head = "t [s],ax [m/s^2],ay [m/s^2],az [m/s^2],omegax [rad/s],omegay [rad/s],omegaz [rad/s],px"
    given = tmp_path / "given.csv"
    np.savetxt(given, table, delimiter=",", header=head, comments="", fmt="%.15g")
    record, _, states = simulated(tmp_path / "out", "--input", str(given), "--noise", "0")
    (run,) = load_runs([record], bias_gravity.signals)
    np.testing.assert_allclose(run.signals["a"], a, atol=1e-10)
    np.testing.assert_allclose(run.signals["v"], states[:, 1:4], atol=1e-10)


def test_a_users_own_estimator_is_simulated_and_followed(tmp_path, capsys):
    """A swinging pendulum: the torque leads the rate; the angle alone is measured."""
    (tmp_path / "swing.py").write_text(
        "from casest import constant, sin, signal\n"
        "from casest.dynamics import Motion, dynamics, measured, state\n\n\n"
        "@dynamics\n"
        "def swing(torque=signal('1/s^2'), angle=signal('rad'), *,\n"
        "          stiffness=constant(4.0, '1/s^2'), damping=constant(0.1, '1/s'),\n"
        "          phi=state('rad', start=0.2, std=0.2),\n"
        "          rate=state('rad/s', intensity=1e-4, std=0.5)):\n"
        "    rates = {'phi': rate, 'rate': torque - stiffness * sin(phi) - damping * rate}\n"
        "    return Motion(rates=rates, outputs=(measured(angle, phi, intensity=1e-5),))\n",
        encoding="utf-8",
    )
    model = str(tmp_path / "swing.py")
    plan = ["--duration", "60", "--rate", "20", "--seed", "3"]
    record, _, states = simulated(tmp_path / "out", *plan, model=model)
    capsys.readouterr()
    assert command(["filter", model, record, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert 0.8 < found["innovations"]["normalised_mean"] < 1.25
    for k, own in enumerate(found["states"].values()):
        assert abs(own["value"][0] - states[-1, 1 + k]) < 4 * own["std"][0]


@pytest.mark.long
def test_the_position_variant_ends_where_its_filter_says():
    noisy = bias_gravity_position.driven(velocity=0.0, gravity=0.0, bias=0.0)
    noisy = noisy.sensing(a=1e-7, omega=1e-9, p=1e-5)
    found = made(noisy, np.arange(0, 60, 0.02), noise=None)
    followed = filtered(noisy, found.run, smooth=False)
    off = followed.x[-1] - found.states[-1]
    assert off @ np.linalg.solve(followed.P[-1], off) < chi2.ppf(0.9999, 12)
    assert followed.std[-1, 9:].max() < 0.01  # of the bias


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "say --duration and --rate"),
        (["--duration", "-1", "--rate", "10"], "both must be positive"),
        (["--duration", "0.1", "--rate", "10"], "1 sample: motion needs at least two"),
        (["--noise", "-1"], "a standard deviation, not negative"),
        (["--effect", "imbalance"], "no such effect; there are bias(omega), gain(a)"),
        (["--effect", "bias"], "which of bias(omega), bias(v)?"),
        (["--value", "mass=1"], "--value mass: there are the states"),
        (["--value", "bias=a"], "'a' are no numbers"),
        (["--value", "bias=1,2"], "bias begins with 3 numbers, not 2 numbers"),
        (["--effect", "lever_arm", "--value", "v_lever_arm=1,2"], "2 numbers, lever_arm of v has"),
        (["--effect", "lever_arm", "--value", "lever=1,2"], "the states and v_lever_arm"),
        (["--effect", "time_delay", "--value", "v_time_delay=9"], "not within the record"),
        (["--sensor-noise", "w=1"], "bias-gravity has no signal 'w'"),
        (["--directions", "3"], "--directions is no option of an estimator in motion"),
        (["--intensity", "bias=-1"], "bias: the intensity -1 must be finite"),
    ],
)
def test_what_cannot_be_simulated_is_said(tmp_path, capsys, arguments, words):
    length = (
        [] if not arguments or "--duration" in arguments else ["--duration", "5", "--rate", "9"]
    )
    assert command(["simulate", "bias-gravity", *arguments, *length, "-o", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_states_that_run_away_are_said():
    @dynamics
    def runaway(y=signal("m"), *, x=state("m", start=1.0)):
        return Motion(rates={"x": x**2}, outputs=(measured(y, x, intensity=1.0),))

    with pytest.raises(UsageError, match="the states do not stay finite"):
        made(runaway, values={})


def test_options_of_motion_are_refused_elsewhere(tmp_path, capsys):
    plan = ["--duration", "9", "--rate", "9", "--intensity", "v=1", "-o", str(tmp_path)]
    assert command(["simulate", "wheel", *plan]) == 1
    assert "--intensity is for estimators in motion; wheel has --noise" in capsys.readouterr().err
