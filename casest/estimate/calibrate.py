"""Fit a model to runs, prove the answer, and say how sure it is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.engine.threads import one_thread
from casest.errors import DataError, NotTrusted, UsageError
from casest.estimate import reasons as words
from casest.estimate.certificate import Certificate, certify, one_sided
from casest.estimate.correlation import ENOUGH, TABLE, correlation_time
from casest.estimate.covariance import covariance_of, inverse_normal, sandwich
from casest.estimate.evidence import Evidence, judged, remarks
from casest.estimate.on_bounds import free_of, on_bounds
from casest.estimate.profile_likelihood import half_width
from casest.estimate.reasons import NEAR, POOR, STARTS, WORTH, Code
from casest.estimate.remarks import NOTABLE_BIAS, notes
from casest.estimate.valley import looked_for
from casest.leastsquares.identifiability import Identifiability, Weak, identify, weak_directions
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import repeat_noise, second_order_bias
from casest.solve.outcome import Outcome
from casest.solve.strategy import SOLVERS, best_of, solve, valleys

#: From this many degrees of freedom on the residual alone says how large the noise is.
ENOUGH_FREEDOM = 10


@dataclass(frozen=True)
class Noise:
    """Standard deviation of one residual, with where it comes from.

    `sigma` is what the covariance uses; `residual` the root of RSS over degrees of freedom;
    `repeats` the scatter that rest intervals show by themselves (None without any).
    """

    sigma: float
    residual: float
    repeats: float | None
    degrees_of_freedom: int


@dataclass(frozen=True)
class Estimate:
    """Parameters by name with covariance, certificate, residuals.

    `values` and `std` have the parameters' shapes (a leading run axis for per-run ones if there
    are several runs). `std` is `robust`, the sandwich form, where residuals are correlated over
    more than one sample or are many for each unknown, else `plain`. All are taken at the
    least-squares `optimum`, where `point` is not it; `shift` (n, n) is what second-order noise
    adds, a bias of up to `bias` standard deviations.
    `covariance` (n, n) is of the unknowns `names`. Where the data do not determine a value its std
    is NaN.
    """

    problem: Problem
    point: Point
    values: Mapping[str, Array]
    std: Mapping[str, Array]
    covariance: Array
    noise: Noise
    rmse: float
    certificate: Certificate
    identifiability: Identifiability
    weak: tuple[Weak, ...]
    outcomes: tuple[Outcome, ...]
    seconds: float
    correlated_over: float = 1.0
    bias: float = 0.0
    shift: Array | float = 0.0
    optimum: Point | None = None
    evidence: Evidence | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> Model:
        """The model that was fitted."""
        return self.problem.model

    @cached_property
    def plain(self) -> Mapping[str, Array]:
        """Standard deviations if the noise were alike everywhere and independent: σ²(JᵀJ)⁻¹."""
        if self.identifiability.rank == 0:
            return self.std
        R = self.problem.factor(self.optimum or self.point)[0]
        return self._spread(self.noise.sigma**2 * inverse_normal(R, self.free))

    @cached_property
    def robust(self) -> Mapping[str, Array]:
        """Standard deviations from the sandwich form, shaped like `std`."""
        if self.identifiability.rank == 0:
            return self.std
        at = self.optimum or self.point
        R = self.problem.factor(at)[0]
        return self._spread(sandwich(self.problem, at, R, self.correlated_over, self.free))

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which unknowns are on no bound, (n,)."""
        return free_of(self.problem.unknowns, self.certificate.at_bound)

    def _spread(self, covariance: Array) -> Mapping[str, Array]:
        """Standard deviations by name; NaN where nothing is determined, and on a bound."""
        covariance = covariance + self.shift
        unknown = np.logical_or(self.identifiability.touched, ~self.free)
        covariance[unknown, :] = covariance[:, unknown] = np.nan
        return self.problem.spread(self.optimum or self.point, covariance)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What an engineer should know beside the numbers, a sentence each; looked for when asked.

        (The test of a wheel's speed law takes as long as its fit.)
        """
        if not self.outcomes:
            return ()
        problem, at = self.problem, self.optimum or self.point
        dof = problem.residual_count - self.identifiability.rank
        with np.errstate(all="ignore"):
            found = notes(problem, at, dof, self.correlated_over, self.bias)
            return (*remarks(problem, self.evidence), *found, *_of_tables(problem, at))

    @cached_property
    def interval_reach(self) -> tuple[Mapping[str, Array], Mapping[str, Array]]:
        """How far the 95 % interval of every value reaches below and above it, shaped like `std`.

        Student's t times `std`, or the profile of the cost where that is no parabola (widened as
        `std` is, where residuals are correlated). No interval reaches beyond a bound; that of an
        unknown on one has one end, at 95 %.
        """
        at, ends = self.optimum or self.point, []
        quantile = one_sided(self.problem, self.correlated_over)
        for side, squares in enumerate(self._squared_reach()):
            reach = np.sqrt(np.diag(squares))
            for b in self.certificate.at_bound:
                reach[b.index] = 0.0 if b.upper == bool(side) else b.reach(quantile)
            reach = np.minimum(reach, np.maximum(np.abs(self.problem.bounds[side] - at.x), 0))
            np.fill_diagonal(squares, reach**2)
            ends.append(self.problem.spread(at, squares))
        return ends[0], ends[1]

    def _squared_reach(self) -> tuple[Array, Array]:
        """Squares of the reach below and above, (n, n) each as a covariance, as if unbounded."""
        profile = self.certificate.profile
        if profile is None:
            half = half_width(int(self.noise.degrees_of_freedom / self.correlated_over))
            linear = half**2 * self.covariance
            return linear.copy(), linear.copy()
        R = self.problem.factor(self.optimum or self.point)[0]
        plain = self.noise.sigma**2 * np.diag(inverse_normal(R, self.free))
        with np.errstate(invalid="ignore", divide="ignore"):
            wider = np.sqrt(np.diag(self.covariance) / plain)
        return np.diag((wider * profile[:, 0]) ** 2), np.diag((wider * profile[:, 1]) ** 2)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the covariance."""
        return self.problem.names


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
    nowhere = _not_finite(problem, first)
    if nowhere:
        return _refused(problem, first, Code.NOT_FINITE, nowhere, began)
    problem, outcomes = solve(
        problem,
        first,
        solver="ipopt" if solver in own else solver,
        seed=seed,
        automatic=start is None,
    )
    evidence = None
    if intervals:
        outcomes, evidence = looked_for(problem, first, outcomes, seed, start is not None)
    found = _estimate(problem, best_of(outcomes), outcomes, began, intervals)
    certificate = judged(problem, found.certificate, evidence)
    found = replace(found, certificate=certificate, evidence=evidence)
    if start is None and model.starter is None and found.certificate.trusted:
        found = _looked_at_for_a_better_one(found)
    if found.certificate.trusted:
        found = _no_random_walk(found)
    return _by_estimator(found, own[solver], solver) if solver in own else found


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
    for run, residual in zip(problem.runs, problem.residuals(start), strict=True):
        bad = np.flatnonzero(~np.isfinite(residual).all(axis=1))
        if bad.size:
            return (
                f"the residual is not finite at the start values in {bad.size} of {len(run)} rows, "
                f"first in {run.file or run.name} row {int(run.rows[bad[0]])}; give --start"
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
        Identifiability(0, problem.unknowns, nothing[0], nothing, (), everything, ""),
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
    point = best.point
    factor = problem.factor(point)
    R, _, rest = factor
    if not np.isfinite(R).all():
        reason = "a derivative of the residual is not finite at the best point found; give --start"
        return _refused(problem, point, Code.NOT_FINITE, reason, began)
    identified = identify(problem, point, R)
    dof = problem.residual_count - identified.rank
    noise = _noise(problem, point, float(np.sqrt(2 * best.cost)), dof)
    correlated = correlation_time(problem, point)
    free = free_of(problem.unknowns, on_bounds(problem, point, factor, noise.sigma))
    covariance = covariance_of(problem, point, R, noise.sigma, correlated, free)
    bias = second_order_bias(problem, point, noise.sigma, inverse_normal(R, free))
    relative = float(np.max(np.abs(bias[free]) / np.sqrt(np.diag(covariance)[free]), initial=0.0))
    shift = np.outer(bias, bias) if relative > NOTABLE_BIAS else 0.0
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
    unknown = np.logical_or(identified.touched, ~free)
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
    )


def _looked_at_for_a_better_one(found: Estimate) -> Estimate:
    """Refuse the best of several valleys where its residual still has a course of its own.

    Around declared starts the right valley may have been missed; in rows without a time nothing but
    a poor fit makes neighbours so alike. A start of the user's own says that this is the valley.
    """
    places = valleys(found.outcomes)
    over = correlation_time(found.problem, found.point, tables=True) if places > 1 else 1.0
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


def _of_tables(problem: Problem, point: Point) -> Iterator[str]:
    """That neighbouring rows of a table are alike, in case they followed each other in time."""
    if not any(run.time is None and ENOUGH <= len(run) < TABLE for run in problem.runs):
        return
    over = correlation_time(problem, point, tables=True)
    if over > 1:
        yield (
            f"residuals of neighbouring rows are alike (over {over:.2g} rows), which counts for "
            "nothing in rows without a time; if they followed each other, say so with --rate: "
            f"standard deviations grow by about {np.sqrt(over):.2g}"
        )


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


def _by_estimator(optimum: Estimate, function: Callable[..., Any], name: str) -> Estimate:
    """The values of an estimator of the model's own, judged by the least-squares optimum."""
    problem, began = optimum.problem, time.perf_counter()
    known = {p.name for p in problem.model.parameters}
    try:
        values = function(problem.model, problem.runs)
        values = {name: value for name, value in values.items() if name in known}
    except NotTrusted as error:
        refused = optimum.certificate.refused(Code.MODEL, str(error))
        return replace(optimum, certificate=refused, extra={"estimator": name})
    seconds = time.perf_counter() - began
    point = problem.point(values)
    return replace(
        optimum,
        point=point,
        optimum=optimum.point,
        values=problem.values(point),
        rmse=float(np.sqrt(2 * problem.cost(point) / problem.residual_count)),
        certificate=_judged(optimum, point, values, name),
        extra={
            "estimator": name,
            "seconds": seconds,
            "least_squares_seconds": optimum.outcomes[0].seconds,
        },
    )


def _judged(optimum: Estimate, point: Point, values: Mapping[str, Any], name: str) -> Certificate:
    """Trust an estimator's values only near a trusted optimum; say how far from it they are."""
    certificate, problem = optimum.certificate, optimum.problem
    if not certificate.trusted:
        return certificate
    kept = problem.values(point)
    if not all(np.allclose(kept[name], values[name], rtol=1e-6, atol=1e-9) for name in kept):
        return certificate.refused(Code.MODEL, words.collapsed(name))
    away = problem.difference(point, optimum.point)
    distance = away / np.sqrt(np.diag(optimum.covariance))
    worst = int(np.argmax(np.abs(distance)))
    far = words.from_optimum(name, problem.names[worst], abs(distance[worst]))
    if not abs(distance[worst]) <= NEAR:
        return certificate.refused(Code.MODEL, far)
    return replace(certificate, reasons=(far, *certificate.reasons))


def _noise(problem: Problem, point: Point, length: float, dof: int) -> Noise:
    """Noise of one residual: what is left over; with few degrees of freedom to judge that by,
    never less than what repeats (rest intervals) show."""
    residual = length / np.sqrt(dof) if dof > 0 else float("nan")
    repeats = repeat_noise(problem, point)
    if dof >= ENOUGH_FREEDOM:
        return Noise(residual, residual, repeats, dof)
    candidates = [s for s in (residual, repeats) if s is not None and np.isfinite(s)]
    return Noise(max(candidates, default=float("nan")), residual, repeats, dof)
