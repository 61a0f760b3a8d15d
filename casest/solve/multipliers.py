"""Rounds of multipliers, by which constraints are kept to rounding: `leastsquares.constrained`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.constrained import FIRST, HARDEST, Force
from casest.leastsquares.problem import Point, Problem
from casest.solve.trust_region import LITTLE, trust_region

#: How much harder than the data constraints are held, round by round, and the share of a standard
#: deviation that they may still be off after the last.
WEIGHTS, KEPT = (FIRST, 1e3, HARDEST, HARDEST, HARDEST, HARDEST), 1e-9


def kept(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """The problem with multipliers at its optimum, limits that act held as equations, and that."""
    multipliers: list[Array] = [np.zeros(len(c)) for c, _ in problem.kept_at(point)]
    off = np.inf
    for weight in WEIGHTS:
        problem = problem.forced(point, weight, multipliers)
        assert problem.force is not None
        point = trust_region(problem, point, max_iterations=100, damping=LITTLE).point
        at = problem.kept_at(point)
        before = multipliers
        multipliers = [problem.force.multipliers(r, c) for r, (c, _) in enumerate(at)]
        change = [
            np.abs(own - old) / root
            for own, old, root in zip(multipliers, before, problem.force.root, strict=True)
        ]
        sigma = np.sqrt(2 * problem.cost(point) / max(problem.residual_count, 1))
        if weight == HARDEST and max(map(np.max, change)) <= KEPT * weight * sigma:
            break
        # What is held ten times as hard and gives way no less cannot be kept.
        before_off, off = off, max(np.max(np.abs(c) * root) / weight for (c, _), root in
                                   zip(at, problem.force.root, strict=True))  # fmt: skip
        if off > 0.5 * before_off and off > 1e-3 * sigma:
            break
    return _held(problem, multipliers), point


def _held(problem: Problem, multipliers: list[Array]) -> Problem:
    """The same, limits that act as equations: at the optimum neither passes its corner."""
    old = problem.force
    assert old is not None
    held = tuple(a | (m > 0) for a, m in zip(old.held, multipliers, strict=True))
    shift = tuple(m / root**2 for m, root in zip(multipliers, old.root, strict=True))
    return replace(problem, force=Force(old.root, shift, held))
