"""`casest plan --separate`: Atkinson and Fedorov's rivals, and causes that a record left open."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import linprog

from casest import Residual, model, param, signal
from casest.cli import run
from casest.diagnose.levels import LEVELS
from casest.errors import UsageError
from casest.plan.candidates.attitudes import directions
from casest.plan.candidates.candidates import Noise
from casest.plan.candidates.rows import settings
from casest.plan.design.continuous import continuous
from casest.plan.design.criteria import Trace
from casest.plan.rivals.rivals import Rival
from casest.plan.rivals.separating import Pair, separated, separation


def test_the_t_optimum_of_atkinson_and_fedorov_is_the_published_one():
    # Biometrika 62 (1975) 57, example 1: 4.5 − 1.5 eˣ − 2 e⁻ˣ against a parabola on [−1, 1]
    grid = np.linspace(-1, 1, 2001)
    truth = 4.5 - 1.5 * np.exp(grid) - 2 * np.exp(-grid)
    factors = np.column_stack([np.ones_like(grid), grid, grid**2, truth])[:, None, :]
    amplitude = Trace(np.array([[0.0], [0], [0], [1]]))
    found = continuous(amplitude, 1e-12 * np.eye(4), factors, 1.0, close=1e-7)
    taken = found.weights > 1e-4
    near = [np.abs(grid - x) < 0.01 for x in (-1.0, -0.669, 0.144, 0.957)]
    assert np.any(near, axis=0)[taken].all()
    weights = [found.weights[x].sum() for x in near]
    assert weights == pytest.approx([0.253, 0.428, 0.247, 0.072], abs=1e-3)
    assert 1 / found.value == pytest.approx(1.087e-3, abs=1e-6)
    # what it leaves is the best approximation by a parabola, and that is a linear program
    parabola = np.column_stack([np.ones_like(grid), grid, grid**2])
    A = np.block([[parabola, -np.ones((len(grid), 1))], [-parabola, -np.ones((len(grid), 1))]])
    best = linprog([0, 0, 0, 1], A, np.append(truth, -truth), bounds=[(None, None)] * 4)
    assert 1 / found.value == pytest.approx(best.fun**2, rel=1e-5)


@pytest.mark.parametrize("known", [0, 3])
def test_the_power_is_that_of_repeated_experiments(known):
    """2 log of the ratio beyond 10, and the fall of squares beyond two of its standard errors
    (Vuong): the second asks for more. What is known is a record with its own lead."""
    rng = np.random.default_rng(known)
    off = np.array([1.0, -2.0, 3.0, 0.5, 2.0, 4.5])  # nothing of it is taken up
    old = np.full(known, 2.0)
    lead = float(np.sum(old**2))
    y = off + rng.standard_normal((100_000, 6))
    ratio = lead + np.sum(y**2, axis=1) - np.sum((y - off) ** 2, axis=1)
    errors = 2 * np.linalg.norm(np.concatenate([old, off]))
    told = (ratio > LEVELS.clear) & (ratio > LEVELS.apart * errors)
    growth = float(np.sum(off**2))
    pair = Pair("a", "b", lead=lead)
    assert pair.power(growth) == pytest.approx(np.mean(told), abs=0.005)
    assert np.mean(told) < np.mean(ratio > LEVELS.clear) - 0.02
    assert pair.power(pair.needed) == pytest.approx(0.95)
    # a cause and none: the ratio alone
    alone = Pair("a", "b", lead=2.0, apart=0.0)
    ratio += 2.0 - lead
    assert alone.power(growth) == pytest.approx(np.mean(ratio > LEVELS.clear), abs=0.005)
    assert alone.power(alone.needed) == pytest.approx(0.95)


@model
def line(x=signal("m"), y=signal("m"), *, a=param("1"), b=param("m")):
    """A line."""
    return Residual(measured=y, predicted=a * x + b)


@model
def bent(x=signal("m"), y=signal("m"), *, a=param("1"), b=param("m"), c=param("1/m")):
    """A line that bends."""
    return Residual(measured=y, predicted=a * x + b + c * x**2)


@model
def turned(x=signal("m"), y=signal("m"), *, a=param("1"), b=param("m")):
    """The same line, counted from elsewhere."""
    return Residual(measured=y, predicted=a * (x + 2) + b)


def rival(of, **values):
    n = len(values)
    values = {name: np.array(v) for name, v in values.items()}
    return Rival(of.name, of, values, 1e-6 * np.eye(n), 0.0)


def made(x):
    noise = Noise(np.array([0.1]), {})
    return noise, lambda one: settings(one.model, one.values, noise, {"x": x[:, None]})


def test_a_bend_is_told_from_a_line_at_the_ends_and_the_middle():
    x = np.linspace(-1, 1, 21)
    noise, make = made(x)
    rivals = [rival(line, a=1.0, b=0.0), rival(bent, a=1.0, b=0.0, c=0.3)]
    # were the line true, the bend would fit as well: only one of the two ways can be refuted
    found = separation(rivals[::-1], noise, make, "bend")
    assert [p.true for p in found.pairs] == ["bent"]
    planned = separated(found, None, 200, "bend")
    assert set(np.round(x[list(planned.chosen)], 3)) <= {-1.0, 0.0, 1.0}
    taken = np.bincount(planned.chosen, minlength=21)
    assert taken[10] == pytest.approx(taken.sum() / 2, abs=2)  # T-optimal: a quarter, half, quarter


def test_an_exact_alias_is_said():
    noise, make = made(np.linspace(-1, 1, 21))
    rivals = [rival(line, a=1.0, b=0.0), rival(turned, a=1.0, b=-2.0)]
    rivals[1].values["b"][...] = -1.5
    with pytest.raises(UsageError, match="line and turned are one under all 21 candidates"):
        separation(rivals, noise, make, "lines")


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """Quadratic response in 24 poses: as well explained otherwise."""
    folder = tmp_path_factory.mktemp("rivals")
    rng = np.random.default_rng(2)
    up = directions(10)
    force = 9.81 * up[rng.choice(len(up), 24, replace=False)]
    force = force + np.array([4e-4, -5e-4, 6e-4]) * force**2
    v = force * [0.98, 1.02, 0.99] + [0.3, -0.2, 0.4] + 0.002 * rng.standard_normal((24, 3))
    np.savetxt(folder / "w.csv", v, delimiter=",", header="vx [m/s^2],vy [m/s^2],vz [m/s^2]",
               comments="")  # fmt: skip
    words = ["close", "norm-triangular", str(folder / "w.csv"), "--set", "norm=9.81"]
    assert run([*words, "-o", str(folder / "out")]) == 0
    return folder / "out"


@pytest.mark.long
def test_causes_that_a_record_left_open_are_told_apart_by_the_plan(closed, capsys):
    effect = json.loads((closed / "result.json").read_text())["effects"][0]
    assert effect["indistinguishable_from"]
    capsys.readouterr()
    assert run(["plan", str(closed), "--separate", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {effect["name"], effect["indistinguishable_from"][0]} <= {
        t["true"] for t in found["separates"]
    }
    assert all(t["chance"] >= 0.95 for t in found["separates"])
    chances = [m["told_apart"] for m in found["measurements"]]
    assert chances[-1] >= 0.95 > chances[0]


@pytest.mark.long
def test_what_cannot_be_told_apart_is_one_sentence(closed, capsys, tmp_path):
    def refused(*words):
        capsys.readouterr()
        assert run(["plan", *map(str, words)]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return said

    assert "2 measurements tell" in refused(closed, "--separate", "--most", 2)
    assert "leave --until" in refused(closed, "--separate", "--until", "offset<1")
    assert "give a result of close" in refused("norm-diagonal", "--separate")


@model
def other(
    x=signal("m"), y=signal("m"), T=signal("K"), *, a=param("1"), b=param("m"), c=param("m/K")
):
    """A line that follows the temperature."""
    return Residual(measured=y, predicted=a * x + b + c * T)


@model
def current(
    x=signal("m"), y=signal("m"), amps=signal("A"), *, a=param("1"), b=param("m"), c=param("m/A")
):
    """A line that follows the current."""
    return Residual(measured=y, predicted=a * x + b + c * amps)


@model
def curved(
    x=signal("m"),
    y=signal("m"),
    T=signal("K"),
    *,
    a=param("1"),
    b=param("m"),
    c=param("m/K"),
    d=param("m/K^2"),
):
    """A line that follows the temperature along a curve."""
    return Residual(measured=y, predicted=a * x + b + c * T + d * T**2)


def test_a_cause_that_contains_another_stays_beside_it_and_the_third_is_told_from_both():
    x, T, amps = (g.ravel() for g in np.meshgrid([-1.0, 0, 1], [-1.0, 0, 1], [-1.0, 0, 1]))
    noise = Noise(np.array([0.1]), {})

    def make(one):
        columns = {"x": x, "T": T, "amps": amps}
        return settings(one.model, one.values, noise, {n: v[:, None] for n, v in columns.items()})

    rivals = [
        rival(other, a=1.0, b=0.0, c=0.2),
        rival(curved, a=1.0, b=0.0, c=0.2, d=0.001),
        rival(current, a=1.0, b=0.0, c=0.2),
    ]
    found = separation(rivals, noise, make, "line")
    assert {(p.true, p.against) for p in found.pairs} == {
        ("other", "current"), ("current", "other"), ("curved", "current"), ("current", "curved")
    }  # fmt: skip
    (left,) = found.together
    assert (left.one, left.other, left.wider) == ("other", "curved", "curved")
    planned = separated(found, None, 200, "line")
    # a reading tells 0.2²/0.1² = 4 at most, and (2·2 + 2·1.645)² = 53.1 are needed
    assert 14 <= len(planned.chosen) <= 16
    # what the line with the current cannot take up of 0.2 m/K, by least squares
    chosen = list(planned.chosen)
    J = np.column_stack([x, np.ones(27), amps])[chosen] / 0.1
    off = 0.2 * T[chosen] / 0.1
    left_over = off - J @ np.linalg.lstsq(J, off, rcond=None)[0]
    growth = dict(
        zip(((p.true, p.against) for p in found.pairs), found.growths(chosen), strict=True)
    )
    assert growth["other", "current"] == pytest.approx(np.sum(left_over**2), rel=1e-4)
    # what was asked of the curve alone would be out of reach
    with pytest.raises(UsageError, match="curved from other, which curved contains, in"):
        separated(separation(rivals[:2], noise, make, "line"), None, 200, "line")


def test_columns_of_a_record_are_varied_in_the_plan_that_tells_their_causes_apart(
    tmp_path, capsys, monkeypatch
):
    """By the command line: temperature and current rose together, one of them acts."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    load, u = np.repeat(np.linspace(0, 100, 6), 5), rng.permutation(np.linspace(0, 1, 30))
    T = 20 + 10 * u + 0.3 * rng.standard_normal(30)
    amps = 1 + 0.5 * u + 0.02 * rng.standard_normal(30)
    y = 3 + 0.5 * load + 0.04 * (T - 25) + 0.05 * rng.standard_normal(30)
    np.savetxt("bench.csv", np.column_stack([load, y, T, amps]), delimiter=",", comments="",
               header="Weight (kg),Bridge (mV),Temp (degC),Heater (A)")  # fmt: skip
    words = ["--columns", "load=Weight", "--columns", "reading=Bridge", "-o", "out"]
    assert run(["close", "load-cell", "bench.csv", *words]) == 0
    capsys.readouterr()
    assert run(["plan", "out", "--separate", "--vary", "load=0:100:50", "-o", "next"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "temperature_bias(Temp)" in said
    assert "channel_bias(Heater)" in said
    assert "append what is measured to the record" in said
    head, first, *_ = (tmp_path / "next" / "plan.csv").read_text().splitlines()
    assert {"load [kg]", "Temp [degC]", "Heater [A]"} <= set(head.split(","))
    row = dict(zip(head.split(","), first.split(","), strict=True))
    # together they rose, so that one goes up and the other down
    assert (float(row["Temp [degC]"]) - 25) * (float(row["Heater [A]"]) - 1.25) < 0


def test_what_stayed_invisible_is_shown_by_a_plan_or_proved_to_be_hidden(
    tmp_path, capsys, monkeypatch
):
    """A cell that is only pressed cannot show another gain for pulling."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    load = np.repeat(np.linspace(0, 100, 6), 5)
    y = 3 + 0.5 * load + 0.05 * rng.standard_normal(30)
    table = np.column_stack([load, y])
    np.savetxt("cell.csv", table, delimiter=",", header="load (kg),reading (mV)", comments="")
    assert run(["calibrate", "load-cell", "cell.csv", "-o", "out"]) == 0

    def plan(*words):
        capsys.readouterr()
        code = run(["plan", "out", "--show", *words])
        said = capsys.readouterr()
        return code, said.out or said.err

    code, said = plan("gain_by_sign", "--vary", "load=0:100:20")
    assert code == 1
    assert "gain_by_sign (k = 0.001) and the model alone are one under all 6 candidates" in said
    code, said = plan("gain_by_sign", "--vary", "load=-100:100:50", "--json")
    assert code == 0
    found = json.loads(said)
    own = next(t for t in found["separates"] if t["true"].startswith("gain_by_sign"))
    assert own["chance"] >= 0.95
    # a gain of 1.001 above zero and 0.999 below (IEEE Std 528): what a straight line leaves of it
    slope = np.polyfit(load, y, 1)[0]
    sigma = float(found["noise"]["sigma"][0])
    planned = np.array([m["signals"]["load"] for m in found["measurements"]])
    every = np.concatenate([load, planned])
    off = np.where(every < 0, 0.002 * slope * every, 0.0)
    off[:30] = 0.0
    J = np.column_stack([np.ones(len(every)), every])
    left = (off - J @ np.linalg.lstsq(J, off, rcond=None)[0]) / sigma
    assert own["growth"] == pytest.approx(np.sum(left**2), rel=0.01)
    assert plan("gain_by_sing", "--vary", "load=0:100:20")[1].startswith("casest: --show gain_by")
    assert "leave --until" in plan("cubic", "--until", "zero<1")[1]
