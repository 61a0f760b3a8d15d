"""Does an estimate keep to the constraints of its model, and do the data agree with them?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casest.estimate import reasons as words
from casest.estimate.certificate import Certificate
from casest.estimate.reasons import Code
from casest.leastsquares.problem import Point, Problem

#: Share of a standard deviation, and of its own size, by which a constraint may be off.
KEPT, ROUNDING = 1e-4, 1e-8
#: Chance that noise alone pulls so hard at constraints that hold: that of a bound.
CHANCE = 1e-3


def keeping(
    problem: Problem, point: Point, sigma: float, correlated_over: float, found: Certificate
) -> Certificate:
    """The certificate with what there is to say of constraints, for it or against."""
    if problem.constraints is None or problem.force is None:
        return found
    from scipy.special import chdtrc

    if worst := _passed(problem, point, sigma):
        return found.refused(Code.BOUND, words.not_kept(*worst))
    pull, count = _pull(problem, point, sigma), problem.kept_count
    pull /= np.sqrt(correlated_over)
    if count and chdtrc(count, pull**2) < CHANCE:
        return found.refused(Code.BOUND, words.pulled(pull))
    acting = int(sum(np.sum(held) for held in problem.force.held))
    every = int(sum(map(len, problem.force.held)))
    said = words.kept(acting, every, pull)
    return replace(found, reasons=(*found.reasons, said)) if found.trusted else found


def _passed(problem: Problem, point: Point, sigma: float) -> tuple[str, float, str] | None:
    """The constraint that is off most, its value, and where; None where all are kept."""
    assert problem.constraints is not None
    matrix = problem.normal(point).matrix
    variance = sigma**2 / np.maximum(np.diag(matrix), 1e-300)
    most, worst = 1.0, None
    for run, (c, slopes) in zip(problem.runs, problem.kept_at(point), strict=True):
        off = np.where(problem.constraints.limit(len(run)), np.maximum(-c, 0.0), np.abs(c))
        own = ROUNDING * (np.abs(slopes) @ np.abs(point.x))
        over = off / np.maximum(KEPT * np.sqrt(slopes**2 @ variance), own + 1e-300)
        k = int(np.nanargmax(over))
        if over[k] > most:
            name, sample = problem.constraints.named(k)
            where = "" if sample is None else f" in row {int(run.rows[sample])}"
            most, worst = float(over[k]), (name, float(c[k]), where)
    return worst


def _pull(problem: Problem, point: Point, sigma: float) -> float:
    """How far the data would go without the constraints, in standard deviations."""
    assert problem.force is not None
    force = np.zeros(problem.unknowns)
    for r, (c, slopes) in enumerate(problem.kept_at(point)):
        force += problem.force.multipliers(r, c) @ slopes
    matrix = problem.of_runs(point).matrix
    size = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    inner = np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-10, hermitian=True)
    square = float((force / size) @ inner @ (force / size))
    return float(np.sqrt(max(square, 0.0))) / max(sigma, 1e-300)
