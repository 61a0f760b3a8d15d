"""Fit all unknowns again while one combination of them is held: one point of a profile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.declaring.shapes import Array
from casest.engine import Normal
from casest.solve.trust_region import trust_region
from casest.stack import Point, Problem

#: Weight of the held combination against one residual: error of the hold is its square root's
#: inverse, far below what a profile needs.
HOLD = 1e4


@dataclass(frozen=True)
class Held:
    """A problem with one more residual, HOLD·(rowᵀ(x − target)), seen through the same methods.

    Unknowns on curved sets are held in the chart of the start, which moves with them: exact for
    plain unknowns, to first order for directions.
    """

    problem: Problem
    row: Array
    target: Array

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Those of the problem."""
        return self.problem.bounds

    def moved(self, point: Point, step: Array) -> Point:
        """As in the problem."""
        return self.problem.moved(point, step)

    def cost(self, point: Point) -> float:
        """Cost with the hold's square."""
        return self.problem.cost(point) + 0.5 * self._miss(point) ** 2

    def normal(self, point: Point) -> Normal:
        """Normal equations with the hold's row."""
        cost, gradient, matrix = self.problem.normal(point)
        row, miss = HOLD * self.row, self._miss(point)
        return Normal(cost + 0.5 * miss**2, gradient + row * miss, matrix + np.outer(row, row))

    def factor(self, point: Point) -> tuple[Array, Array, float]:
        """Triangular factor with one more row."""
        R, t, rest = self.problem.factor(point)
        n = len(t)
        stack = np.zeros((n + 2, n + 1))
        stack[:n, :n], stack[:n, n], stack[n, n] = R, t, rest
        stack[n + 1, :n], stack[n + 1, n] = HOLD * self.row, self._miss(point)
        whole = np.asarray(np.linalg.qr(stack, mode="r"))
        return whole[:n, :n], whole[:n, n], float(abs(whole[n, n]))

    def _miss(self, point: Point) -> float:
        return HOLD * float(self.row @ (point.x - self.target))


def profiled(problem: Problem, point: Point, step: Array, row: Array) -> Point:
    """Best point with the combination rowᵀx at its value after the step, all else fitted again."""
    held = Held(problem, row, point.x + step)
    lower, upper = problem.bounds
    start = Point(np.clip(point.x + step, lower, upper), point.references)
    return trust_region(held, start, max_iterations=60).point
