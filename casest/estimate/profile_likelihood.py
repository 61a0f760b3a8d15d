"""Fit all unknowns again while one combination of them is held: points and ends of a profile."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.engine import Normal
from casest.leastsquares.problem import Point, Problem
from casest.solve.trust_region import LITTLE, trust_region

#: Weight of the held combination against one residual: error of the hold is its square root's
#: inverse, far below what a profile needs.
HOLD = 1e4
#: An end of an interval is found to this share, in so many tries of so many iterations each.
CLOSE, TRIES, LONGEST = 0.01, 25, 300
#: Gain over the cost of one residual from which on a point of the profile is good enough.
NEAR = 1e-6
#: First step outwards and where to stop, in linear intervals: beyond, standard deviations mean
#: nothing.
FIRST, REACH = 0.5, 4.0


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

    @property
    def residual_count(self) -> int:
        """With the hold's."""
        return self.problem.residual_count + 1

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


def profiled(
    problem: Problem, point: Point, step: Array, row: Array, max_iterations: int = 60
) -> Point:
    """Best point with the combination rowᵀx at its value after the step, all else fitted again."""
    held = Held(problem, row, point.x + step)
    lower, upper = problem.bounds
    start = Point(np.clip(point.x + step, lower, upper), point.references)
    # To rounding the other unknowns need not be known: it is the cost that is looked at.
    near = NEAR / held.residual_count
    return trust_region(
        held, start, max_iterations=max_iterations, tolerance=near, damping=LITTLE
    ).point


@dataclass(frozen=True)
class Profile:
    """The cost around its minimum as one unknown is held at other values.

    `covariance` (n, n) is the linear one and `sigma` that of one residual: they say how far to
    look.
    """

    problem: Problem
    best: Point
    cost: float
    covariance: Array
    sigma: float

    def interval(self, j: int, rise: float) -> tuple[float, float] | None:
        """Distances below and above unknown j at which 2·cost has risen by rise·σ².

        That is the interval of its likelihood, of whatever shape the cost is (Bates & Watts 1988,
        ch. 6). An end beyond a bound is the bound. None where there is none within REACH times the
        linear one.
        """
        below = self._end_or_bound(j, -1, rise)
        above = self._end_or_bound(j, 1, rise) if below is not None else None
        return None if below is None or above is None else (below, above)

    def curve(self, j: int, distances: Array) -> Array:
        """Rise of 2·cost over σ² with unknown j at distances from its best value, (k,).

        Everything else is fitted again; NaN outside the bounds. Each side goes outwards.
        """
        found = np.full(len(distances), np.nan)
        for sign in (-1, 1):
            own = np.flatnonzero(sign * distances >= 0)
            own = own[np.argsort(np.abs(distances[own]))]
            for k, rise in zip(own, self.outwards(j, distances[own]), strict=False):
                found[k] = rise
        return found

    def outwards(self, j: int, distances: Array) -> Iterator[float]:
        """The rise at one distance after the other, each farther out, until a bound is reached."""
        here = self.best
        for distance in distances:
            there = self.held_at(here, j, float(distance)) if distance else self.best
            if there is None:
                return
            here = there
            yield self._rise(here)

    def _end_or_bound(self, j: int, sign: int, rise: float) -> float | None:
        """The end, or the distance to the bound where the cost has not risen so far there."""
        room = float(abs(self.problem.bounds[0 if sign < 0 else 1][j] - self.best.x[j]))
        if np.isfinite(room) and room < REACH * np.sqrt(rise * self.covariance[j, j]):
            there = self.held_at(self.best, j, sign * room * (1 - 1e-9))
            if there is None or self._rise(there) < rise:
                return room
        return self._end(j, sign, rise)

    def _end(self, j: int, sign: int, rise: float) -> float | None:
        """One end: outwards in short steps, each from the last point found, then between two."""
        std, wanted = float(np.sqrt(self.covariance[j, j])), float(np.sqrt(rise))
        linear = wanted * std
        size, height, here = 0.0, 0.0, self.best
        outside: tuple[float, float] | None = None
        step = FIRST * linear
        for _ in range(TRIES):
            if size + step > REACH * linear:
                return None
            there = self.held_at(here, j, sign * (size + step))
            square = self._rise(there) if there else -1.0
            reached = float(np.sqrt(square)) if square >= height**2 else float("inf")
            if abs(reached / wanted - 1) < CLOSE:
                return (size + step) * wanted / reached
            if reached > wanted:  # too far, or into another valley
                outside = size + step, reached
            else:
                size, height, here = size + step, reached, there or here
            step = _next(size, height, outside, wanted, step, 1 / std)
        return None

    def _rise(self, there: Point) -> float:
        """Rise of 2·cost over σ² at a point whose normal equations were asked for on the way."""
        return 2 * (self.problem.normal(there).cost - self.cost) / self.sigma**2

    def held_at(self, point: Point, j: int, distance: float) -> Point | None:
        """Best point with unknown j at a distance from its best value; None outside the bounds."""
        lower, upper = self.problem.bounds
        value = self.best.x[j] + distance
        if not lower[j] < value < upper[j]:
            return None
        row = np.zeros(len(point.x))
        row[j] = self.sigma / np.sqrt(self.covariance[j, j])
        along = self.covariance[:, j] / self.covariance[j, j]
        gone = float(point.x[j] - self.best.x[j])
        # The valley leaves the best point along `along`, and is bent as it was on the way here.
        bent = (point.x - self.best.x - gone * along) / gone**2 if gone else np.zeros_like(along)
        step = self.best.x + distance * along + distance**2 * bent - point.x
        return profiled(self.problem, point, step, row, max_iterations=LONGEST)


def _next(
    size: float,
    height: float,
    outside: tuple[float, float] | None,
    wanted: float,
    step: float,
    slope: float,
) -> float:
    """The next step outwards: within what is known to be too far, else where a height that begins
    with this slope, and is bent as it was so far, comes to what is wanted."""
    if outside is None:
        bent = (height - slope * size) / size**2 if size else 0.0
        root = slope**2 + 4 * bent * wanted
        there = 2 * wanted / (slope + np.sqrt(root)) if root >= 0 else np.inf
        return min(2 * step, float(there) - size) if there > size else 2 * step
    room = outside[0] - size
    if not np.isfinite(outside[1]):
        return 0.5 * room
    share = (wanted - height) / (outside[1] - height)
    return float(np.clip(share, 0.1, 0.9)) * room


def half_width(degrees_of_freedom: int) -> float:
    """Half width of a linear 95 % interval in standard deviations: Student's t."""
    from scipy.special import stdtrit

    return float(stdtrit(max(degrees_of_freedom, 1), 0.975))
