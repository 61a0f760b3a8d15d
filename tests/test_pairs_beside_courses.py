"""Causes that come in pairs: each must be more than a course of unknown cause beside the other."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from casest.diagnose.evidence.linear import Linear, parts_of
from casest.diagnose.evidence.score import Trial
from casest.diagnose.protocol import pairs, ranked_of
from casest.diagnose.protocol.refits import beyond_courses

N = 1500
S = np.linspace(0, 1, N)
#: What a sensor that is waved about sees of an offset, and of a skew of its axes.
SEEN = np.cos(70 * S) + 0.5 * np.sin(111 * S)
SKEW = np.sin(40 * S) * np.cos(23 * S)


def skew_and_step(course, seed):
    """The ranking beside a fit without skew, and the pair of skew and a step of the offset."""
    y = 5 * SKEW + SEEN * course + np.random.default_rng(seed).standard_normal(N)
    X = np.stack([np.ones(N), SEEN], axis=1)
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    number, span = np.zeros(N, int), (slice(0, N),)
    linear = Linear(
        left[:, None], X[:, None, :], span, parts_of(number, number, np.stack([SEEN, SKEW], axis=1))
    )
    slow = np.polynomial.legendre.legvander(2 * S - 1, 6)[:, 1:] * SEEN[:, None]
    unknown = SimpleNamespace(column=None)
    trials = [
        Trial("skew", "skew", SKEW.reshape(N, 1, 1)),
        Trial(unknown, "course", slow[:, None, :], describes=True),
        Trial("step", "step", (SEEN * (S > 0.4)).reshape(N, 1, 1), 20.0),
    ]
    ranking = ranked_of(linear, trials)
    (pair,) = [e for e in pairs(ranking) if set(e.families) == {"skew", "step"}]
    return ranking, pair


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "course", [np.sin(5.5 * S + 0.6), 1.8 * S], ids=["wander", "straight line"]
)
def test_beside_a_skew_that_is_there_an_offset_that_wanders_is_no_step(course, seed):
    """A skew is nearly all that the pair explains: that is no merit of the step."""
    ranking, pair = skew_and_step(course, seed)
    (alone,) = [e for e in ranking.found if e.families == ("skew",)]
    assert beyond_courses(ranking, alone)
    assert not beyond_courses(ranking, pair)


@pytest.mark.parametrize("seed", range(5))
def test_a_step_beside_a_skew_is_more_than_a_course(seed):
    ranking, pair = skew_and_step(1.2 * (S > 0.4), seed)
    assert ranking.says(pair)
    assert beyond_courses(ranking, pair)
