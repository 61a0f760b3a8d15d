"""How much equations amplify where they begin: the unstable and chaotic are followed otherwise."""

from __future__ import annotations

import numpy as np

from casest.leastsquares.problem import Point, Problem

#: From this on a record is not followed from its beginning alone: an error of a thousandth of a
#: state has become as large as the state.
UNSTABLE = 1e3


def growth(problem: Problem, point: Point) -> float:
    """How many times as far two trajectories of a record come apart as they began; infinite where
    they cannot be followed, 1 where the beginning is no unknown, or nothing is integrated."""
    if not problem.model.traced.integrates:
        return 1.0
    most = 1.0
    for r in range(len(problem.runs)):
        states, slopes = problem.given_with_slopes(point, r)
        if not (np.isfinite(states).all() and np.isfinite(slopes).all()):
            return np.inf
        size = np.max(np.abs(states), axis=0, initial=0.0)
        length = np.linalg.norm(slopes / np.where(size > 0, size, 1.0)[:, None], axis=1)
        begun = length[0] > 0
        if begun.any():
            most = max(most, float(np.max(length[:, begun] / length[0, begun])))
    return most
