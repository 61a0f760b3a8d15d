"""Many points of one small problem on their way down, all at once."""

from __future__ import annotations

import numpy as np

from casest.data.run import Index
from casest.declaration.shapes import Array
from casest.leastsquares.many_points import Normals, normals
from casest.leastsquares.problem import Point, Problem

#: Damped steps of each; share of the cost below which what is left to gain ends them.
STEPS, ENOUGH = 16, 1e-7


def projected(problem: Problem, first: Point, x: Array, linear: Index) -> tuple[Array, Array]:
    """The linear unknowns at their best for every place, within bounds; costs (inf: none)."""
    lower, upper = (b[linear] for b in problem.bounds)
    there, costs = x.copy(), []
    start = 0
    for part in normals(problem, first.references, x, linear):
        own = slice(start, start + len(part.cost))
        step = _damped_steps(part, np.full(len(part.cost), 1e-9))
        best = np.clip(x[own][:, linear] + step, lower, upper)
        there[own, linear], start = best, own.stop
        step = best - x[own][:, linear]
        bend = 0.5 * np.einsum("pi,pij,pj->p", step, part.matrix, step)
        cost = part.cost + np.einsum("pi,pi->p", step, part.slope) + bend
        costs.append(np.where(np.isfinite(cost), cost, np.inf))
    return there, np.concatenate(costs)


def followed(problem: Problem, first: Point, x: Array) -> tuple[Array, Array]:
    """Where STEPS damped Gauss-Newton steps lead from every place, or as many as gain; costs."""
    lower, upper = problem.bounds
    x, here = x.copy(), _all_normals(problem, first, x)
    damping, going = np.full(len(x), 1e-2), np.arange(len(x))
    for _ in range(STEPS):
        going = going[_to_gain(here.at(going)) > ENOUGH * here.cost[going]]
        if not len(going):
            break
        own = here.at(going)
        trial = np.clip(x[going] + _damped_steps(own, damping[going]), lower, upper)
        there = _all_normals(problem, first, trial)
        better = there.cost < own.cost
        x[going[better]] = trial[better]
        here.put(going[better], there.at(better))
        damping[going] = np.where(
            better, np.maximum(damping[going] * 0.2, 1e-9), damping[going] * 8
        )
    return x, np.where(np.isfinite(here.cost), here.cost, np.inf)


def _to_gain(here: Normals) -> Array:
    """What a step without damping would take off the cost, were the residual linear, (P,)."""
    step = _damped_steps(here, np.full(len(here.cost), 1e-9))
    return np.asarray(-0.5 * np.einsum("pi,pi->p", step, here.slope))


def _all_normals(problem: Problem, first: Point, x: Array) -> Normals:
    parts = list(normals(problem, first.references, x, np.arange(problem.unknowns)))
    return Normals(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _damped_steps(here: Normals, damping: Array) -> Array:
    """Levenberg-Marquardt steps (P, n), each with its own damping; none where it is not finite."""
    scale = np.sqrt(np.maximum(np.einsum("pii->pi", here.matrix), 1e-300))
    system = here.matrix / (scale[:, :, None] * scale[:, None, :])
    slope = here.slope / scale
    good = np.isfinite(system).all(axis=(1, 2)) & np.isfinite(slope).all(axis=1)
    one = np.eye(scale.shape[1])
    system = np.where(good[:, None, None], system, one) + damping[:, None, None] * one
    slope = np.where(good[:, None], slope, 0.0)
    return np.asarray(-np.linalg.solve(system, slope[:, :, None])[:, :, 0] / scale)
