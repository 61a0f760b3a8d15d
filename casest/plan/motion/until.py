"""The shortest motion that reaches a goal."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from casest.errors import UsageError
from casest.plan.goals import Goal
from casest.plan.motion.planning import MotionPlan

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
    share = missed(found, goals)
    if share > 1:
        best = ", ".join(said(found, goal) for goal in goals)
        raise UsageError(
            f"{' and '.join(map(str, goals))} cannot be reached in {longest:g} s: the best motion "
            f"that was found leaves {best}; a longer --duration, wider limits, or a sensor with "
            "less noise"
        )
    at = longest
    for _ in range(SEARCHES):
        if high / low <= NEAR:
            break
        guess = at * share ** (1 / POWER) * NEAR**0.5
        at = float(np.clip(guess, low * NEAR**0.5, high / NEAR**0.5))
        trial = _made(make, at)
        share = min(missed(trial, goals), MOST) if trial is not None else MOST
        if trial is not None and share <= 1:
            found, high = trial, at
        else:
            low = at
    return found, low


def _made(make: Callable[[float], MotionPlan], duration: float) -> MotionPlan | None:
    """The motion of a duration; None where nothing keeps to the limits in so short a time."""
    try:
        return make(duration)
    except UsageError:
        return None


def missed(plan: MotionPlan, goals: Sequence[Goal]) -> float:
    """The largest standard deviation over what is asked of it: at most 1 where all are reached."""
    return float(max(std_of(plan, goal) / goal.limit for goal in goals))


def std_of(plan: MotionPlan, goal: Goal) -> float:
    """The largest standard deviation among the states that a goal names; infinite if one is not
    determined."""
    own = np.flatnonzero(goal.columns.any(axis=1))
    return float(np.nan_to_num(plan.motion.seen.std[own], nan=np.inf).max())


def said(plan: MotionPlan, goal: Goal) -> str:
    """`bias 0.0012 m/s^2`."""
    return f"{goal.name} {std_of(plan, goal):.3g}{'' if goal.unit == '1' else ' ' + goal.unit}"
