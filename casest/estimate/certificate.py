"""Why a point is believed to be the optimum asked for, or the reasons why it is not.

IPOPT's own status is no proof: on the 54 starts of the NIST problems its defaults claim success 53
times and are right 50 times. So the point is judged by what it is, not by how it was reached:
slope, step and curvature there, whether another algorithm or start finds a lower cost, and whether
the intervals that will be printed describe the cost around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.covariance import inverse_normal
from casest.estimate.profile_likelihood import Profile, half_width, profiled
from casest.leastsquares.identifiability import Identifiability
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import few_of, second_order
from casest.leastsquares.sums import rounding as rounding_error
from casest.solve.outcome import Outcome
from casest.solve.trust_region import LITTLE, trust_region

#: Share of the residual that the Jacobian can still reach (Bates & Watts' relative offset).
SLOPE = 1e-5
#: Last Gauss-Newton step, in standard deviations of the estimate.
STEP = 1e-4
#: Two solutions are the same when they differ by less than this many standard deviations.
SAME = 1e-2
#: Rise of the cost two standard deviations from the optimum, over what the intervals assume.
SHAPE = (0.5, 10.0)
#: Within this the linear intervals are as good as those of the likelihood, which are dearer.
LINEAR = (0.7, 2.0)
#: From this ratio on a valley is too bent to be looked along: about 45 standard deviations aside.
BENT = 1e3
#: Iterations in which another outcome is followed, to see whether it is a solution of its own.
FOLLOWED = 1000
#: An implicit residual is the noise of the reading to first order only; the second-order part must
#: stay below this share of it. (A flat ellipsoid through poses in a plane "fits" by that part.)
SECOND_ORDER = 0.07
#: A whole turn, in the units of angles.
TURN = {"rad": 2 * np.pi, "deg": 360.0}
#: Singular values of the column-scaled Jacobian below this leave a direction undetermined for all
#: practical purposes: its standard deviation is 10⁵ times that of each parameter alone.
PRACTICALLY_NULL = 1e-5


@dataclass(frozen=True)
class Certificate:
    """Evidence for (or against) an estimate: the figures, and in words why it is (not) trusted.

    `profile` (n, 2): how far below and above each unknown its 95 % interval reaches, by the profile
    of the cost, where the cost is no parabola; None where the linear intervals describe it.
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
    against: list[str] = []
    rounding = rounding_error(problem, best.point)
    slope, step = _slope_and_step(factor, sigma, rounding)
    # What cannot be told from rounding is no slope, however small the residual.
    exact = float(np.linalg.norm(factor[1])) <= 10 * rounding * np.sqrt(problem.residual_count)
    at_bound = _active(problem, best.point, R, max(sigma if np.isfinite(sigma) else 0, rounding))
    missing = identified.unknowns - identified.rank
    if missing:
        against += [f"not determined: {words}" for words in identified.unobservable]
    elif identified.singular_values[-1] < PRACTICALLY_NULL * identified.singular_values[0]:
        against.append(
            f"practically not determined: {identified.weakest}; the motion does not separate them"
        )
    against += [] if against else [_bound_words(problem, name) for name in at_bound]
    if not against and not np.isfinite(sigma):
        against.append(
            f"no redundancy: {problem.residual_count} equations for {problem.unknowns} unknowns "
            "fit whatever the noise is; record more, or rest intervals whose scatter shows it"
        )
    if not np.isfinite(best.cost):
        against.append("the residual is not finite at the best point found")
    elif slope > SLOPE and step > STEP and not exact and not against:
        weak = identified.singular_values[-1] < 1e-3 * identified.singular_values[0]
        against.append(
            f"not determined well enough to settle: {identified.weakest}; vary the motion"
            if weak
            else "not a stationary point: the last step was still "
            f"{step:.2g} standard deviations long"
        )
    curvature = _curvature(problem, best.point, R) if not against else float("nan")
    if not against and not curvature > 1e-9:
        against.append(f"no minimum: the exact curvature is {curvature:.2g} in some direction")
    agreeing = sum(_same(problem, best, other, sigma, rounding) for other in others)
    shape = (1.0, 1.0)
    second = second_order(problem, best.point, sigma) if not against else 0.0
    if second > SECOND_ORDER:
        against.append(
            f"the noise is too large for the curvature of the fitted surface (second-order part "
            f"{second:.2g} of the noise): the readings cover too little, or average more of them"
        )
    profile = None
    if not against:
        shape, words = _shape(problem, best, R, max(sigma, rounding))
        if not LINEAR[0] <= shape[0] <= shape[1] <= LINEAR[1]:
            if not intervals and _has_likelihood(problem):
                words = []
            else:
                profile = _profile(problem, best, R, sigma)
        if profile is not None:
            words = []
        against += words or _ambiguous(problem, best, others, R, sigma)
    seen = profile is not None
    reasons = tuple(against) or _for(slope, step, curvature, agreeing, len(others), shape, seen)
    return Certificate(
        not against,
        reasons,
        slope,
        step,
        curvature,
        len(others),
        agreeing,
        shape,
        at_bound,
        None if against else profile,
    )


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
    width = 1e-3 * noise / np.where(norms > 0, norms, np.inf)
    active = (point.x <= lower + width) | (point.x >= upper - width)
    return tuple(problem.names[i] for i in np.flatnonzero(active))


def _bound_words(problem: Problem, name: str) -> str:
    i = problem.names.index(name)
    lower, upper = problem.bounds[0][i], problem.bounds[1][i]
    return (
        f"`{name}` ended on its bound ({lower:.4g}, {upper:.4g}): the data ask for a value "
        "outside, or do not determine it"
    )


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
) -> tuple[tuple[float, float], list[str]]:
    """Walk two standard deviations along every principal direction: is the cost what intervals say?

    The ratio of the cost's rise to the quadratic one is 1 for a linear problem. Below SHAPE the
    intervals are too narrow. Above, the valley may only be bent: up to BENT the other unknowns are
    fitted again with this direction held (profile; Bates & Watts 1988, ch. 6). A valley bent more
    than that is a curve, for which standard deviations and correlations mean nothing.
    """
    norms = np.linalg.norm(R, axis=0)
    _, singular, Vt = np.linalg.svd(R / norms)
    ratios, words, few = [1.0], [], _few_around(problem, best.point, sigma)
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
                words.append(_misshapen(problem, step, norms, ratio))
            ratios.append(ratio)
    return (float(min(ratios)), float(max(ratios))), words[:1]


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
) -> list[str]:
    """Another solution that the data hardly distinguish from the best one, by a 95 % test."""
    for other in others:
        i = _apart(problem, best, other, R, sigma)
        if i is None:
            continue
        # A run that stopped on its way through a bent valley is no solution: follow it.
        other = trust_region(problem, other.point, max_iterations=FOLLOWED, damping=LITTLE)
        i = _apart(problem, best, other, R, sigma)
        if i is not None:
            return [
                f"two solutions fit alike: `{problem.names[i]}` = {best.point.x[i]:.6g} and "
                f"{other.point.x[i]:.6g}; give --start, or vary the motion"
            ]
    return []


def _apart(problem: Problem, best: Outcome, other: Outcome, R: Array, sigma: float) -> int | None:
    """The unknown in which an outcome that fits alike is far away; None where there is none."""
    if not other.cost - best.cost < 1.92 * sigma**2:
        return None
    # Rough where the problem is curved, but a different valley is many deviations away.
    difference = _unturned(problem, other.point.x - best.point.x)
    if not np.linalg.norm(R @ difference) > 10 * sigma:
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


def _misshapen(problem: Problem, step: Array, norms: Array, ratio: float) -> str:
    where = _largest(problem, step, norms)
    if not np.isfinite(ratio):
        return (
            f"not determined well enough: two standard deviations ({where}) reach beyond the "
            "bounds; vary the motion"
        )
    flat = ": the data hardly determine it" if ratio < SHAPE[0] else ""
    return (
        f"too uncertain for its intervals: two standard deviations away ({where}) the cost rises "
        f"{ratio:.2g} times as much as they assume{flat}; vary the motion"
    )


def _largest(problem: Problem, step: Array, norms: Array) -> str:
    order = np.argsort(-np.abs(step * norms))[:3]
    return ", ".join(f"`{problem.names[i]}` {step[i]:+.2g}" for i in order)


def _for(
    slope: float,
    step: float,
    curvature: float,
    agreeing: int,
    others: int,
    shape: tuple[float, float],
    profiled: bool,
) -> tuple[str, ...]:
    """The case for the estimate."""
    found = "the same optimum from another start or algorithm"
    intervals = (
        "intervals describe the cost two standard deviations away within "
        f"{shape[0]:.2f}-{shape[1]:.2f}"
    )
    if profiled:
        intervals = (
            "the 95 % intervals are those of the likelihood, each unknown profiled: the cost is no "
            "parabola, and standard deviations describe it only roughly"
        )
    elif shape[1] > 2.0:
        intervals = (
            "intervals are cautious: two standard deviations away the cost rises up to "
            f"{shape[1]:.2g} times as much as they assume"
        )
    return (
        f"stationary: the step left is {step:.1g} standard deviations",
        f"a minimum: exact curvature at least {curvature:.3g} of the Gauss-Newton one",
        f"{found}: {agreeing} of {others}" + "; the others end higher" * (agreeing < others),
        intervals,
    )
