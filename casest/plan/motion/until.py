"""The shortest motion that reaches a goal, and the fewest readings of an experiment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.plan.goals import Goal
from casest.plan.motion.experiment import Experiment
from casest.plan.motion.planning import MotionPlan

T = TypeVar("T")

#: Between a duration that reaches the goals and one that does not, at the end; searches at most.
NEAR, SEARCHES = 1.05, 8
#: Power of the duration with which standard deviations are guessed to fall; what is missed at most
#: counts so many times.
POWER, MOST = 1.5, 8.0


def shortest(
    make: Callable[[float], MotionPlan], goals: Sequence[Goal], least: float, longest: float
) -> tuple[MotionPlan, float]:
    """The motion of the shortest duration that reaches every goal, and one at which none was found.

    Durations lie from `least`, which is too short for a motion, to `longest`, s. UsageError where
    the longest motion does not reach them.
    """
    found, low, high = make(longest), least, longest
    share = missed(found.motion.seen.std, goals)
    if share > 1:
        raise UsageError(
            f"{_asked(goals)} cannot be reached in {longest:g} s: the best motion that was found "
            f"leaves {_left(found.motion.seen.std, goals)}; a longer --duration, wider limits, or "
            "a sensor with less noise"
        )
    at = longest
    for _ in range(SEARCHES):
        if high / low <= NEAR:
            break
        guess = at * share ** (1 / POWER) * NEAR**0.5
        at = float(np.clip(guess, low * NEAR**0.5, high / NEAR**0.5))
        trial = _made(partial(make, at))
        share = MOST if trial is None else min(missed(trial.motion.seen.std, goals), MOST)
        if trial is not None and share <= 1:
            found, high = trial, at
        else:
            low = at
    return found, low


def fewest(
    make: Callable[[int], Experiment], goals: Sequence[Goal], most: int
) -> tuple[Experiment, int]:
    """The experiment of the fewest readings that reaches every goal, and so many that none was
    found for. UsageError where `most`, all times, do not reach them."""
    found, low, high = make(most), 0, most
    if missed(stds(found), goals) > 1:
        raise UsageError(
            f"{_asked(goals)} cannot be reached with {most} readings, all that there are: they "
            f"leave {_left(stds(found), goals)}; a longer --duration, a higher --rate, wider "
            "limits, or a sensor with less noise"
        )
    while high - low > 1:
        share = missed(stds(found), goals)
        count = int(np.clip(np.ceil(high * share**2), low + 1, (low + 3 * high) // 4))
        count = min(count, high - 1)
        trial = _made(partial(make, count))
        if trial is not None and missed(stds(trial), goals) <= 1:
            found, high = trial, count
        else:
            low = count
    return found, low


def stds(found: Experiment) -> Array:
    """Standard deviations (n,) after an experiment; zero of what is known."""
    every = np.zeros(len(found.task.model.names))
    every[list(found.task.wanted.free)] = np.sqrt(np.diag(found.after))
    return every


def missed(std: Array, goals: Sequence[Goal]) -> float:
    """The largest standard deviation over what is asked of it: at most 1 where all are reached."""
    return float(max(std_of(std, goal) / goal.limit for goal in goals))


def std_of(std: Array, goal: Goal) -> float:
    """The largest standard deviation among the states that a goal names; infinite if one is not
    determined."""
    own = np.flatnonzero(goal.columns.any(axis=1))
    return float(np.nan_to_num(std[own], nan=np.inf).max())


def _made(make: Callable[[], T]) -> T | None:
    """A plan; None where there is none of this kind: limits, or unknowns that stay open."""
    try:
        return make()
    except UsageError:
        return None


def _asked(goals: Sequence[Goal]) -> str:
    return " and ".join(map(str, goals))


def _left(std: Array, goals: Sequence[Goal]) -> str:
    """`bias 0.0012 m/s^2`."""
    return ", ".join(
        f"{g.name} {std_of(std, g):.3g}{'' if g.unit == '1' else ' ' + g.unit}" for g in goals
    )
