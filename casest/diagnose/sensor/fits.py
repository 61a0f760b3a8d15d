"""A model fitted to all runs, quickly: to be looked at, and to begin the next fit from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.cross_validation import ENOUGH, ITERATIONS, undetermined
from casest.estimate.kink import at_kink
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import scale_of_readings, weighted
from casest.solve.trust_region import trust_region

#: Iterations of a fit that is to stay, and standard deviations that a step may be long there.
LONG, RESTLESS = 100, 1e-2


@dataclass(frozen=True)
class Fit:
    """A model fitted to all runs: values, residuals (N, m) per run, σ from their middle."""

    model: Model
    values: Mapping[str, Array]
    residuals: tuple[Array, ...] = field(repr=False)
    noise: float
    unknowns: int


def fitted(model: Model, runs: tuple[Run, ...], values: Mapping[str, Array]) -> Fit | None:
    """Fit to everything from these values; None where it goes astray."""
    problem = weighted(Problem(model, runs), values)
    count = max(problem.residual_count, 1)
    point = problem.point(values)
    for _ in range(2 if problem.weights is not None else 1):
        found = trust_region(problem, point, max_iterations=ITERATIONS, tolerance=ENOUGH / count)
        point = found.point
        problem = weighted(problem, problem.values(point))
    residuals = problem.residuals(point)
    if not all(np.all(np.isfinite(r)) for r in residuals):
        return None
    freedom = max(problem.residual_count - problem.unknowns, 1)
    noise = scale_of_readings(residuals) * float(np.sqrt(count / freedom))
    return Fit(model, problem.values(point), tuple(residuals), noise, problem.unknowns)


def problem_of(fit: Fit, runs: tuple[Run, ...]) -> tuple[Problem, Point]:
    """The weighted problem of a fit, and where it is."""
    problem = weighted(Problem(fit.model, runs), fit.values)
    return problem, problem.point(fit.values)


def certified(fit: Fit, runs: tuple[Run, ...]) -> Fit | str:
    """The fit, if the data determine it and it is at rest; or why it is refused.

    The last one is proved.
    """
    problem, _ = problem_of(fit, runs)
    found = trust_region(problem, problem.point(fit.values), max_iterations=LONG)
    values = problem.values(found.point)
    why = undetermined(problem, values)
    normal, free = problem.normal(found.point), ~_held(problem, found.point)
    slope, matrix = normal.gradient[free], normal.matrix[np.ix_(free, free)]
    step = np.linalg.lstsq(matrix, slope, rcond=1e-12)[0]
    length = float(np.sqrt(max(float(step @ slope), 0.0)))
    if not why and length > RESTLESS * fit.noise:
        kink = at_kink(problem, found.point, fit.noise)
        if kink is None:
            why = "not a stationary point"
        else:
            values = problem.values(kink)
    return f"its fit is refused: {why}" if why else replace(fit, values=values)


def _held(problem: Problem, point: Point) -> NDArray[np.bool_]:
    """Declared unknowns that lie on a bound and would go beyond: a friction that is none."""
    effects = {p.name for a in problem.model.effects for p in a.parameters}
    lower, upper = problem.bounds
    slope = problem.normal(point).gradient
    held = ((point.x <= lower) & (slope > 0)) | ((point.x >= upper) & (slope < 0))
    for slot in problem.slots:
        held[slot.x] &= slot.parameter.name not in effects
    return np.asarray(held)


def starts(model: Model, runs: tuple[Run, ...], values: Mapping[str, Array]) -> dict[str, Array]:
    """These values as far as the model has them, its own start for the others."""
    problem = Problem(model, runs)
    return {n: values.get(n, v) for n, v in problem.values(problem.start()).items()}


def simpler(full: Fit, plain: Fit | None) -> Fit:
    """The one that is worth more by Schwarz's criterion."""
    if plain is None:
        return full
    n = sum(r.size for r in full.residuals)
    worth = [
        n * np.log(sum(float(np.sum(r**2)) for r in f.residuals)) + f.unknowns * np.log(n)
        for f in (full, plain)
    ]
    return plain if worth[1] < worth[0] else full
