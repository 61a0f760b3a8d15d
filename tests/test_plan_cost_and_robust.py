"""`--budget` and `--robust` beside all designs of a few candidates."""

from __future__ import annotations

import json
from itertools import combinations_with_replacement

import numpy as np
import pytest

from casest.cli import run
from casest.demo import RECORD
from casest.plan.budget import bought
from casest.plan.design.criteria import Trace, Volume
from casest.plan.planning import planned, task
from casest.plan.robust import planned_robustly

RNG = np.random.default_rng(5)
FACTORS = RNG.standard_normal((7, 2, 3))
COST = np.array([1.0, 3.0, 2.0, 1.0, 5.0, 2.0, 1.5])


def test_a_budget_buys_about_the_best_of_all_that_it_could():
    given = task(FACTORS, np.zeros((3, 3)), ["a", "b", "c"], "few")
    found = bought(given, Volume(), COST, 8.0)
    assert COST[list(found.chosen)].sum() <= 8.0 + 1e-9

    def value(chosen):
        return np.linalg.slogdet(given.start + sum(F.T @ F for F in given.factors[list(chosen)]))[1]

    every = (
        c
        for n in range(2, 9)
        for c in combinations_with_replacement(range(7), n)
        if COST[list(c)].sum() <= 8.0
    )
    best = max(value(c) for c in every)
    own = value(found.chosen)
    assert np.exp((own - best) / 6) > 0.98  # geometric mean of standard deviations
    assert np.exp((own - best) / 6) >= found.share - 1e-9  # the bound is one


def test_what_costs_the_same_is_bought_as_it_is_counted():
    given = task(FACTORS, np.zeros((3, 3)), ["a", "b", "c"], "few")
    paid = bought(given, Trace(np.eye(3)), np.full(7, 2.0), 12.0)
    counted = planned(given, Trace(np.eye(3)), 6)
    assert len(paid.chosen) == 6
    assert np.trace(paid.covariances[-1]) <= 1.02 * np.trace(counted.covariances[-1])


class Made:
    def __init__(self, factors):
        self.factors, self.words = factors, ("a", "b", "c", "d", "e", "f", "g")

    def __len__(self):
        return len(self.factors)


@pytest.mark.parametrize("worst", [False, True])
@pytest.mark.parametrize("kind", ["D", "A"])
def test_a_robust_plan_is_about_the_best_of_all_for_the_values_given(worst, kind):
    nominal = task(FACTORS, np.zeros((3, 3)), ["a", "b", "c"], "few")
    drawn = [FACTORS * (1 + 0.5 * RNG.standard_normal(FACTORS.shape)) for _ in range(4)]
    criterion = Volume() if kind == "D" else Trace(np.eye(3))
    found = planned_robustly(nominal, Made, drawn, criterion, 4, worst)

    def value(chosen):
        every = []
        for F in drawn:
            own = (F * nominal.scale)[list(chosen)].reshape(-1, 3)
            C = np.linalg.inv(nominal.start + own.T @ own)
            every.append(np.linalg.slogdet(C)[1] if kind == "D" else np.trace(C))
        return max(every) if worst else np.mean(every)

    best = min(value(c) for c in combinations_with_replacement(range(7), 4))
    own = value(found.chosen)
    share = np.exp((best - own) / 6) if kind == "D" else np.sqrt(best / own)
    assert share > 0.98
    assert share >= found.share - 1e-9


def test_from_the_prompt_a_table_with_costs_is_bought(tmp_path, capsys):
    rng = np.random.default_rng(1)
    up = rng.standard_normal((40, 3))
    v = 9.81 * up / np.linalg.norm(up, axis=1, keepdims=True)
    cost = np.where(v[:, 2] > 0, 1.0, 4.0)
    path = tmp_path / "table.csv"
    np.savetxt(path, np.column_stack([v, cost]), delimiter=",", header="vx,vy,vz,cost", comments="")
    words = ["plan", "norm-triangular", "--set", "norm=9.81", "--candidates", str(path)]
    assert run([*words, "--budget", "20", "--json"]) == 0
    paid = json.loads(capsys.readouterr().out)
    assert paid["cost"] <= 20
    assert paid["budget"] == 20
    assert run([*words, "--count", str(paid["count"]), "--json"]) == 0
    counted = json.loads(capsys.readouterr().out)
    assert counted["cost"] > 20
    for more, why in (
        (["--budget", "0.5"], "the cheapest of 40 candidates costs 1"),
        (["--budget", "3"], "determine 3 of 9 unknowns: a larger one"),
        (["--budget", "20", "--count", "3"], "--count and --budget: one of the two"),
        (["--robust", "worst"], "plan from a result of calibrate"),
        (["--budget", "20", "--robust", "worst"], "--robust goes with --count"),
        (["--budget", "20", "--separate"], "--separate tells causes apart"),
        (["--robust", "worst", "--live", "-"], "leave --robust and --budget out"),
    ):
        assert run([*words, *more]) == 1
        assert why in capsys.readouterr().err


def test_after_a_result_a_robust_plan_says_so(tmp_path, capsys):
    words = ["calibrate", "norm-triangular", str(RECORD), "--columns", "v=ax,ay,az"]
    words += ["--rate", "50", "--at-rest", "--set", "norm=9.80665 m/s^2", "-o", str(tmp_path)]
    assert run(words) == 0
    capsys.readouterr()
    assert run(["plan", str(tmp_path), "--count", "2", "--step", "45", "--robust", "average"]) == 0
    assert "planned and certified averaged over values" in " ".join(capsys.readouterr().out.split())
