"""Whether runs agree on what they share: false alarms and power, checked by simulation."""

from __future__ import annotations

import numpy as np
from scipy import stats

from casest import Residual, Run, attempt, model, param, signal
from casest.leastsquares.agreement import between_runs
from casest.leastsquares.problem import Problem
from casest.solve.trust_region import trust_region


@model
def line(x=signal(1), y=signal(1), *, slope=param(), level=param()):
    """A straight line."""
    return Residual(measured=y, predicted=level + slope * x)


def record(rng, slope, level, n=25, name="run"):
    x = rng.uniform(-1, 1, (n, 1))
    y = level + slope * x + 0.3 * rng.standard_normal((n, 1))
    return Run.raw(name, {"x": x, "y": y}, units={"x": None, "y": None})


def three(rng, levels=(1.0, 1.0, 1.0)):
    return [record(rng, 2.0, level, name=n) for level, n in zip(levels, "abc", strict=True)]


def fitted(runs, declared=line):
    return attempt(declared, runs, solver="trust-region")


def test_p_values_of_runs_that_agree_are_uniform():
    """150 fits of three agreeing runs: Kolmogorov and Smirnov find nothing."""
    rng, p = np.random.default_rng(0), []
    for _ in range(150):
        problem = Problem(line, tuple(three(rng)))
        p.append(between_runs(problem, trust_region(problem, problem.start()).point).p_value)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_the_statistic_is_that_of_refitting_every_run():
    """For a linear model the score test is the analysis of variance, to rounding."""
    runs = three(np.random.default_rng(1), (1.0, 1.2, 0.9))
    pooled = fitted(runs)
    alone = sum(2 * fitted([r]).outcomes[0].cost for r in runs)
    together = 2 * pooled.outcomes[0].cost
    F = ((together - alone) / 4) / (alone / (75 - 6))
    scatter = between_runs(pooled.problem, pooled.point)
    assert abs(scatter.F / F - 1) < 1e-9
    assert abs(scatter.p_value / stats.f.sf(F, 4, 69) - 1) < 1e-9


def test_a_run_with_an_offset_of_its_own_is_named():
    found = fitted(three(np.random.default_rng(2), (1.0, 1.0, 2.0)))
    (note,) = [n for n in found.notes if "runs disagree" in n]
    assert "`level` in c" in note
    assert "--per-run" in note


def test_what_differs_from_run_to_run_does_not_disturb_the_test():
    runs = three(np.random.default_rng(3), (1.0, 5.0, -2.0))
    found = fitted(runs, line.scoped("level", "run"))
    assert not any("runs disagree" in n for n in found.notes)
    assert between_runs(found.problem, found.point).p_value > 1e-3


def test_one_run_or_nothing_shared_has_no_scatter():
    runs = three(np.random.default_rng(4))
    alone = fitted(runs[:1])
    assert between_runs(alone.problem, alone.point) is None
    apart = fitted(runs, line.scoped("level", "run").scoped("slope", "run"))
    assert between_runs(apart.problem, apart.point) is None
