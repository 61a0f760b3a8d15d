"""A least cost with a kink in it: the best threshold may be the very input of a row, the best lag a
whole number of samples.

There the slope jumps, no slope is zero, and steps along either one lead upwards at once. What
proves such a least cost is that zero lies between the slopes around it (F. Clarke, 1983); what
leads there is the shortest of all that lie between those nearby (J. Burke, A. Lewis, M. Overton,
2005).
"""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.reasons import STEP
from casest.leastsquares.problem import Point, Problem

#: How far from a point slopes are taken that count as its own, in standard deviations of an
#: unknown: as far as the longest step that counts as none; and of those that lead to a kink.
BESIDE, NEARBY = STEP, 0.01
#: How many times the distance a slope has to change over it, which is twice where it is smooth.
JUMP = 4.0
#: Steps to a kink, and halvings of one of them.
STEPS, HALVINGS = 60, 20
#: Weight of the sum of shares, which is one, against the slopes in a least-squares problem.
SUM = 1e6


def at_kink(problem: Problem, point: Point, sigma: float) -> Point | None:
    """The least cost nearby where it has a kink there; None where it has none. `sigma`: standard
    deviation of one residual."""
    R = problem.factor(point)[0]
    lengths = np.linalg.norm(R, axis=0)
    if not (
        np.isfinite(R).all() and lengths.all() and np.linalg.matrix_rank(R / lengths) == len(R)
    ):
        return None
    lower, upper = problem.bounds
    if not _kinks(problem, point, R, NEARBY * sigma):
        return None
    beside = NEARBY
    for _ in range(STEPS):
        slope, _ = _between(problem, point, R, beside * sigma)
        left = float(np.linalg.norm(slope)) / sigma
        if left < STEP and beside <= BESIDE:
            return point
        step: Array = np.asarray(-np.linalg.solve(R, slope))
        here = problem.cost(point)
        for _ in range(HALVINGS if left >= STEP else 0):
            there = problem.moved(point, step)
            inside = bool(np.all((there.x > lower) & (there.x < upper)))
            if inside and problem.cost(there) < here:
                point = there
                break
            step = step / 2
        else:
            if beside <= BESIDE:
                return None
            beside = max(beside / 10, BESIDE)
    return None


def left_at_kink(problem: Problem, point: Point, sigma: float) -> tuple[float, str] | None:
    """The step left, in standard deviations, by the shortest slope between those around a point,
    and an unknown that has a kink there; None where there is none."""
    R = problem.factor(point)[0]
    slope, kinks = _between(problem, point, R, BESIDE * sigma)
    left = float(np.linalg.norm(slope)) / sigma
    return (left, problem.names[kinks[0]]) if kinks and left < STEP else None


def _kinks(
    problem: Problem, point: Point, R: Array, distance: float
) -> dict[int, tuple[Array, Array]]:
    """Unknowns towards which the cost falls from both sides by a slope that jumps, and its slopes
    there: `distance` over the length of an unknown's column of J away."""
    found = {}
    for j, size in enumerate(np.linalg.norm(R, axis=0)):
        step = np.zeros(len(point.x))
        step[j] = distance / size
        below, above = (problem.normal(problem.moved(point, s)).gradient for s in (-step, step))
        if below[j] < 0 < above[j] and above[j] - below[j] > JUMP * distance * size:
            found[j] = below, above
    return found


def _between(
    problem: Problem, point: Point, R: Array, distance: float
) -> tuple[Array, tuple[int, ...]]:
    """The shortest R⁻ᵀ·slope of all between those around a point, and the unknowns with kinks, that
    with the largest jump first."""
    from scipy.optimize import nnls

    kinks = _kinks(problem, point, R, distance)
    slopes = [problem.normal(point).gradient, *(s for pair in kinks.values() for s in pair)]
    each = np.linalg.solve(R.T, np.array(slopes).T)
    size = max(float(np.linalg.norm(each, axis=0).max()), 1e-300)
    ones = np.full((1, each.shape[1]), SUM)
    share = nnls(np.vstack([each / size, ones]), np.append(np.zeros(len(R)), SUM))[0]
    lengths = np.linalg.norm(R, axis=0)
    jump = {j: float(above[j] - below[j]) / lengths[j] for j, (below, above) in kinks.items()}
    return each @ (share / share.sum()), tuple(sorted(jump, key=lambda j: -jump[j]))
