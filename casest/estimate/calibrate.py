"""Fit a model to runs, prove the answer, and say how sure it is."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.engine.threads import one_thread
from casest.errors import DataError, NotTrusted, UsageError
from casest.estimate import reasons as words
from casest.estimate.by_estimator import by_estimator
from casest.estimate.certificate import Certificate, certify, settled, slope_and_step
from casest.estimate.correlation import ENOUGH, alike_over, correlation_time
from casest.estimate.covariance import as_stated, covariance_of, inverse_normal, no_less
from casest.estimate.errors_of_inputs import solved, with_errors_of_inputs
from casest.estimate.estimate import Estimate as Estimate
from casest.estimate.estimate import Noise
from casest.estimate.evidence import judged
from casest.estimate.keeping import keeping
from casest.estimate.kink import at_kink
from casest.estimate.on_bounds import free_of, on_bounds
from casest.estimate.propagation import propagated
from casest.estimate.reasons import POOR, STARTS, WORTH, Code
from casest.estimate.remarks import NOTABLE_BIAS
from casest.estimate.valley import looked_for
from casest.leastsquares.identifiability import Identifiability, identify, weak_directions
from casest.leastsquares.kinds import in_deviations, noises
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.stated import chi_square
from casest.leastsquares.sums import repeat_noise, second_order_bias
from casest.solve.horizon import grown
from casest.solve.outcome import Outcome
from casest.solve.strategy import SOLVERS, best_of, valleys
from casest.solve.trust_region import trust_region

#: From this many degrees of freedom on the residual alone says how large the noise is.
ENOUGH_FREEDOM = 10


def calibrate(
    model: Model,
    runs: Sequence[Run],
    *,
    start: Mapping[str, Any] | None = None,
    solver: str = "ipopt",
    seed: int = 0,
) -> Estimate:
    """Fit the model; return an estimate whose certificate is trusted.

    `start` overrides the automatic start values; `solver` is one of SOLVERS or an estimator of
    the model's own (`closed-form`), which is judged against the least-squares optimum. Raises
    NotTrusted, with the refused estimate as its attribute `estimate`, where no answer deserves
    belief; DataError where there are fewer residuals than unknowns.
    """
    found = attempt(model, runs, start=start, solver=solver, seed=seed)
    if not found.certificate.trusted:
        error = NotTrusted("no trustworthy estimate: " + "; ".join(found.certificate.reasons))
        error.estimate = found
        raise error
    return found


def attempt(
    model: Model,
    runs: Sequence[Run],
    *,
    start: Mapping[str, Any] | None = None,
    solver: str = "ipopt",
    seed: int = 0,
    intervals: bool = True,
) -> Estimate:
    """The same as `calibrate`, but a refused estimate is returned instead of raised.

    Without `intervals`, those that only the likelihood can give are left out: each takes fits. So
    is the search for a better valley: the start is taken to lie in the right one.
    """
    model = getattr(model, "calibration", model)
    # What is not finite is found and named, not warned about.
    with np.errstate(all="ignore"), one_thread():
        return _attempt(Problem(model, tuple(runs)), start, solver, seed, intervals)


def _attempt(
    problem: Problem, start: Mapping[str, Any] | None, solver: str, seed: int, intervals: bool
) -> Estimate:
    began, model = time.perf_counter(), problem.model
    _enough(problem)
    own = dict(model.estimators)
    if solver not in SOLVERS and solver not in own:
        known = ", ".join([*SOLVERS, *own])
        raise UsageError(f"unknown solver {solver!r} for {model.name}; it has {known}")
    try:
        first = problem.start() if start is None else problem.point(_merged(problem, start))
    except NotTrusted as error:
        return _refused(problem, problem.point({}), Code.MODEL, str(error), began)
    if model.traced.integrates and problem.stopped(first):
        first = grown(problem, first).point  # along the record it may lead somewhere else
    nowhere = _not_finite(problem, first)
    if nowhere:
        return _refused(problem, first, Code.NOT_FINITE, nowhere, began)
    problem = in_deviations(problem, first, _fitted)
    problem, outcomes = solved(
        problem,
        first,
        solver="ipopt" if solver in own else solver,
        seed=seed,
        automatic=start is None,
    )
    try:
        problem, outcomes = with_errors_of_inputs(problem, outcomes, solver, seed)
    except NotTrusted as error:
        return _refused(problem, best_of(outcomes).point, Code.MODEL, str(error), began)
    evidence = None
    if intervals:
        outcomes, evidence = looked_for(problem, first, outcomes, seed, start is not None)
    found = _estimate(problem, best_of(outcomes), outcomes, began, intervals)
    certificate = judged(problem, found.certificate, evidence)
    certificate = keeping(
        problem, found.point, found.noise.sigma, found.correlated_over, certificate
    )
    found = replace(found, certificate=certificate, evidence=evidence)
    if start is None and model.starter is None and found.certificate.trusted:
        found = _looked_at_for_a_better_one(found)
    if found.certificate.trusted:
        found = _no_random_walk(found)
    if found.certificate.trusted and problem.model.refuser is not None:
        found = _judged_by_the_model(found)
    return by_estimator(found, own[solver], solver) if solver in own else found


def _fitted(problem: Problem, first: Point) -> Point:
    return trust_region(problem, first).point


def _enough(problem: Problem) -> None:
    if not problem.runs:
        raise DataError("there are no runs to fit; give at least one")
    if problem.residual_count < problem.unknowns:
        what = "rest intervals" if problem.runs[0].spread else "rows"
        raise DataError(
            f"{problem.runs[0].file}: {sum(map(len, problem.runs))} {what} give "
            f"{problem.residual_count} equations for the {problem.unknowns} unknowns of "
            f"{problem.model.name}; record more, or fix some with --fix name=value"
        )
    if problem.unknowns == 0:
        raise UsageError(
            f"model {problem.model.name} has nothing left to estimate; --free something"
        )


def _not_finite(problem: Problem, start: Point) -> str:
    """Where the residual or its derivative is not finite at the start, in words; else empty."""
    normal = problem.normal(start)
    if np.isfinite(normal.cost) and np.all(np.isfinite(normal.gradient)):
        return ""
    if words := problem.stopped(start):
        return f"{words}; give --start, or bounds that keep the search away"
    for run, residual in zip(problem.runs, problem.residuals(start), strict=True):
        bad = np.flatnonzero(~np.isfinite(residual).all(axis=1))
        if bad.size:
            return (
                f"the residual is not finite at the start values in {bad.size} of {len(run)} rows, "
                f"first in {run.file or run.name} row {int(run.rows[bad[0]])}; give --start"
            )
    if problem.model.traced.integrates:
        return (
            "the equations are too stiff at the start values for their slopes to be followed; give "
            "--start, or bounds that keep the search away"
        )
    return "a derivative of the residual is not finite at the start values; give --start"


def _refused(problem: Problem, point: Point, code: Code, reason: str, began: float) -> Estimate:
    """An estimate that says nothing but why there is none."""
    nothing = np.full((problem.unknowns, problem.unknowns), np.nan)
    nan = float("nan")
    everything = np.ones(problem.unknowns, dtype=bool)
    return Estimate(
        problem,
        point,
        problem.values(point),
        problem.spread(point, nothing),
        nothing,
        Noise(nan, nan, None, problem.residual_count - problem.unknowns),
        nan,
        Certificate(False, (reason,), nan, nan, nan, 0, 0, (nan, nan), (), code=code),
        Identifiability(
            0, problem.unknowns, nothing[0], nothing, (), everything, nothing[:, 0], ""
        ),
        (),
        (),
        time.perf_counter() - began,
    )


def _merged(problem: Problem, start: Mapping[str, Any]) -> dict[str, Any]:
    automatic = problem.values(problem.start()) if problem.model.starter else {}
    return {**automatic, **start}


def _estimate(
    problem: Problem,
    best: Outcome,
    outcomes: Sequence[Outcome],
    began: float,
    intervals: bool = True,
) -> Estimate:
    found, best = best, _canonical(problem, best)
    outcomes = [
        best if o is found else o if _beside(o, best) else _canonical(problem, o) for o in outcomes
    ]
    best = _at_kink(problem, best)
    point = best.point
    if problem.parabolic:
        problem.looked_at(point)  # judged by the samples there, not by what follows from elsewhere
    factor = problem.factor(point)
    R, _, rest = factor
    if not np.isfinite(R).all():
        reason = "a derivative of the residual is not finite at the best point found; give --start"
        return _refused(problem, point, Code.NOT_FINITE, reason, began)
    identified = identify(problem, point, _told_apart(problem, point, R))
    dof = problem.residual_count - identified.rank
    noise = _noise(problem, point, float(np.sqrt(2 * best.cost)), dof, identified.rank)
    correlated = correlation_time(problem, point)
    free = free_of(problem.unknowns, on_bounds(problem, point, factor, noise.sigma))
    alike = alike_over(problem, point, correlated)
    normal = problem.model.prior is not None or (noise.known and alike <= 1)
    by = as_stated if normal else covariance_of
    spread = by(problem, point, R, noise.sigma, alike, free)
    if noise.known and not normal:
        known = as_stated(problem, point, R, noise.sigma, alike, free)
        spread = no_less(spread, known)
    covariance = spread.covariance
    bias = second_order_bias(problem, point, noise.sigma, inverse_normal(R, free))
    with np.errstate(invalid="ignore"):
        size = np.sqrt(np.diag(covariance))
    relative = float(np.nanmax(np.abs(bias[free]) / size[free], initial=0.0))
    shift = np.outer(bias, bias) if relative > NOTABLE_BIAS else 0.0
    inputs = propagated(problem, point, free)
    shift = shift if inputs is None else shift + inputs.carried
    covariance = covariance + shift
    factored = (R, factor[1], rest)
    certificate = certify(
        problem,
        best,
        outcomes,
        identified,
        factored,
        noise.sigma,
        intervals=intervals,
        correlated_over=correlated,
    )
    # Below zero: less than its rounding, where unknowns are told apart by the last digits alone.
    unknown = np.logical_or(identified.touched, ~free) | (np.diag(covariance) < 0)
    covariance[unknown, :] = covariance[:, unknown] = np.nan
    return Estimate(
        problem,
        point,
        problem.values(point),
        problem.spread(point, covariance),
        covariance,
        noise,
        float(np.sqrt(2 * best.cost / problem.residual_count)),
        certificate,
        identified,
        weak_directions(problem, R, noise.sigma, identified.rank),
        tuple(outcomes),
        time.perf_counter() - began,
        correlated,
        relative,
        shift,
        inputs=inputs,
        colour_freedom=spread.freedom,
    )


def _at_kink(problem: Problem, best: Outcome) -> Outcome:
    """The outcome; where its slope is none of a least cost, the least cost at a kink nearby."""
    if problem.parabolic or not np.isfinite(best.cost):
        return best
    R, t, rest = problem.factor(best.point)
    if not np.isfinite(R).all():
        return best
    freedom = max(problem.residual_count - problem.unknowns, 1)
    sigma = float(np.sqrt(2 * best.cost / freedom))
    if not sigma > 0 or settled(*slope_and_step((R, t, rest), sigma, 0.0)):
        return best
    found = at_kink(problem, best.point, sigma)
    if found is None or problem.cost(found) > best.cost:
        return best
    return replace(best, point=found, cost=problem.cost(found))


def _told_apart(problem: Problem, point: Point, R: Array) -> Array:
    """The factor in which it is seen what is determined: constraints no harder than data."""
    if problem.force is None:
        return R
    return replace(problem, force=problem.force.softer).factor(point)[0]


def _looked_at_for_a_better_one(found: Estimate) -> Estimate:
    """Refuse the best of several valleys where its residual still has a course of its own.

    Around declared starts the right valley may have been missed; in rows without a time nothing but
    a poor fit makes neighbours so alike. A start of the user's own says that this is the valley.
    """
    places = valleys(found.outcomes)
    over = correlation_time(found.problem, found.point, tables=ENOUGH) if places > 1 else 1.0
    timed = any(run.time is not None for run in found.problem.runs)
    if timed or over <= POOR:
        return found
    reason = words.poor_valley(len(found.outcomes), places, over)
    return replace(found, certificate=found.certificate.refused(Code.POOR_VALLEY, reason))


def _no_random_walk(found: Estimate) -> Estimate:
    """Refuse a fit that nothing agrees with, to a record worth too few independent readings."""
    agreeing, starts = found.certificate.agreeing, len(found.outcomes)
    worth = found.problem.residual_count / found.correlated_over
    unknowns = found.problem.unknowns
    alone = agreeing <= 1 and starts >= STARTS and found.correlated_over > POOR
    if not alone or worth >= WORTH * unknowns:
        return found
    reason = words.wandering(starts - 1, found.correlated_over, worth, unknowns)
    return replace(found, certificate=found.certificate.refused(Code.POOR_VALLEY, reason))


def _judged_by_the_model(found: Estimate) -> Estimate:
    """Refuse what the model itself says is no calibration."""
    problem = found.problem
    assert problem.model.refuser is not None
    for reason in problem.model.refuser(problem.model, problem.seen_runs, found.values):
        return replace(found, certificate=found.certificate.refused(Code.MODEL, reason))
    return found


def _canonical(problem: Problem, best: Outcome) -> Outcome:
    """The same solution in the model's own convention, as long as it is the same."""
    convention = problem.model.canonicaliser
    if convention is None or not np.isfinite(best.cost):
        return best
    values = problem.values(best.point)
    chosen = {k: v for k, v in convention(problem.model, values).items() if k in values}
    if all(np.allclose(v, values[k], rtol=1e-12, atol=1e-14) for k, v in chosen.items()):
        return best
    point = problem.point({**values, **chosen})
    cost = problem.cost(point)
    same = abs(cost - best.cost) <= 1e-6 * best.cost + 1e-20
    return replace(best, point=point, cost=min(cost, best.cost)) if same else best


def _beside(other: Outcome, best: Outcome) -> bool:
    """Is an outcome so near to the best that it is in the same convention already?"""
    return np.allclose(other.point.x, best.point.x, rtol=1e-3, atol=1e-9)


def _noise(problem: Problem, point: Point, length: float, dof: int, rank: int) -> Noise:
    """Noise of one residual: what is left over; with few degrees of freedom to judge that by,
    never less than what repeats (rest intervals) show. Where it was stated, that, but for a
    residual that is larger by more than chance."""
    residual = length / np.sqrt(dof) if dof > 0 else float("nan")
    repeats = repeat_noise(problem, point)
    chi = chi_square(problem, point, rank)
    scale = problem.noise_scale
    if scale is not None and problem.weights is None:
        stated = Noise(scale, residual, repeats, dof, scale, chi)
        return stated if stated.known else replace(stated, sigma=residual)
    if noises(problem.model) and np.isfinite(residual):
        # In deviations found one by one: one that is taken to be no less leaves the others theirs.
        return Noise(max(residual, 1.0), residual, repeats, dof)
    if dof >= ENOUGH_FREEDOM:
        return Noise(residual, residual, repeats, dof)
    candidates = [s for s in (residual, repeats) if s is not None and np.isfinite(s)]
    return Noise(max(candidates, default=float("nan")), residual, repeats, dof)
