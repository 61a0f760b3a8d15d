"""Errors in variables: unknowns and true values of the signals in turn, until both stay.

With the true values held the unknowns are a least-squares problem like any other; where neither
moves any more, the gradient in all of them together is zero (`declaration.noise`).
"""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import NotTrusted
from casest.estimate.evidence import Evidence
from casest.leastsquares.neighbours import scatter
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.stated import at_true_values, in_usual_units, settles
from casest.leastsquares.weights import has_noise_effects
from casest.solve.outcome import Outcome
from casest.solve.strategy import best_of, solve
from casest.solve.trust_region import LITTLE, trust_region

#: Turns at most, and the move of the unknowns in their standard deviations that is none.
TURNS, STILL = 60, 1e-6
#: Turns that are looked back at to see where they lead (Anderson 1965).
MEMORY = 5


def solved(
    problem: Problem, first: Point, *, solver: str, seed: int, automatic: bool
) -> tuple[Problem, tuple[Outcome, ...]]:
    """As `solve` has it; where that only says where the turns begin and there is one valley, which
    every way leads into, the quickest way alone."""
    if settles(problem.model) and problem.parabolic and not has_noise_effects(problem.model):
        near = 1e-6 / problem.residual_count  # the turns go on from there
        return problem, (trust_region(problem, first, tolerance=near),)

    def vouched(point: Point) -> bool:
        return Evidence(scatter(problem, point)).vouched

    return solve(problem, first, solver=solver, seed=seed, automatic=automatic, vouched=vouched)


def with_errors_of_inputs(
    problem: Problem, outcomes: tuple[Outcome, ...], solver: str, seed: int
) -> tuple[Problem, tuple[Outcome, ...]]:
    """The problem with its true values at the optimum, and the outcomes there.

    As it is where no noise was stated, or none that depends on the unknowns.
    """
    noise = problem.model.noise
    if noise is None or not settles(problem.model):
        return problem, outcomes
    point, steps, ends, size = best_of(outcomes).point, list[Array](), list[Point](), np.inf
    for _ in range(TURNS):
        problem = at_true_values(problem, point)
        end = _end(problem, point)
        step = problem.difference(end, point)
        size = float(np.linalg.norm(problem.factor(end)[0] @ step) / noise.scale)
        if size <= STILL:
            problem = in_usual_units(problem)
            first = problem.point(problem.values(end))
            return solve(problem, first, solver=solver, seed=seed)
        steps, ends = [*steps, step][-MEMORY:], [*ends, end][-MEMORY:]
        point = _ahead(problem, steps, ends)
    raise NotTrusted(
        f"{problem.model.name}: the true values of {', '.join(noise.signals)} do not settle (the "
        f"unknowns still move by {size:.1g} standard deviations): the noise is as large as what "
        "the model bends over; average readings, or state less noise"
    )


def _end(problem: Problem, point: Point) -> Point:
    """Where a turn ends: of a parabola that a look at the samples tells, a step away."""
    R, t, _ = problem.factor(point)
    if problem.told:
        end = problem.moved(point, -np.asarray(np.linalg.solve(R, t)))
        lower, upper = problem.bounds
        if np.all((end.x >= lower) & (end.x <= upper)):
            return end
    return trust_region(problem, point, damping=LITTLE).point


def _ahead(problem: Problem, steps: list[Array], ends: list[Point]) -> Point:
    """Where turns lead to: the combination of their ends whose combined step is least."""
    last, R = ends[-1], problem.factor(ends[-1])[0]
    if len(steps) == 1:
        return last
    change = np.stack([steps[-1] - step for step in steps[:-1]], axis=1)
    weights = np.linalg.lstsq(R @ change, R @ steps[-1], rcond=1e-8)[0]
    apart = np.stack([problem.difference(last, end) for end in ends[:-1]], axis=1)
    return problem.moved(last, problem.inside(last.x - apart @ weights) - last.x)
