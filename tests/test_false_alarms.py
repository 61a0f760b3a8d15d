"""How often each gate passes noise: its level measured on the gate itself, from both sides.

The gates stand one behind the other, and a loose one is hidden by the next. Here every one is asked
alone, on linear problems whose projections are NumPy's, with noise of a known law.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.signal import butter, lfilter

from casest import Residual, Run, model, param, signal
from casest.diagnose.evidence.linear import Linear, parts_of
from casest.diagnose.evidence.score import Trial
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.findings import findings
from casest.diagnose.protocol import falls, holds_out, ranked_of
from casest.leastsquares.agreement import between_runs
from casest.leastsquares.problem import Problem


def expected(count, chance):
    """Between which numbers a chance may have come true of so many times: 1 in 1000 outside."""
    return stats.binom.ppf(5e-4, count, chance), stats.binom.ppf(1 - 5e-4, count, chance)


# -- in a series -----------------------------------------------------------------------------------


def linear_of(noise, X):
    """Residuals (N,) of a fit, with the declared columns X (N, n)."""
    n, number = len(noise), np.zeros(len(noise), dtype=int)
    parts = parts_of(number, number, X[:, 1:] if X.shape[1] > 1 else np.arange(float(n))[:, None])
    return Linear(noise[:, None], X[:, None, :], (slice(0, n),), parts)


def named(linear, trials):
    """Causes that are strong evidence, and those of them that held-out parts confirm."""
    ranking = ranked_of(linear, trials)
    strong = [e for e in ranking.found if ranking.says(e)]
    return strong, [e for e in strong if holds_out(falls(ranking, e), linear)]


def white(rng, n):
    return rng.standard_normal(n)


def coloured(rng, n):
    return lfilter([1], [1, -0.7], rng.standard_normal(n + 200))[200:]


def low_passed(rng, n):
    return lfilter(*butter(2, 0.1), rng.standard_normal(n + 200))[200:] * 5


def unequal(rng, n):
    """Twice as noisy in an eighth of the record."""
    return white(rng, n) * np.where(np.arange(n) < n // 8, 2.0, 1.0)


def heavy(rng, n):
    return rng.standard_t(3, n)


KINDS = {f.__name__: f for f in (white, coloured, low_passed, unequal, heavy)}


@pytest.mark.parametrize(
    ("kind", "records", "most"),
    [("coloured", 12, 1)] + [pytest.param(kind, 100, 4, marks=pytest.mark.long) for kind in KINDS],
)
def test_of_noise_of_any_kind_nothing_is_named(kind, records, most):
    """Thirty causes: ten slow shapes, ten columns that vary as they like, ten that live in an
    eighth of the record. The aim is one alarm in a hundred records; more than four in a hundred
    come by chance once in 250 then, more than two in 25 once in 500."""
    rng, t = np.random.default_rng(sum(kind.encode())), np.arange(400) / 400
    confirmed = 0
    for _ in range(records):
        X = np.c_[np.ones(400), rng.standard_normal(400)]
        shapes = [np.sin(2 * np.pi * (t * rng.uniform(0.5, 3) + rng.uniform())) for _ in range(10)]
        shapes += list(rng.standard_normal((10, 400)))
        shapes += list(rng.standard_normal((10, 400)) * np.where(np.arange(400) < 50, 1.0, 0.02))
        trials = [Trial(k, f"{k}", g[:, None, None]) for k, g in enumerate(shapes)]
        found = named(linear_of(KINDS[kind](rng, 400), X), trials)
        confirmed += bool(found[1])
    assert confirmed <= most


@pytest.mark.long
def test_of_many_variants_the_best_is_named_as_rarely_as_one():
    """Two hundred moments of a step are tried in every record, and the best is kept."""
    rng, alarms = np.random.default_rng(8), 0
    steps = [np.where(np.arange(400) < k, 0.0, 1.0) for k in range(2, 400, 2)]
    for _ in range(40):
        trials = [Trial(k, "step", s[:, None, None], 200.0) for k, s in enumerate(steps)]
        alarms += bool(named(linear_of(white(rng, 400), np.ones((400, 1))), trials)[1])
    assert alarms <= 1


# -- in poses --------------------------------------------------------------------------------------


@pytest.mark.parametrize("records", [80, pytest.param(400, marks=pytest.mark.long)])
def test_in_few_poses_an_effect_does_not_hide_itself_and_is_not_made_up(records):
    """24 equations for nine unknowns: an effect of five deviations of its size."""
    rng, made_up, seen = np.random.default_rng(7), 0, 0
    for _ in range(records):
        X, G = rng.standard_normal((24, 9)), rng.standard_normal(24)
        noise, beyond = rng.standard_normal(24), G - X @ np.linalg.lstsq(X, G)[0]
        for size in (0.0, 6 / np.linalg.norm(beyond)):
            residual = noise + size * G
            linear = replace(linear_of(residual - X @ np.linalg.lstsq(X, residual)[0], X), spans=())
            found = named(linear, [Trial("it", "it", G[:, None, None])])[0]
            made_up, seen = made_up + bool(found and not size), seen + bool(found and size)
    low, high = expected(records, LEVELS.chance)
    assert low <= made_up <= high
    assert seen > 0.95 * records


# -- between runs, and what is left ----------------------------------------------------------------


@model
def straight(x=signal(), y=signal(), *, slope=param(), level=param()):
    return Residual(measured=y, predicted=level + slope * x)


def series(rng, n, share, name="r"):
    x, noise = rng.standard_normal((2, n + 100))
    for k in range(1, len(noise)):
        noise[k] += share * noise[k - 1]
    signals = {"x": x[100:, None], "y": (1 + 2 * x + 0.1 * noise)[100:, None]}
    return Run.raw(name, signals, units={}, time=np.arange(n) * 0.01)


def pooled(runs):
    x, y = (np.concatenate([run.signals[n][:, 0] for run in runs]) for n in "xy")
    slope, level = np.polyfit(x, y, 1)
    problem = Problem(straight, tuple(runs))
    return problem, problem.point({"slope": slope, "level": level})


@pytest.mark.parametrize(("share", "over"), [(0.0, 1.0), (0.6, 4.0)])
def test_runs_that_agree_are_said_to_disagree_as_rarely_as_chance_has_it(share, over):
    """Coloured noise counts as fewer readings. (Of a slope beside white x it is none: so half of
    what is shared feels it, and the test is on the safe side.)"""
    rng, p = np.random.default_rng(13), []
    for _ in range(300):
        problem, point = pooled([series(rng, 150, share, name) for name in "abc"])
        p.append(between_runs(problem, point, over).p_value)
    assert (0.005 if share else 0.01) < np.mean(np.array(p) < 0.05) < 0.09


def test_noise_is_called_a_misfit_as_rarely_as_its_budget_says():
    """Half a percent of records; ten times as many would be ten of 200."""
    rng, called = np.random.default_rng(14), 0
    for _ in range(200):
        problem, point = pooled([series(rng, 200, 0.0)])
        called += bool(findings(problem, point))
    assert called <= expected(200, 0.005)[1]
