"""Why a point is believed to be the optimum asked for, or the reasons why it is not.

IPOPT's own status is no proof: on the 54 starts of the NIST problems its defaults claim success 53
times and are right 50 times. So the point is judged by what it is, not by how it was reached:
slope, step and curvature there, whether another algorithm or start finds a lower cost, and whether
the intervals that will be printed describe the cost around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import or_

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate import reasons as words
from casest.estimate.covariance import inverse_normal
from casest.estimate.profile_likelihood import Profile, half_width, profiled
from casest.estimate.reasons import (
    ALIKE,
    APART,
    BENT,
    CURVATURE,
    LINEAR,
    NOTHING,
    ON_BOUND,
    PRACTICALLY_NULL,
    SAME,
    SECOND_ORDER,
    SHAPE,
    SLOPE,
    STEP,
    Code,
)
from casest.leastsquares.identifiability import Identifiability
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import few_of, second_order
from casest.leastsquares.sums import rounding as rounding_error
from casest.solve.outcome import Outcome
from casest.solve.trust_region import LITTLE, trust_region

#: Iterations in which another outcome is followed, to see whether it is a solution of its own.
FOLLOWED = 1000


@dataclass(frozen=True)
class Certificate:
    """Evidence for (or against) an estimate: the figures, and in words why it is (not) trusted.

    `profile` (n, 2): how far below and above each unknown its 95 % interval reaches, by the profile
    of the cost, where the cost is no parabola; None where the linear intervals describe it. `code`
    says which reasons speak against it.
    """

    trusted: bool
    reasons: tuple[str, ...]
    slope: float
    step: float
    curvature: float
    starts: int
    agreeing: int
    shape: tuple[float, float]
    at_bound: tuple[str, ...]
    profile: Array | None = None
    code: Code = NOTHING

    def refused(self, code: Code, reason: str) -> Certificate:
        """The same figures, refused for a reason that takes the place of all others."""
        return replace(self, trusted=False, reasons=(reason,), code=code)


def certify(
    problem: Problem,
    best: Outcome,
    others: Sequence[Outcome],
    identified: Identifiability,
    factor: tuple[Array, Array, float],
    sigma: float,
    *,
    intervals: bool = True,
) -> Certificate:
    """Judge the best of several outcomes. Reasons say what speaks against it, or else for it.

    `sigma` is the standard deviation of one residual, NaN where nothing shows it. Without
    `intervals`, those that the likelihood would have to give are taken to have ends.
    """
    R = factor[0]
    against: list[tuple[Code, str]] = []
    rounding = rounding_error(problem, best.point)
    slope, step = _slope_and_step(factor, sigma, rounding)
    # What cannot be told from rounding is no slope, however small the residual.
    exact = float(np.linalg.norm(factor[1])) <= 10 * rounding * np.sqrt(problem.residual_count)
    at_bound = _active(problem, best.point, R, max(sigma if np.isfinite(sigma) else 0, rounding))
    against += _undetermined(identified)
    if not against:
        against += [(Code.BOUND, _bound_words(problem, name)) for name in at_bound]
    if not against and not np.isfinite(sigma):
        way = "record more, or rest intervals whose scatter shows it"
        counts = problem.residual_count, problem.unknowns
        against.append((Code.NO_REDUNDANCY, words.no_redundancy(*counts, way)))
    if not np.isfinite(best.cost):
        against.append((Code.NOT_FINITE, words.not_finite()))
    elif slope > SLOPE and step > STEP and not exact and not against:
        smallest = identified.singular_values[-1] / identified.singular_values[0]
        against.append((Code.NOT_SETTLED, words.not_settled(step, smallest, identified.weakest)))
    curvature = _curvature(problem, best.point, R) if not against else float("nan")
    if not against and not curvature > CURVATURE:
        against.append((Code.NO_MINIMUM, words.no_minimum(curvature)))
    agreeing = sum(_same(problem, best, other, sigma, rounding) for other in others)
    shape = (1.0, 1.0)
    second = second_order(problem, best.point, sigma) if not against else 0.0
    if second > SECOND_ORDER:
        against.append((Code.NOISE, words.noise(second)))
    profile = None
    if not against:
        shape, misshapen = _shape(problem, best, R, max(sigma, rounding))
        if not LINEAR[0] <= shape[0] <= shape[1] <= LINEAR[1]:
            if not intervals and _has_likelihood(problem):
                misshapen = []
            else:
                profile = _profile(problem, best, R, sigma)
        if profile is not None:
            misshapen = []
        against += misshapen or _ambiguous(problem, best, others, R, sigma)
    against.sort(key=lambda reason: reason[0])
    speaking_for = (
        words.stationary(step),
        words.minimum(curvature),
        words.agreement(agreeing, len(others)),
        _intervals(shape, profile is not None),
    )
    return Certificate(
        not against,
        tuple(said for _, said in against) or speaking_for,
        slope,
        step,
        curvature,
        len(others),
        agreeing,
        shape,
        at_bound,
        None if against else profile,
        reduce(or_, (code for code, _ in against), NOTHING),
    )


def _intervals(shape: tuple[float, float], profiled: bool) -> str:
    if profiled:
        return words.PROFILED
    wide = shape[1] > LINEAR[1]
    return words.cautious_intervals(shape[1]) if wide else words.intervals(*shape)


def _undetermined(identified: Identifiability) -> list[tuple[Code, str]]:
    """Null directions, or else one that is so for all practical purposes."""
    singular = identified.singular_values
    if identified.unknowns - identified.rank:
        return [(Code.NOT_DETERMINED, words.not_determined(w)) for w in identified.unobservable]
    if singular[-1] < PRACTICALLY_NULL * singular[0]:
        return [(Code.NOT_DETERMINED, words.practically_not_determined(identified.weakest))]
    return []


def _has_likelihood(problem: Problem) -> bool:
    """Is there one that can be profiled?"""
    curved = any(slot.parameter.shape.curved for slot in problem.slots)
    return not (problem.model.implicit or curved or problem.sequential)


def _profile(problem: Problem, best: Outcome, R: Array, sigma: float) -> Array | None:
    """95 % intervals of the likelihood, (n, 2), or None where one has no end.

    For models that predict readings: of an implicit residual the likelihood is known to first
    order only, and unknowns on curved sets have no interval.
    """
    if not _has_likelihood(problem):
        return None
    around = Profile(problem, best.point, best.cost, sigma**2 * inverse_normal(R), sigma)
    rise = half_width(problem.residual_count - problem.unknowns) ** 2
    found = []
    with np.errstate(all="ignore"):
        for j in range(problem.unknowns):
            interval = around.interval(j, rise)
            if interval is None:
                return None
            found.append(interval)
    return np.array(found)


def _slope_and_step(
    factor: tuple[Array, Array, float], sigma: float, rounding: float
) -> tuple[float, float]:
    """Share of the residual still in the Jacobian's reach; the step left in standard deviations."""
    _, t, rest = factor
    left = float(np.linalg.norm(t))
    slope = left / max(float(np.hypot(left, rest)), 1e-300)
    return slope, left / max(sigma if np.isfinite(sigma) else 0.0, rounding)


def _active(problem: Problem, point: Point, R: Array, noise: float) -> tuple[str, ...]:
    """Unknowns on a bound: nearer to it than a thousandth of their standard deviation alone."""
    lower, upper = problem.bounds
    norms = np.linalg.norm(R, axis=0)
    width = ON_BOUND * noise / np.where(norms > 0, norms, np.inf)
    active = (point.x <= lower + width) | (point.x >= upper - width)
    return tuple(problem.names[i] for i in np.flatnonzero(active))


def _bound_words(problem: Problem, name: str) -> str:
    i = problem.names.index(name)
    return words.bound(name, problem.bounds[0][i], problem.bounds[1][i])


def _curvature(problem: Problem, point: Point, R: Array) -> float:
    """Smallest eigenvalue of the exact Hessian relative to JᵀJ: 1 for a linear problem."""
    hessian = problem.hessian(point)
    inverse = np.linalg.inv(R)
    relative = inverse.T @ hessian @ inverse
    if not np.all(np.isfinite(relative)):
        return float("nan")
    return float(np.min(np.linalg.eigvalsh(0.5 * (relative + relative.T))))


def _same(problem: Problem, best: Outcome, other: Outcome, sigma: float, rounding: float) -> bool:
    """Do two outcomes differ by less than SAME standard deviations?"""
    if not np.isfinite(other.cost):
        return False
    excess = np.sqrt(2 * max(other.cost - best.cost, 0.0))
    floor = 10 * rounding * np.sqrt(problem.residual_count)
    return bool(excess <= max(SAME * sigma if np.isfinite(sigma) else 0.0, floor))


def _shape(
    problem: Problem, best: Outcome, R: Array, sigma: float
) -> tuple[tuple[float, float], list[tuple[Code, str]]]:
    """Walk two standard deviations along every principal direction: is the cost what intervals say?

    The ratio of the cost's rise to the quadratic one is 1 for a linear problem. Below SHAPE the
    intervals are too narrow. Above, the valley may only be bent: up to BENT the other unknowns are
    fitted again with this direction held (profile; Bates & Watts 1988, ch. 6). A valley bent more
    than that is a curve, for which standard deviations and correlations mean nothing.
    """
    norms = np.linalg.norm(R, axis=0)
    _, singular, Vt = np.linalg.svd(R / norms)
    ratios, against, few = [1.0], [], _few_around(problem, best.point, sigma)
    for k in range(len(norms) - 1, -1, -1):
        for sign in (1, -1):
            step = sign * 2 * sigma / singular[k] * Vt[k] / norms
            ratio = few(step) if few else None
            if ratio is None or not LINEAR[0] <= ratio <= LINEAR[1]:
                ratio = _rise(problem, best, best.point, step, sigma)
            if SHAPE[1] < ratio <= BENT:
                row = Vt[k] * norms * singular[k]
                there = profiled(problem, best.point, step, row)
                ratio = _rise(problem, best, there, np.zeros_like(step), sigma)
            if not SHAPE[0] <= ratio <= SHAPE[1]:
                said = words.misshapen(ratio, ratio, _largest(problem, step, norms))
                against.append((Code.MISSHAPEN, said))
            ratios.append(ratio)
    return (float(min(ratios)), float(max(ratios))), against[:1]


def _few_around(
    problem: Problem, point: Point, sigma: float
) -> Callable[[Array], float | None] | None:
    """The same ratio as a few of the samples see it, for long records; None where they cannot.

    They cannot where the direction is told by others: their own parabola must be as steep as that
    of all, to a factor of two. Only what they find harmless is believed.
    """
    few = few_of(problem)
    if few is None:
        return None
    here, share = few.normal(point), few.residual_count / problem.residual_count
    lower, upper = problem.bounds

    def ratio(step: Array) -> float | None:
        x, assumed = point.x + step, 0.5 * float(step @ here.matrix @ step)
        inside = bool(np.all((x >= lower) & (x <= upper)))
        if not (inside and 0.5 <= assumed / (2 * sigma**2 * share) <= 2.0):
            return None
        rise = few.cost(few.moved(point, step)) - here.cost - float(here.gradient @ step)
        return rise / assumed

    return ratio


def _ambiguous(
    problem: Problem, best: Outcome, others: Sequence[Outcome], R: Array, sigma: float
) -> list[tuple[Code, str]]:
    """Another solution that the data hardly distinguish from the best one, by a 95 % test."""
    for other in others:
        i = _apart(problem, best, other, R, sigma)
        if i is None:
            continue
        # A run that stopped on its way through a bent valley is no solution: follow it.
        other = trust_region(problem, other.point, max_iterations=FOLLOWED, damping=LITTLE)
        i = _apart(problem, best, other, R, sigma)
        if i is not None:
            here, there = best.point.x[i], other.point.x[i]
            return [(Code.AMBIGUOUS, words.ambiguous(problem.names[i], here, there))]
    return []


def _apart(problem: Problem, best: Outcome, other: Outcome, R: Array, sigma: float) -> int | None:
    """The unknown in which an outcome that fits alike is far away; None where there is none."""
    if not other.cost - best.cost < ALIKE * sigma**2:
        return None
    # Rough where the problem is curved, but a different valley is many deviations away.
    difference = _unturned(problem, other.point.x - best.point.x)
    if not np.linalg.norm(R @ difference) > APART * sigma:
        return None
    return int(np.argmax(np.abs(difference) * np.linalg.norm(R, axis=0)))


def _unturned(problem: Problem, difference: Array) -> Array:
    """Differences of angles without their whole turns: 0.5 and 0.5 + 2π are one solution."""
    angle = np.array([unit == "rad" for unit in problem.units])
    wrapped = (difference + np.pi) % (2 * np.pi) - np.pi
    return np.where(angle, wrapped, difference)


def _rise(problem: Problem, best: Outcome, point: Point, step: Array, sigma: float) -> float:
    """Rise of the cost over the 2σ² of a quadratic; infinite outside the bounds."""
    lower, upper = problem.bounds
    x = point.x + step
    if np.any((x < lower) | (x > upper)):
        return float("inf")
    ratio = (problem.cost(problem.moved(point, step)) - best.cost) / (2 * sigma**2)
    return float(ratio) if np.isfinite(ratio) else float("inf")


def _largest(problem: Problem, step: Array, norms: Array) -> str:
    order = np.argsort(-np.abs(step * norms))[:3]
    return ", ".join(f"`{problem.names[i]}` {step[i]:+.2g}" for i in order)
