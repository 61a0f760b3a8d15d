"""`casest plan` of an estimator in motion: inputs to fly, within limits, judged from outside."""

from __future__ import annotations

import json
import shlex

import numpy as np
import pytest
from casadi import vertcat
from scipy.integrate import solve_ivp

from casest import cross, signal, tanh
from casest.cli import run
from casest.dynamics import Motion, dynamics, measured, state
from casest.errors import UsageError
from casest.plan.goals import Measures
from casest.plan.motion.criteria import Wanted
from casest.plan.motion.grid import Grid
from casest.plan.motion.limits import limits_of
from casest.plan.motion.planning import bent, planned_motion
from casest.plan.motion.program import NEAREST, Task
from casest.plan.motion.until import shortest
from casest_problems.bias_gravity import bias_gravity

WORDS = ["bias-gravity", "--duration", "10", "--rate", "20", "--pieces", "6"]
WORDS += ["--sensor-noise", "v=0.01", "--limit", "a=12", "--limit", "omega=30 deg/s"]
WORDS += ["--limit", "rate of omega=60 deg/s^2", "--limit", "velocity=0.5"]


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned") / "next"
    assert run(["plan", *WORDS, "-o", str(folder)]) == 0
    table = np.loadtxt(folder / "plan.csv", delimiter=",", skiprows=1)
    return folder, json.loads((folder / "plan.json").read_text()), table


def test_the_motion_keeps_to_its_limits(planned):
    _, found, table = planned
    t, omega, v = table[:, 0], table[:, 4:7], table[:, 7:10]
    assert t[-1] == pytest.approx(10)
    assert np.linalg.norm(table[:, 1:4], axis=1).max() <= 12 * 1.001
    assert np.linalg.norm(omega, axis=1).max() <= np.radians(30) * 1.001
    turns = np.linalg.norm(np.diff(omega, axis=0) / np.diff(t)[:, None], axis=1)
    assert turns.max() <= np.radians(60) * 1.001
    assert np.linalg.norm(v, axis=1).max() <= 0.5 * 1.002
    assert {k["name"] for k in found["limits"]} == {"a", "omega", "rate of omega", "velocity"}


def test_standard_deviations_are_those_of_the_gramian_that_scipy_integrates(planned):
    _, found, table = planned
    t, omega = table[:, 0], table[:, 4:7]

    def slope(at, W):
        x, y, z = (np.interp(at, t, column) for column in omega.T)
        A = np.zeros((9, 9))
        A[:3, :3] = A[3:6, 3:6] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        A[:3, 3:6], A[:3, 6:] = np.eye(3), -np.eye(3)
        W = W.reshape(9, 9)
        told = np.zeros((9, 9))
        told[:3, :3] = np.eye(3) * 20 / 0.01**2
        return -(A.T @ W + W @ A + told).ravel()

    W = solve_ivp(slope, (10, 0), np.zeros(81), rtol=1e-9, atol=1e-3, max_step=0.5).y[:, -1]
    std = np.sqrt(np.diag(np.linalg.inv(W.reshape(9, 9))))
    said = np.array([seen["planned"] for seen in found["std"].values()])
    assert said == pytest.approx(std, rel=2e-3)


def test_it_shows_more_than_a_random_motion_and_far_more_than_a_hovering_one(planned):
    _, found, _ = planned
    assert found["rank"] == found["unknowns"] == 9
    assert found["ratio"] < 0.75


def test_observe_of_the_planned_inputs_says_the_same(planned, capsys):
    folder, found, _ = planned
    words = ["observe", "bias-gravity", str(folder / "plan.csv"), "--sensor-noise", "v=0.01"]
    assert run([*words, "--json"]) == 0
    std = json.loads(capsys.readouterr().out)["std"]
    there = np.concatenate([std[name] for name in ("velocity", "gravity", "bias")])
    assert there == pytest.approx([s["planned"] for s in found["std"].values()], rel=1e-4)


def test_the_page_has_the_limits_and_draws_the_inputs(planned):
    text = (planned[0] / "plan.html").read_text(encoding="utf-8")
    assert "omega at most 0.5236 rad/s" in text
    assert 'id="inputs"' in text


@dynamics
def rail(
    push=signal("m/s"),
    read=signal("1"),
    *,
    place=state("m", known=True),
    scale=state("1/m", start=1.0, std=1.0),
):
    """A slide whose position is known, and a reading of unknown scale."""
    return Motion(rates={"place": push}, outputs=(measured(read, scale * place, intensity=1e-4),))


def best(model, limits, duration, pieces, criterion="D", rate=20.0, **more):
    task = Task(
        model,
        Wanted.of(model, criterion),
        limits_of(model, limits),
        Grid.of(duration, pieces, 30, False),
        model.noise_at(1 / rate),
    )
    return planned_motion(task, rate, np.random.default_rng(0), **more)


def test_of_a_scale_the_best_motion_leaves_as_fast_as_it_may_and_stays_away():
    limits = [("push", "0.5 m/s"), ("place", "2 m")]
    found = best(rail, limits, 10.0, 20)
    # Position t/2 up to 2 m, then 2 m: the integral of its square over 10 s.
    assert found.motion.seen.std[1] == pytest.approx(np.sqrt(1e-4 / (4**3 / 12 + 4 * 6)), rel=0.02)
    assert abs(found.motion.states[-1, 0]) == pytest.approx(2, rel=0.01)


def test_the_shortest_motion_that_reaches_a_goal_is_as_long_as_the_closed_form_says():
    limits = [("push", "0.5 m/s"), ("place", "2 m")]
    goal = Measures(rail.names, dict(zip(rail.names, rail.state_units, strict=True))).goal(
        "scale<0.0025 1/m"
    )
    wanted = Wanted.for_goals(rail, [goal])

    def make(duration):
        grid = Grid.of(duration, 8, 16, False)
        task = Task(rail, wanted, limits_of(rail, limits), grid, rail.noise_at(1 / 20))
        return planned_motion(task, 20.0, np.random.default_rng(0))

    found, shorter = shortest(make, [goal], 1.0, 12.0)
    # 1e-4 / 0.0025² = 16 = 4³/12 + 4 (T − 4): position t/2 up to 2 m, then 2 m
    needed = 4 + (16 - 4**3 / 12) / 4
    assert found.motion.seen.std[1] <= 0.0025
    assert needed * 0.98 < float(found.motion.run.time[-1]) < needed * 1.06
    assert shorter < needed * 1.001
    with pytest.raises(UsageError, match="cannot be reached in 6 s"):
        shortest(make, [goal], 1.0, 6.0)


@dynamics
def seeker(
    push=signal("m/s"),
    read=signal("1"),
    *,
    place=state("m", known=True),
    edge=state("m", start=0.0, std=1.0),
):
    """A reading that changes about an edge, which lies nobody knows exactly where."""
    return Motion(
        rates={"place": push}, outputs=(measured(read, tanh(place - edge), intensity=1e-4),)
    )


def test_for_the_worst_of_several_edges_one_goes_where_each_of_them_may_be(monkeypatch):
    monkeypatch.setattr("casest.plan.motion.planning.RANDOM", 6)
    assert bent(seeker)
    assert not bent(bias_gravity)
    limits = [("push", "1 m/s"), ("place", "3 m")]
    edges = [1.5, -1.5]

    def told(found):
        # ∫ (∂tanh(p − e)/∂e)² dt / 1e-4 along the places of the motion, by hand
        p = found.motion.states[:, 0]
        return [np.sum(np.cosh(p - e) ** -4.0) / 20 / 1e-4 for e in [0.0, *edges]]

    local = told(best(seeker, limits, 8.0, 10))
    found = best(seeker, limits, 8.0, 10, starts=[np.array([0.0, e]) for e in edges], worst=True)
    robust = told(found)
    assert local[0] > robust[0]
    assert min(robust) > 3 * min(local)
    # of each other edge the standard deviation beside that of the likeliest, what is known included
    expected = np.sqrt((1 + robust[0]) / (1 + np.array(robust[1:])))
    assert found.elsewhere == pytest.approx(expected, rel=0.05)


@dynamics
def turntable(
    spin=signal("rad/s"),
    v=signal(3, "m/s"),
    a=signal(3, "m/s^2"),
    *,
    velocity=state(3, "m/s"),
    gravity=state(3, "m/s^2", start=(0.3, 0.2, 9.8), std=10.0),
    bias=state(3, "m/s^2", intensity=1e-9),
):
    """Batista's estimator on a table that turns about one axis."""
    omega = vertcat(0, 0, spin)
    rates = {
        "velocity": a - cross(omega, velocity) + gravity - bias,
        "gravity": -cross(omega, gravity),
    }
    return Motion(rates=rates, outputs=(measured(v, velocity, intensity=1e-6),))


def test_about_one_axis_no_motion_shows_gravity_and_bias(monkeypatch):
    monkeypatch.setattr("casest.plan.motion.planning.STEPS", 8)
    found = best(turntable, [("spin", "1"), ("a", "15")], 10.0, 8)
    assert found.motion.seen.rank == 8  # Batista et al., theorem 2
    (said,) = found.motion.seen.unobservable
    assert said.startswith("gravity and bias along the body axis (0.00, 0.00, 1.00)")


REFUSED = {
    "--limit omega=1": "say how large a may be, --limit 'a=MAX m/s^2'",
    "--limit a=12 --limit omega=1 --limit a=3": "--limit a=… is given twice",
    "--limit a=12 --limit wind=1": "bias-gravity has velocity, gravity, bias, a, omega to limit",
    "--limit a=fast": "--limit 'a=fast': write MAX, or LOW:HIGH",
    "--limit a": "write it as --limit 'omega=30 deg/s'",
    "--limit a=-3": "a limit is above zero",
    "--limit a=3:1": "1 does not lie above 3",
    "--limit 'a=3 kg'": "--limit 'a=3 kg': ",
    "--limit a=12 --limit omega=1 --criterion G": "one can ask for D, A, E or one of velocity",
    "--limit a=12 --limit omega=1 --count 3": "--count is of measurements that are counted",
    "--limit a=12 --limit omega=1 --budget 3": "--budget is of measurements that are counted",
    "--limit a=12 --limit omega=1 --robust worst": "is the same wherever its states begin",
    "--limit a=12 --limit omega=1 --until bais<1": "there is velocity, gravity, bias",
    "--limit a=12 --limit omega=1 --until 'bias<1 s'": "--until 'bias<1 s': ",
    "--limit a=12 --limit omega=1 --until bias<1e-9": "cannot be reached in 5 s: the best motion",
    "--limit a=12 --limit omega=1 --pieces 0": "--pieces 0: from 1 to 400",
    "--limit a=12 --limit omega=1 --pieces 300": "samples for 300 pieces",
    "--limit a=12 --limit omega=1 --searches 0": "--searches 0: at least one",
    "--limit a=12 --limit omega=1 --value velocity=9,9": "velocity begins with 3 numbers",
    "--limit a=12 --limit omega=1 --limit velocity=0.1 --value velocity=9,9,9": "keeps velocity",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_planned_is_refused_in_one_line(words, capsys, monkeypatch):
    monkeypatch.setattr("casest.plan.motion.planning.STEPS", 3)
    monkeypatch.setattr("casest.plan.motion.planning.ROUNDS", 1)
    monkeypatch.setattr("casest.plan.motion.planning.RANDOM", 2)
    monkeypatch.setitem(NEAREST, "max_iter", 3)
    given = ["plan", "bias-gravity", "--duration", "5", "--rate", "10", "--pieces", "5"]
    assert run([*given, *shlex.split(words)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("casest: ")
    assert said.count("\n") == 1
    assert REFUSED[words] in said


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["bias-gravity", "--limit", "a=1"], "say --duration and --rate"),
        (["norm-triangular", "--limit", "v=1"], "--limit is for estimators in motion"),
    ],
)
def test_limits_and_times_belong_to_a_motion(words, why, capsys):
    assert run(["plan", *words]) == 1
    assert why in capsys.readouterr().err
