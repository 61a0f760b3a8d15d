"""Scaled Levenberg-Marquardt within bounds, on triangular factors (Moré 1978; Nielsen 1999).

Works on R and Qᵀr instead of JᵀJ, so that it can polish a solution to the last digits: the
condition number is not squared.
"""

from __future__ import annotations

import time
from typing import NamedTuple, cast

import numpy as np

from casest.declaration.shapes import Array
from casest.engine import Normal
from casest.leastsquares.problem import Point
from casest.solve.outcome import LeastSquares, Outcome

#: Relative gain from which on the normal equations' squared condition number may tell.
ROUGH = 1e-5
#: Damping that does not slow what data determine, yet keeps steps along what they do not short.
LITTLE = 1e-7
#: Residuals from which on a QR factor is too dear for a step far away.
LONG = 5000
#: Residuals up to which their cost alone takes as long as with slopes.
BRIEF = 500
#: Share of the residual in the Jacobian's reach that is left to rounding.
SETTLED = 1e-12
#: Share of the cost below which no gain shows in it: whether it was one nobody can tell.
HIDDEN = 1e-16
#: Share of the cost that integration moves it by where steps are chosen anew at every point: lower
#: by less than this is no better than where the slope ends.
ASTRAY = 1e-8
#: Dampings of the steps from a place that is asked whether it has settled.
DAMPED = (0.0, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)
#: Range of dampings in which a wary run looks for that of its radius.
DAMPINGS = (1e-24, 1e24)


class _Fine(NamedTuple):
    """Linearisation at a point for the last digits: J = QR, t = Qᵀr, cost."""

    R: Array
    t: Array
    cost: float

    def finite(self) -> bool:
        """Is there nothing in it that is not finite?"""
        return bool(np.isfinite(self.cost) and np.isfinite(self.R).all())

    def norms(self) -> Array:
        """Length of each column of J; 1 where there is none."""
        return _lengths(np.linalg.norm(self.R, axis=0))

    def gain(self, step: Array) -> float:
        """What a step is promised to take off the cost."""
        return 0.5 * float(self.t @ self.t - np.sum((self.t + self.R @ step) ** 2))

    def damped(self, scale: Array, damping: float, free: Array, step: Array) -> Array:
        """Levenberg-Marquardt step of the free unknowns, the others' given."""
        count, fixed = int(free.sum()), np.logical_not(free)
        # Unit columns: scales that differ by orders of magnitude must not reach the rank decision.
        system = np.zeros((len(self.R) + count, count + 1))
        system[:-count, :-1] = self.R[:, free] / scale[free]
        system[:-count, -1] = -(self.t + self.R[:, fixed] @ step[fixed])
        np.fill_diagonal(system[-count:], np.sqrt(damping))
        if not np.isfinite(system).all():
            return np.full(count, np.nan)
        return np.asarray(_least_squares(system) / scale[free])


class _Rough(NamedTuple):
    """Linearisation far away: JᵀJ, which is well conditioned, Jᵀr, cost."""

    matrix: Array
    gradient: Array
    cost: float

    def finite(self) -> bool:
        """It is, or it would not be used."""
        return bool(np.isfinite(self.cost))

    def norms(self) -> Array:
        """Length of each column of J; 1 where there is none."""
        return _lengths(np.sqrt(self.matrix.diagonal()))

    def gain(self, step: Array) -> float:
        """What a step is promised to take off the cost."""
        return -float(step @ (self.gradient + 0.5 * (self.matrix @ step)))

    def damped(self, scale: Array, damping: float, free: Array, step: Array) -> Array:
        """Levenberg-Marquardt step of the free unknowns, the others' given."""
        slope, matrix = self.gradient, self.matrix
        if not free.all():
            slope = (slope + matrix @ np.where(free, 0.0, step))[free]
            matrix, scale = matrix[np.ix_(free, free)], scale[free]
        system = matrix / np.outer(scale, scale)
        system.flat[:: len(scale) + 1] += damping
        try:
            return np.asarray(np.linalg.solve(system, -slope / scale) / scale)
        except np.linalg.LinAlgError:
            return np.full(len(slope), np.nan)


_Local = _Fine | _Rough


def trust_region(
    problem: LeastSquares,
    start: Point,
    *,
    max_iterations: int = 300,
    tolerance: float = 0.0,
    damping: float = 1e-3,
    wary: bool = False,
) -> Outcome:
    """Minimise the cost from `start` until steps and gains are at rounding.

    With a `tolerance` only until an undamped step gains no more than this share of the cost. Near
    a solution begin with a small `damping`. A `wary` run holds every step within a radius, which
    begins at the size of the unknowns (Moré 1978): slower, but it stays in a narrow valley that
    damping alone leaves, and does not jump across one.
    """
    began = time.perf_counter()
    point, here, precise = start, _rough(problem, start), False
    scale = here.norms()
    size = float(np.linalg.norm(scale * start.x)) or float(np.sqrt(2 * here.cost))
    radius = size if wary else np.inf
    growth, evaluations, status = 2.0, 1, "iteration limit"
    brief = problem.residual_count <= BRIEF
    iterations = 0
    while iterations < max_iterations:
        iterations += 1
        if not here.finite():
            status = "cost or slope is not finite"
            break
        scale = np.maximum(scale, here.norms())
        if wary:
            damping = _damping_within(problem, point, here, scale, radius)
        step = _bounded_step(problem, point, here, scale, damping)
        if not np.all(np.isfinite(step)):
            status = "step is not finite"
            break
        gain = here.gain(step)
        if not precise and gain <= ROUGH * here.cost:
            precise, here = True, _fine(problem, point)
            continue
        if _negligible(step, point, scale, here, gain) or (
            damping < 1 and gain <= tolerance * here.cost
        ):
            status = "converged"
            break
        trial = problem.moved(point, step)
        # Most steps descend, and their slope is wanted with the cost: far away in any case, near
        # the end where that takes hardly longer.
        normal = problem.normal(trial) if brief or not precise else None
        there = problem.cost(trial) if normal is None else normal.cost
        evaluations += 1
        ratio = (here.cost - there) / max(gain, 1e-300) if np.isfinite(there) else -1.0
        if ratio < 0.25:
            radius = min(radius, 0.25 * float(np.linalg.norm(scale * step))) if wary else radius
        elif ratio > 0.75:
            radius = max(radius, 2 * float(np.linalg.norm(scale * step)))
        if ratio > 0:
            point = trial
            here = _fine(problem, trial) if precise else _rough(problem, trial, normal)
            damping = _relieved(damping, ratio)
            growth = 2.0
        else:
            damping, growth = damping * growth, growth * 2
            if gain <= HIDDEN * here.cost:
                status = "converged"
                break
            if damping > 1e20:
                status = "no descent"
                break
    if not tolerance:
        exact = here if precise and isinstance(here, _Fine) else _fine(problem, point)
        point, here = _refine(problem, point, exact, scale) if exact.finite() else (point, exact)
    claims = status in ("converged", "no descent")
    seconds = time.perf_counter() - began
    return Outcome(
        "trust-region", point, here.cost, iterations, evaluations, claims, status, seconds
    )


def slight(problem: LeastSquares) -> float:
    """Gain over cost from which on a step is below 0.001 standard deviations: a `tolerance`."""
    return 1e-6 / max(problem.residual_count, 1)


def settled(problem: LeastSquares, point: Point) -> bool:
    """Does no step from there, within bounds, promise what one of 0.01 standard deviations does?

    Steps are damped more and more: an undamped one that ends at a bound may promise nothing.
    """
    here = _fine(problem, point)
    if not here.finite():
        return False
    scale = here.norms()
    steps = (_bounded_step(problem, point, here, scale, damping) for damping in DAMPED)
    return max(map(here.gain, steps)) <= 100 * slight(problem) * here.cost


def _damping_within(
    problem: LeastSquares, point: Point, here: _Local, scale: Array, radius: float
) -> float:
    """The least damping, to a factor of two, whose step stays within the radius."""

    def inside(damping: float) -> bool:
        step = _bounded_step(problem, point, here, scale, damping)
        return bool(np.linalg.norm(scale * step) <= radius)

    low, high = DAMPINGS
    if inside(low):
        return low
    while high > 2 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if inside(middle) else (middle, high)
    return high


def _relieved(damping: float, ratio: float) -> float:
    """Damping after a step that gained `ratio` times what the model promised.

    Nielsen's, but where the model holds to a percent little damping is needed at all: it only
    slows what the data determine least.
    """
    if abs(ratio - 1) < 0.01 and damping > LITTLE:
        return max(damping * 1e-2, LITTLE)
    return damping * float(max(1 / 5, 1 - (2 * min(ratio, 2.0) - 1) ** 3))


def _rough(problem: LeastSquares, point: Point, normal: Normal | None = None) -> _Local:
    """From JᵀJ, which is quick; from a QR factor where its squared condition number would tell."""
    normal = normal or problem.normal(point)
    diagonal = normal.matrix.diagonal()
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    try:
        lower = np.linalg.cholesky(normal.matrix / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        lower = np.full_like(normal.matrix, np.nan)
    slope = bool(np.isfinite(normal.gradient).all())
    if slope and np.isfinite(lower).all() and lower.diagonal().min(initial=1.0) > 1e-6:
        return _Rough(normal.matrix, normal.gradient, normal.cost)
    if slope and np.isfinite(normal.matrix).all() and problem.residual_count > LONG:
        return _by_eigenvalues(normal, scale)
    return _fine(problem, point)


def _fine(problem: LeastSquares, point: Point) -> _Fine:
    """From a QR factor."""
    R, t, rest = problem.factor(point)
    return _Fine(R, t, 0.5 * (float(t @ t) + rest * rest))


def _by_eigenvalues(normal: Normal, scale: Array) -> _Fine:
    """A factor of a JᵀJ that is singular to rounding: what it cannot tell is left out of the step.

    Far away that is common (and a QR factor of all rows dear), and damped steps do not mind.
    """
    size, vectors = np.linalg.eigh(normal.matrix / np.outer(scale, scale))
    told = size > 1e-13 * size[-1]
    root = np.sqrt(np.where(told, size, 1.0))
    t = np.where(told, vectors.T @ (normal.gradient / scale) / root, 0.0)
    R = np.where(told, root, 0.0)[:, None] * vectors.T * scale
    return _Fine(np.asarray(R), np.asarray(t), normal.cost)


def _lengths(norms: Array) -> Array:
    return np.where(np.isfinite(norms) & (norms > 0), norms, 1.0)


def _bounded_step(
    problem: LeastSquares, point: Point, here: _Local, scale: Array, damping: float
) -> Array:
    """Levenberg-Marquardt step; unknowns that would leave their bounds stop there."""
    lower, upper = problem.bounds
    n = len(point.x)
    free, step = np.ones(n, dtype=bool), np.zeros(n)
    for _ in range(n + 1):
        step[free] = here.damped(scale, damping, free, step)
        target = point.x + step
        out = free & ((target < lower) | (target > upper))
        if not out.any():
            return step
        step[out] = np.clip(target, lower, upper)[out] - point.x[out]
        free &= ~out
        if not free.any():
            return step
    return step


def _least_squares(system: Array) -> Array:
    """Shortest z of least ‖Az − b‖, (n,), from [A b]."""
    factor, n = cast(Array, np.linalg.qr(system, mode="r")), system.shape[1] - 1
    pivots = np.abs(factor.diagonal())[:n]
    if len(pivots) == n and pivots.min(initial=1.0) > 1e-8 * pivots.max(initial=1.0):
        return np.asarray(np.linalg.solve(factor[:n, :n], factor[:n, n]))
    return np.asarray(np.linalg.lstsq(system[:, :n], system[:, n], rcond=None)[0])


def _negligible(step: Array, point: Point, scale: Array, here: _Local, gain: float) -> bool:
    size = np.linalg.norm(scale * step)
    reach = np.linalg.norm(scale * point.x) + np.sqrt(2 * here.cost)
    return bool(size <= 1e-15 * reach or gain <= 1e-17 * here.cost)


def _refine(problem: LeastSquares, point: Point, here: _Fine, scale: Array) -> tuple[Point, _Fine]:
    """A few undamped steps: cost differences drown in rounding before the gradient does."""
    for _ in range(3):
        if _slope(here) <= SETTLED * np.sqrt(2 * here.cost):
            break
        step = _bounded_step(problem, point, here, scale, 0.0)
        if not np.all(np.isfinite(step)):
            break
        trial = problem.moved(point, step)
        there = _fine(problem, trial)
        better = _slope(there) < _slope(here) and there.cost <= here.cost * (1 + ASTRAY)
        if not (np.isfinite(there.cost) and better):
            break
        point, here = trial, there
    return point, here


def _slope(here: _Fine) -> float:
    """Length of the residual's part that the Jacobian can still reach."""
    return float(np.linalg.norm(here.t))
