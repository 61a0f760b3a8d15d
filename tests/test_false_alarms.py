"""How often each gate passes noise: its level measured on the gate itself, from both sides.

The gates stand one behind the other, and a loose one is hidden by the next. Here every one is asked
alone, on linear problems whose projections are NumPy's, with noise of a known law.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from casest import Residual, Run, model, param, signal
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.score_test import ScoreSums, ScoreTest, scored
from casest.diagnose.misfit.lack_of_fit import left_over, state_of
from casest.diagnose.motion.score_test import scores as scores_in_motion
from casest.diagnose.motion.sensitivity import Sensitivity
from casest.diagnose.selection.cross_validation import folded
from casest.diagnose.selection.model_evidence import Fitted, by_evidence, confirmed_by_flips
from casest.leastsquares.agreement import between_runs
from casest.leastsquares.problem import Problem

NOBODY = Candidate(None, freed="nobody")


def expected(count, chance):
    """Between which numbers a chance may have come true of so many times: 1 in 1000 outside."""
    return stats.binom.ppf(5e-4, count, chance), stats.binom.ppf(1 - 5e-4, count, chance)


def judged(X, columns, noise, length, candidate=NOBODY):
    """The scores of candidates with these columns, each (N, q), beside the declared X (N, n).

    noise (N,); batches of that length.
    """
    N, n = X.shape
    J = np.hstack([X, *columns])
    residual = noise - X @ np.linalg.lstsq(X, noise)[0]
    scale = np.sqrt(np.sum(J**2, axis=0))
    parts = (J / scale).reshape(-1, length, J.shape[1])
    gradients = np.einsum("bij,bi->bj", parts, residual.reshape(-1, length))
    squares = float(residual @ residual)
    sums = ScoreSums(
        parts.transpose(0, 2, 1) @ parts, np.array(gradients), gradients, scale, (squares, squares)
    )
    declared = np.arange(n)
    inverse = np.linalg.inv(sums.whole[:n, :n])
    test = ScoreTest(sums, declared, inverse, float(np.sqrt(squares / (N - n))), None, 1e-6)
    found, first = [], n
    for G in columns:
        places = np.arange(first, first + G.shape[1])
        found.append(scored(candidate, places, test, N))
        first += G.shape[1]
    return found


def p_values(rng, count, columns, noise, N=400, n=3, length=10):
    """p of one candidate in so many records; `columns(rng)` (N, q), `noise(rng)` (N,)."""
    found = []
    for _ in range(count):
        X = np.c_[np.ones(N), rng.standard_normal((N, n - 1))]
        found.append(judged(X, [columns(rng)], noise(rng), length)[0].p_value)
    return np.array(found)


def white(rng):
    return rng.standard_normal(400)


@pytest.mark.parametrize("unknowns", [1, 3])
def test_a_score_of_white_noise_is_as_significant_as_chance_has_it(unknowns):
    rng = np.random.default_rng(unknowns)
    p = p_values(rng, 1500, lambda r: r.standard_normal((400, unknowns)), white)
    for chance in (0.5, 0.1, 0.05, 0.01):
        low, high = expected(len(p), chance)
        # The inflation is never below that of the residual: a little on the safe side.
        assert 0.6 * low <= np.sum(p < chance) <= high


def coloured(rng):
    white = rng.standard_normal(2600)
    return lfilter([1], [1, -0.7], white)[200:]


def test_a_score_of_coloured_noise_is_no_more_significant():
    """A slow shape beside AR(1) of 0.7, in batches of ten correlation times: it has five times the
    variance that white noise would give it."""
    rng, t = np.random.default_rng(4), np.arange(2400) / 2400

    def slow(r):
        return np.sin(2 * np.pi * (t * r.uniform(0.5, 2) + r.uniform()))[:, None]

    p = p_values(rng, 800, slow, coloured, N=2400, length=60)
    for chance in (0.1, 0.05, 0.01):
        low, high = expected(len(p), chance)
        assert 0.6 * low <= np.sum(p < chance) <= 1.2 * high


def in_few(r):
    """A column that has nearly all of its length in five of forty batches."""
    size = np.where(np.arange(400) < 50, 1.0, 0.02)
    return (size * np.repeat(r.standard_normal(40), 10))[:, None]


def unequal(r):
    return white(r) * np.where(np.arange(400) < 50, 2.0, 1.0)


def test_what_an_effect_explains_of_few_batches_is_given_back():
    """Else their noise would look smaller than it is. Those five are twice as noisy as the others,
    which five alone tell badly: 8 % where 5 % are said, and 12 % if nothing were given back."""
    p = p_values(np.random.default_rng(5), 2500, in_few, unequal)
    assert 0.05 < np.mean(p < 0.05) < 0.1
    even = p_values(np.random.default_rng(6), 600, in_few, white)
    assert 0.01 < np.mean(even < 0.05) < 0.05


def test_what_one_batch_alone_shows_is_never_significant():
    rng = np.random.default_rng(6)

    def columns(r):
        return (white(r) * (np.arange(400) // 10 == 7))[:, None]

    def noise(r):
        return white(r) * np.where(np.arange(400) // 10 == 7, 30.0, 1.0)

    assert np.all(p_values(rng, 50, columns, noise) == 1)


def test_in_few_poses_an_effect_does_not_hide_itself_and_is_not_made_up():
    """24 equations for nine unknowns."""
    rng = np.random.default_rng(7)
    p = p_values(rng, 2500, lambda r: r.standard_normal((24, 1)),
                 lambda r: r.standard_normal(24), N=24, n=9, length=1)  # fmt: skip
    assert 0.02 < np.mean(p < 0.05) < 0.07
    assert np.mean(p < 0.01) < 0.016


def test_of_many_trials_the_best_is_as_significant_as_chance_has_it():
    """Twenty frequencies, levels or moments are tried, and the best is kept."""
    rng, best = np.random.default_rng(8), []
    tried = replace(NOBODY, trials=20)
    for _ in range(300):
        X, G = rng.standard_normal((400, 2)), rng.standard_normal((400, 20))
        columns = [G[:, [k]] for k in range(20)]
        best.append(min(s.p_value for s in judged(X, columns, white(rng), 10, tried)))
    low, high = expected(300, 0.05)
    assert 0.5 * low <= np.sum(np.array(best) < 0.05) <= high
    assert np.sum(np.array(best) < 0.3) >= 0.5 * expected(300, 0.3)[0]


def records(rng, count, candidates=4):
    """Scores of several candidates in records of noise alone."""
    for _ in range(count):
        X = rng.standard_normal((400, 2))
        columns = [rng.standard_normal((400, 1)) for _ in range(candidates)]
        yield judged(X, columns, white(rng), 10)


def test_flipped_signs_pass_noise_as_rarely_as_the_level_says():
    """Of four candidates any: at a chance of 5 %, and at the level of the search, 0.4 %."""
    at_five, at_level = 0, 0
    for found in records(np.random.default_rng(9), 800):
        if confirmed_by_flips(found, found, 0.05):
            at_five += 1
            at_level += bool(confirmed_by_flips(found, found))
    low, high = expected(800, 0.05)
    assert low <= at_five <= high
    low, high = expected(800, 0.004)
    assert max(low, 1) <= at_level <= high


@pytest.mark.parametrize(("N", "chance"), [(300, 0.0622), (3000, 0.0414)])
def test_an_unknown_of_nothing_is_worth_its_price_as_rarely_as_hannan_and_quinn_say(N, chance):
    """χ² of one degree of freedom exceeds 2·log log N: 6.2 % of 300 residuals, 4.1 % of 3000."""
    assert chance == pytest.approx(stats.chi2.sf(2 * np.log(np.log(N)), 1), rel=0.01)
    rng, bought = np.random.default_rng(10), 0
    score = next(records(rng, 1))[0]
    score = replace(score, inflation=1.0)
    for _ in range(2000):
        e, g = rng.standard_normal((2, N))
        less = e - g * (g @ e) / (g @ g)
        with_it, without = (
            Fitted(None, {}, unknowns, (r[:, None],), 1.0) for unknowns, r in ((3, less), (2, e))
        )
        bought += by_evidence([(score, without), (score, with_it)])[0][1] is with_it
    low, high = expected(2000, chance)
    # Far residuals are clipped, which takes nothing of note from a χ².
    assert 0.9 * low <= bought <= 1.1 * high


# -- in motion -------------------------------------------------------------------------------------


def in_motion(rng, count, size=1.0, shape=(1200, 1, 2)):
    """p of a candidate with two numbers beside innovations `size` times as large as said."""
    found = []
    for _ in range(count):
        z = size * rng.standard_normal(shape[:2])
        H = rng.standard_normal(shape)
        L = np.broadcast_to(np.eye(1), (shape[0], 1, 1))
        answers = Sensitivity(z, H, L, np.zeros((1, 2)), (slice(0, 2),))
        found.append(scores_in_motion(answers, [Typical()])[0].p_value)
    return np.array(found)


class Typical:
    """What the score asks of a candidate: the size that it typically has."""

    typical = 1.0


@pytest.mark.parametrize("size", [1.0, 1.6])
def test_innovations_that_are_noise_show_an_effect_as_rarely_as_chance_has_it(size):
    """Also where they are larger than the model says: their scatter between stretches tells."""
    p = in_motion(np.random.default_rng(11), 1500, size)
    for chance in (0.1, 0.05, 0.01):
        low, high = expected(len(p), chance)
        # The larger of two p-values of the same noise
        assert 0.4 * low <= np.sum(p < chance) <= high


def test_innovations_smaller_than_said_show_less():
    p = in_motion(np.random.default_rng(12), 500, 0.5)
    assert np.mean(p < 0.05) < 0.005


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
        state = state_of(problem, point, folded(problem.runs).batches)
        called += left_over(state, problem.residuals(point)).significant
    assert called <= expected(200, 0.005)[1]
