"""`casest plan` of equations: inputs and times, beside closed forms and brute force."""

from __future__ import annotations

import csv
import json
from itertools import combinations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from casest.cli import run

DECAY = """
from casest import param, signal
from casest.dynamics import Motion, dynamics, measured, state


@dynamics
def decay(
    y=signal(),
    *,
    x=state(start=2.0, known=True),
    k=param("1/s", start=0.5),
):
    return Motion(rates={"x": -k * x}, outputs=(measured(y, x, std=0.01),))


@dynamics
def fading(
    y=signal(),
    *,
    x=state(start=2.0),
    k=param("1/s", start=0.5),
):
    return Motion(rates={"x": -k * x}, outputs=(measured(y, x, std=0.01),))


@dynamics
def heated(
    power=signal("W", held=True),
    y=signal("K"),
    *,
    warm=state("K", known=True),
    capacity=param("J/K", start=4.0),
    leak=param("1/s", start=0.2),
):
    rates = {"warm": power / capacity - leak * warm}
    return Motion(rates=rates, outputs=(measured(y, warm, std=0.1),))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("equations")
    (made / "eq.py").write_text(DECAY, encoding="utf-8")
    return made


def planned(folder, capsys, words):
    capsys.readouterr()
    code = run(["plan", *words.replace("eq.py", str(folder / "eq.py")).split(), "--json"])
    said = capsys.readouterr()
    assert code == 0, said.err
    return json.loads(said.out)


def test_one_reading_of_a_decay_is_best_after_its_time_constant(folder, capsys):
    found = planned(folder, capsys, "eq.py:decay --duration 8 --rate 10 --count 1")
    assert found["times"] == [pytest.approx(2.0)]
    # x = 2 exp(−kt), dx/dk = −t x: at t = 1/k
    assert found["unknowns"]["k"]["after"] == pytest.approx(0.01 / (2 * 2 * np.exp(-1)), rel=1e-3)


def test_where_the_beginning_is_unknown_too_it_is_read_as_well(folder, capsys):
    found = planned(folder, capsys, "eq.py:fading --duration 8 --rate 10 --count 2")
    assert found["times"] == pytest.approx([0, 2.0])
    assert found["best_possible"]["share_of_std"] == pytest.approx(1)


def test_times_are_those_of_brute_force(folder, capsys):
    found = planned(folder, capsys, "eq.py:fading --duration 6 --rate 5 --count 3 --criterion A")
    t = np.arange(31) / 5
    J = np.column_stack([np.exp(-t / 2) * 2, -t * 2 * np.exp(-t / 2) * 0.5]) / 0.01  # k·d/dk
    J[:, 0] /= 2  # the beginning in its own unit, k in units of itself
    every = list(combinations(range(31), 3))
    worth = [np.trace(np.linalg.inv(J[list(c)].T @ J[list(c)] + 1e-10 * np.eye(2))) for c in every]
    best = every[int(np.argmin(worth))]
    assert found["times"] == pytest.approx(t[list(best)])


def test_the_standard_deviations_are_those_of_slopes_that_scipy_computes(folder, capsys, tmp_path):
    words = (
        f"eq.py:heated --duration 12 --rate 4 --pieces 4 --count 5 --limit power=0:10 -o {tmp_path}"
    )
    found = planned(folder, capsys, words)
    held = found["inputs"]["power"]

    def read(capacity, leak):
        def slope(t, x):
            k = np.searchsorted(held["since"], t + 1e-12, "right") - 1
            return held["value"][k][0] / capacity - leak * x

        out = solve_ivp(
            slope, (0, 12), [0.0], rtol=1e-10, atol=1e-12, max_step=0.1, dense_output=True
        )
        return out.sol(found["times"])[0]

    h = 1e-4
    J = np.column_stack([
        (read(4 + h, 0.2) - read(4 - h, 0.2)) / (2 * h),
        (read(4, 0.2 + h) - read(4, 0.2 - h)) / (2 * h),
    ])  # fmt: skip
    std = np.sqrt(np.diag(np.linalg.inv(J.T @ J / 0.01)))
    said = [found["unknowns"][name]["after"] for name in ("capacity", "leak")]
    assert said == pytest.approx(std, rel=1e-3)
    rows = list(csv.reader((tmp_path / "plan.csv").read_text(encoding="utf-8").splitlines()))
    assert rows[0] == ["t [s]", "power [W]", "y [K]"]
    due = [row for row in rows[1:] if row[2]]
    assert [float(row[0]) for row in due] == pytest.approx(found["times"])
    assert [float(row[2]) for row in due] == pytest.approx(read(4, 0.2), rel=1e-3)
    assert "When to read" in (tmp_path / "plan.html").read_text(encoding="utf-8")


def test_inputs_are_no_worse_than_any_of_a_grid(folder, capsys):
    found = planned(
        folder,
        capsys,
        "eq.py:heated --duration 12 --rate 1 --pieces 3 --count 13 --limit power=0:10",
    )
    t = np.arange(13.0)

    def worth(levels):
        slopes = []
        for c, leak in ((4 + 1e-5, 0.2), (4 - 1e-5, 0.2), (4, 0.2 + 1e-5), (4, 0.2 - 1e-5)):
            x, seen = 0.0, [0.0]
            for k in range(12):
                end = levels[k // 4] / c / leak
                x = end + (x - end) * np.exp(-leak)
                seen.append(x)
            slopes.append(np.array(seen))
        J = np.column_stack([slopes[0] - slopes[1], slopes[2] - slopes[3]]) / 2e-5 / 0.1
        return np.linalg.slogdet(J.T @ J)[1]

    grid = [0.0, 2.5, 5.0, 7.5, 10.0]
    best = max(worth((a, b, c)) for a in grid for b in grid for c in grid)
    own = worth([v[0] for v in found["inputs"]["power"]["value"]])
    assert own > best - 1e-3
    assert len(t) == found["count"]


@pytest.mark.parametrize("how", ["average", "worst"])
def test_a_robust_plan_is_the_best_for_the_values_that_were_drawn(folder, capsys, how, monkeypatch):
    kept = []
    import casest.cli.experimenting as cli

    drawn = cli._possible
    monkeypatch.setattr(cli, "_possible", lambda *a: kept.extend(drawn(*a)) or kept)
    words = f"eq.py:decay --duration 8 --rate 10 --count 1 --std k=0.3 --robust {how}"
    found = planned(folder, capsys, words)
    t, k = np.arange(81) / 10, np.array([x[1] for x in kept])
    assert len(k) == 8
    assert np.std(k) > 0.1
    log_variance = -np.log(1 / 0.3**2 + (2 * t[:, None] * np.exp(-k * t[:, None]) / 0.01) ** 2)
    over = log_variance.max(axis=1) if how == "worst" else log_variance.mean(axis=1)
    assert found["times"] == [pytest.approx(t[int(np.argmin(over))])]
    assert found["robust"] == how


def test_a_goal_takes_the_fewest_readings_that_reach_it(folder, capsys):
    words = "eq.py:decay --duration 8 --rate 10 --until k<0.0025"
    found = planned(folder, capsys, words)
    t = np.arange(81) / 10
    # of one unknown the readings add up: the best ones are those that tell most
    told = np.cumsum(np.sort((2 * t * np.exp(-t / 2) / 0.01) ** 2)[::-1])
    fewest = int(np.argmax(told >= 1 / 0.0025**2)) + 1
    assert found["count"] == fewest > 1
    assert found["too_few"] == fewest - 1
    assert found["goals"][0]["after"] == pytest.approx(told[fewest - 1] ** -0.5, rel=1e-3)


def test_after_a_fit_the_plan_goes_on_from_what_it_knows(folder, capsys, tmp_path):
    rng = np.random.default_rng(0)
    t = np.linspace(0, 5, 21)
    rows = np.column_stack([t, 2 * np.exp(-0.55 * t) + 0.01 * rng.standard_normal(21)])
    np.savetxt(tmp_path / "d.csv", rows, delimiter=",", header="t,y", comments="")
    out = tmp_path / "out"
    assert (
        run(["calibrate", f"{folder / 'eq.py'}:decay", str(tmp_path / "d.csv"), "-o", str(out)])
        == 0
    )
    found = planned(folder, capsys, f"{out} --duration 8 --rate 10 --count 1")
    before = json.loads((out / "result.json").read_text())["estimate"]["parameters"]["k"]
    k = found["unknowns"]["k"]
    assert k["before"] == pytest.approx(before["std"], rel=0.05)
    assert found["times"] == [pytest.approx(1 / before["value"], abs=0.06)]
    assert k["after"] < k["before"]


REFUSED = {
    "eq.py:decay --count 1": "say --duration, and with --rate how often",
    "eq.py:decay --duration 8 --rate 10 --count 100": "--count 100: from 1 to 81",
    "eq.py:fading --duration 8 --rate 10 --count 1": "1 readings do not determine every unknown",
    "eq.py:heated --duration 8 --rate 10": "say how large power may be, --limit 'power=MAX W'",
    "eq.py:heated --duration 8 --rate 1 --pieces 3 --limit power=1": "a whole number for each",
    "eq.py:decay --duration 8 --rate 10 --robust worst": "--std k=NUMBER",
    "eq.py:decay --duration 8 --rate 10 --until k<1e-6": "k<1e-06 1/s cannot be reached with 81",
    "eq.py:decay --duration 8 --rate 10 --until x<1": "x is known from the beginning",
    "eq.py:decay --duration 8 --rate 10 --until k<1 --robust worst": "not with --until",
    "eq.py:decay --duration 8 --rate 10 --sensor-noise x=1": "decay reads y",
    "eq.py:decay --duration 8 --rate 10 --reach 30": "--reach is of measurements",
    "eq.py:decay --duration -8 --rate 10": "--duration -8: a number above zero",
    "eq.py:decay --duration 8 --rate 10 --criterion x": "D, A, E or one of k",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_planned_is_refused_in_one_line(folder, words, capsys):
    assert run(["plan", *words.replace("eq.py", str(folder / "eq.py")).split()]) == 1
    said = capsys.readouterr().err
    assert said.startswith("casest: ")
    assert said.count("\n") == 1
    assert REFUSED[words] in said
