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
from numpy.typing import NDArray

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.estimate import reasons as words
from casest.estimate.covariance import inverse_normal
from casest.estimate.kink import left_at_kink
from casest.estimate.on_bounds import OnBound, free_of, of_the_free, on_bounds
from casest.estimate.profile_likelihood import Profile, half_width, profiled
from casest.estimate.reasons import (
    ALIKE,
    APART,
    BENT,
    BEYOND,
    CURVATURE,
    FAR,
    LINEAR,
    NOTHING,
    PRACTICALLY_NULL,
    SAME,
    SECOND_ORDER,
    SHAPE,
    SLOPE,
    STEP,
    WALKED,
    Code,
)
from casest.leastsquares.fewer import few_of
from casest.leastsquares.growth import UNSTABLE, growth
from casest.leastsquares.identifiability import Identifiability
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import rounding as rounding_error
from casest.leastsquares.sums import second_order
from casest.solve.outcome import Outcome
from casest.solve.trust_region import LITTLE, trust_region

#: Iterations in which another outcome is followed, to see whether it is a solution of its own.
FOLLOWED = 1000
#: A whole turn, in the units of angles.
TURN = {"rad": 2 * np.pi, "deg": 360.0}


@dataclass(frozen=True)
class Certificate:
    """Evidence for (or against) an estimate: the figures, and in words why it is (not) trusted.

    `profile` (n, 2): how far below and above each unknown its 95 % interval reaches, by the profile
    of the cost, where the cost is no parabola; None where the linear intervals describe it.
    `at_bound` are the unknowns on a bound. `code` says which reasons speak against it.
    """

    trusted: bool
    reasons: tuple[str, ...]
    slope: float
    step: float
    curvature: float
    starts: int
    agreeing: int
    shape: tuple[float, float]
    at_bound: tuple[OnBound, ...]
    profile: Array | None = None
    code: Code = NOTHING

    def refused(self, code: Code, reason: str) -> Certificate:
        """The same figures, refused for a reason that takes the place of all others."""
        return replace(self, trusted=False, reasons=(reason,), code=code)


def _noisy(model: Model) -> Sequence[Signal]:
    """Signals whose noise is that of the residual: what is predicted, else all readings."""
    measured = [s for s in model.readings if s.name == model.traced.measured]
    return measured or model.readings


def certify(
    problem: Problem,
    best: Outcome,
    others: Sequence[Outcome],
    identified: Identifiability,
    factor: tuple[Array, Array, float],
    sigma: float,
    *,
    intervals: bool = True,
    correlated_over: float = 1.0,
) -> Certificate:
    """Judge the best of several outcomes. Reasons say what speaks against it, or else for it.

    `sigma` is the standard deviation of one residual, NaN where nothing shows it. Without
    `intervals`, those that the likelihood would have to give are taken to have ends. Residuals
    alike over `correlated_over` samples say less of what lies beyond a bound.
    """
    against: list[tuple[Code, str]] = []
    rounding = rounding_error(problem, best.point)
    noise = max(sigma if np.isfinite(sigma) else 0.0, rounding)
    at_bound = on_bounds(problem, best.point, factor, noise)
    free = free_of(problem.unknowns, at_bound)
    whole, factor = factor[0], of_the_free(factor, free)
    R = factor[0]
    slope, step = slope_and_step(factor, sigma, rounding)
    kinked = ""
    # What cannot be told from rounding is no slope, however small the residual.
    exact = float(np.linalg.norm(factor[1])) <= 10 * rounding * np.sqrt(problem.residual_count)
    amplified = growth(problem, best.point) if np.isfinite(best.cost) else 1.0
    least = PRACTICALLY_NULL / max(amplified / UNSTABLE, 1.0)
    against += _undetermined(problem, identified, least)
    far = BEYOND * np.sqrt(correlated_over)
    if not against:
        wrong = [b for b in at_bound if b.open or not b.beyond <= far]
        against += [(Code.BOUND, _bound_words(problem, b)) for b in wrong]
    if not against and not np.isfinite(sigma):
        stated = " ".join(f"--sensor-noise {s.name}=STD" for s in _noisy(problem.model))
        way = (
            "record more, or rest intervals whose scatter shows it (--at-rest), or say how large "
            f"it is: {stated}"
        )
        counts = problem.residual_count, problem.unknowns
        against.append((Code.NO_REDUNDANCY, words.no_redundancy(*counts, way)))
    if not np.isfinite(best.cost):
        against.append((Code.NOT_FINITE, words.not_finite()))
    elif not settled(slope, step) and not exact and not against:
        kink = left_at_kink(problem, best.point, sigma) if free.all() else None
        if kink is None:
            smallest = identified.singular_values[-1] / identified.singular_values[0]
            said = words.not_settled(step, smallest, identified.weakest)
            against.append((Code.NOT_SETTLED, said))
        else:
            step, kinked = kink
            slope = step * sigma / max(float(np.hypot(step * sigma, factor[2])), 1e-300)
    curvature = _curvature(problem, best.point, R, free) if not against else float("nan")
    if not against and not curvature > CURVATURE:
        against.append((Code.NO_MINIMUM, words.no_minimum(curvature)))
    agreeing = sum(_same(problem, best, other, sigma, rounding) for other in others)
    shape = (1.0, 1.0)
    second = second_order(problem, best.point, sigma) if not against else 0.0
    if second > SECOND_ORDER:
        against.append((Code.NOISE, words.noise(second)))
    profile = None
    if not against:
        # By rounding alone a sum of squares does not rise: so far that it does.
        least = 10 * rounding * float(np.sqrt(problem.residual_count)) if exact else rounding
        shape, misshapen = _shape(problem, best, R, max(sigma, least), free)
        if not LINEAR[0] <= shape[0] <= shape[1] <= LINEAR[1]:
            if not intervals and _has_likelihood(problem):
                misshapen = []
            else:
                profile = _profile(problem, best, R, sigma, free)
        if profile is not None:
            misshapen = []
        against += misshapen or _ambiguous(problem, best, others, whole, sigma)
    against.sort(key=lambda reason: reason[0])
    speaking_for = (
        words.stationary(step, kink=kinked),
        words.minimum(curvature),
        words.agreement(agreeing, len(others)),
        _intervals(shape, profile is not None),
        *(_held_words(problem, b, correlated_over) for b in at_bound),
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


def _undetermined(
    problem: Problem, identified: Identifiability, least: float
) -> list[tuple[Code, str]]:
    """Null directions, or else one that is so for all practical purposes.

    What equations amplify tells each unknown alone the better, and no less of them together.
    """
    singular = identified.singular_values
    if identified.unknowns - identified.rank:
        return [(Code.NOT_DETERMINED, words.not_determined(w)) for w in identified.unobservable]
    if singular[-1] < least * singular[0]:
        weakest, way = identified.weakest, _counted_elsewhere(problem)
        return [(Code.NOT_DETERMINED, words.practically_not_determined(weakest, way))]
    return []


def _counted_elsewhere(problem: Problem) -> str:
    """The way out where powers of an input far from zero are alike: its zero in the middle."""
    model = problem.model
    settable = any(constant.name == "at" for constant in model.constants)
    for s in model.signals:
        if s.size > 1 or s.name == "t" or s.name in model.traced.readings:
            continue
        x = np.concatenate([run.signals[s.name].ravel() for run in problem.runs])
        least, most = float(np.nanmin(x)), float(np.nanmax(x))
        if 0 < most - least < FAR * abs(most + least) / 2:
            return words.count_from(s.name, least, most, settable=settable)
    return ""


def _has_likelihood(problem: Problem) -> bool:
    """Is there one that can be profiled?"""
    curved = any(slot.parameter.shape.curved for slot in problem.slots)
    return not (problem.model.implicit or curved or (problem.sequential and not problem.smooth))


def _profile(
    problem: Problem, best: Outcome, R: Array, sigma: float, free: NDArray[np.bool_]
) -> Array | None:
    """95 % intervals of the likelihood, (n, 2), or None where one has no end.

    For models that predict readings: of an implicit residual the likelihood is known to first
    order only, and unknowns on curved sets have no interval. Those on a bound have none here.
    """
    if not _has_likelihood(problem):
        return None
    covariance = np.zeros((problem.unknowns, problem.unknowns))
    covariance[np.ix_(free, free)] = sigma**2 * inverse_normal(R)
    around = Profile(problem, best.point, best.cost, covariance, sigma)
    rise = half_width(problem.residual_count - problem.unknowns) ** 2
    found = np.zeros((problem.unknowns, 2))
    with np.errstate(all="ignore"):
        for j in np.flatnonzero(free):
            interval = around.interval(int(j), rise)
            if interval is None:
                return None
            found[j] = interval
    return found


def settled(slope: float, step: float) -> bool:
    """Is as good as nothing left of either?"""
    return slope <= SLOPE or step <= STEP


def slope_and_step(
    factor: tuple[Array, Array, float], sigma: float, rounding: float
) -> tuple[float, float]:
    """Share of the residual still in the Jacobian's reach; the step left in standard deviations."""
    _, t, rest = factor
    left = float(np.linalg.norm(t))
    slope = left / max(float(np.hypot(left, rest)), 1e-300)
    return slope, left / max(sigma if np.isfinite(sigma) else 0.0, rounding)


def _bound_words(problem: Problem, b: OnBound) -> str:
    lower, upper = problem.bounds
    beyond = None if b.open else b.beyond
    return words.bound(b.name, lower[b.index], upper[b.index], beyond)


def _held_words(problem: Problem, b: OnBound, correlated_over: float) -> str:
    reach = b.reach(one_sided(problem, correlated_over))
    end = b.bound - reach if b.upper else b.bound + reach
    return words.held(b.name, b.bound, end, b.upper, b.beyond)


def one_sided(problem: Problem, correlated_over: float = 1.0) -> float:
    """Where the interval of an unknown on its bound ends, in standard deviations without colour.

    That is where the usual interval would end: so the two together hold the truth in 95 % at least,
    wherever it lies.
    """
    freedom = int((problem.residual_count - problem.unknowns) / correlated_over)
    return half_width(freedom) * float(np.sqrt(correlated_over))


def _curvature(problem: Problem, point: Point, R: Array, free: NDArray[np.bool_]) -> float:
    """Smallest eigenvalue of the free unknowns' exact Hessian relative to JᵀJ: 1 if linear."""
    hessian = problem.hessian(point)[np.ix_(free, free)]
    if not free.any():
        return 1.0
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
    problem: Problem, best: Outcome, R: Array, sigma: float, free: NDArray[np.bool_]
) -> tuple[tuple[float, float], list[tuple[Code, str]]]:
    """Walk two standard deviations along every principal direction: is the cost what intervals say?

    The ratio of the cost's rise to the quadratic one is 1 for a linear problem. Below SHAPE the
    intervals are too narrow. Above, the valley may only be bent: up to BENT the other unknowns are
    fitted again with this direction held (profile; Bates & Watts 1988, ch. 6). A valley bent more
    than that is a curve, for which standard deviations and correlations mean nothing. Where a bound
    comes first the walk ends there, as the interval will.
    """
    norms = np.ones(problem.unknowns)
    norms[free] = np.linalg.norm(R, axis=0)
    # What is on a bound stays there exactly: by its rounding a walk would leave the bounds at once.
    Vt = np.zeros((len(R), problem.unknowns))
    _, singular, Vt[:, free] = np.linalg.svd(R / norms[free])
    ratios, against, few = [1.0], [], _few_around(problem, best.point, sigma)
    for k in range(len(R) - 1, -1, -1):
        for sign in (1, -1):
            step = sign * 2 * sigma / singular[k] * Vt[k] / norms
            inside = _inside(problem, best.point, step)
            if inside < WALKED:
                continue
            step, noise = inside * step, inside * sigma
            ratio = few(step) if few and inside == 1 else None
            if ratio is None or not LINEAR[0] <= ratio <= LINEAR[1]:
                ratio = _rise(problem, best, best.point, step, noise)
            if SHAPE[1] < ratio <= BENT:
                row = Vt[k] * norms * singular[k]
                there = profiled(problem, best.point, step, row)
                ratio = _rise(problem, best, there, np.zeros_like(step), noise)
            if not SHAPE[0] <= ratio <= SHAPE[1]:
                said = words.misshapen(ratio, ratio, _largest(problem, step, norms))
                against.append((Code.MISSHAPEN, said))
            ratios.append(ratio)
    return (float(min(ratios)), float(max(ratios))), against[:1]


def _inside(problem: Problem, point: Point, step: Array) -> float:
    """Share of the step that stays within the bounds."""
    lower, upper = problem.bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(step > 0, upper - point.x, lower - point.x) / step
    return float(min(1.0, np.min(room[step != 0], initial=np.inf)))


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
    turn = np.array([TURN.get(unit, np.inf) for unit in problem.units])
    whole = np.where(np.isfinite(turn), turn, 0.0)
    return np.asarray(difference - whole * np.round(difference / turn))


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
