"""Noise that was stated of single readings, put beside them; what it makes of each residual.

χ² then has a meaning: the sum of squared residuals in units of their noise, of which as many are
expected as there are degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.flow import Flow
from casest.declaration.model import Model
from casest.declaration.noise import (
    MEAN,
    SLOPE,
    TRUE,
    WHITENING,
    Stated,
    root_of,
    slope_in_noisy,
)
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat, function_of, trace
from casest.declaration.uncertainty import checked
from casest.engine import Columns, Replay
from casest.errors import DeclarationError, UsageError
from casest.leastsquares.bending import bent
from casest.leastsquares.problem import Point, Problem

#: Probability below which a sum of squares is no chance.
UNLIKELY = 1e-3
#: Samples at once, so that what is found of them on the way stays in the processor's cache.
PIECE = 4096
#: Rounds in which true values are sought at one point, the share of their noise by which they may
#: still move after the last, and the share of a step that the next one may have.
ROUNDS, STILL, SHRINKS = 60, 1e-9, 0.8


@dataclass(frozen=True)
class ChiSquare:
    """Squared residuals in units of the stated noise, and how probable more or less of it is."""

    value: float
    degrees_of_freedom: int

    @property
    def times(self) -> float:
        """How many times as large as the stated noise the residual is."""
        return float(np.sqrt(self.value / self.degrees_of_freedom))

    @property
    def larger(self) -> float:
        """Probability of as much or more."""
        from scipy.special import chdtrc

        return float(chdtrc(self.degrees_of_freedom, self.value))

    @property
    def smaller(self) -> float:
        """Probability of as little or less."""
        from scipy.special import chdtr

        return float(chdtr(self.degrees_of_freedom, self.value))


def stated_noise(
    model: Model, runs: Sequence[Run], noise: Mapping[str, Sequence[Array]]
) -> tuple[Model, tuple[Run, ...]]:
    """The model whose residual is in units of the noise, and the runs that hold it.

    `noise` has for each signal an array for each run: standard deviations of one reading (k,) or
    (N, k), or covariances (1, k, k) or (N, k, k), in the signal's unit; for signals whose noise is
    correlated covariances of all their numbers one after the other, under "x,y". Of a rest interval
    the mean has less, by the root of its count. Signals that are not named have the noise that they
    were declared with, else they are exact. Raises UsageError where a residual has no noise at all.
    """
    said = {name for key in noise for name in key.split(",")}
    own = {
        s.name: [np.array([s.std])] * len(runs)
        for s in model.signals
        if s.std is not None and s.name not in said
    }
    noise = {**own, **noise}
    if not noise:
        return model, tuple(runs)
    groups = _groups(model, noise)
    _refuse_of_equations(model, [name for group in groups for name in group])
    names = tuple(name for group in groups for name in group)
    form = Stated(names, len(model.axes), groups=groups if len(names) > len(groups) else ())
    held = []
    for r, run in enumerate(runs):
        roots = {root_of(g): roots_of(g, noise[",".join(g)][r], run) for g in groups}
        flat = {name: root.reshape(len(run), -1) for name, root in roots.items()}
        held.append(replace(run, signals={**run.signals, **flat}))
    problem = _begun(Problem(replace(model, noise=form), tuple(held)))
    return problem.model, problem.runs


def _refuse_of_equations(model: Model, names: Sequence[str]) -> None:
    """UsageError where noise would bend the course of states, which here follow exact inputs."""
    flows = [stage for stage in model.staged.stages if isinstance(stage, Flow)]
    for name in names:
        own = flat(model.staged.symbols[name])
        if any(ca.depends_on(flow.taken, own) for flow in flows):
            raise UsageError(
                f"noise of {name}: it drives the states of {model.name}, and a calibration takes "
                "what drives them as exact: with it this is an estimator in motion (casest filter, "
                f"observe or close with the noise of every reading); else leave that of {name} out"
            )


def _groups(model: Model, noise: Mapping[str, object]) -> tuple[tuple[str, ...], ...]:
    """Signals with those that their noise is correlated with, in the model's order."""
    known = {s.name: k for k, s in enumerate(model.signals) if s.kind == "plain"}
    groups = [tuple(key.split(",")) for key in noise]
    for name in (every := [name for group in groups for name in group]):
        if name not in known:
            raise UsageError(f"noise of {name!r}: {model.name} has the signals {', '.join(known)}")
        if every.count(name) > 1:
            raise UsageError(
                f"noise of {name} is stated twice: once, with all it is correlated with"
            )
    return tuple(sorted(groups, key=lambda group: min(known[name] for name in group)))


def roots_of(group: tuple[str, ...], given: Array, run: Run) -> Array:
    """Standard deviations (N, k) or roots of covariances (N, k, k) of the noise of each sample.

    `given` is that of one reading of the signals of a group together (see `stated_noise`).
    """
    name, size = " and ".join(group), sum(run.signals[n].shape[1] for n in group)
    array = np.asarray(given, dtype=float)
    count = np.sqrt(run.count)[:, None]
    if array.ndim == 3:
        for covariance in np.unique(array.reshape(-1, size, size), axis=0):
            _check(name, covariance)
        return np.asarray(np.broadcast_to(_root(array), (len(run), size, size)) / count[:, :, None])
    try:
        std = np.broadcast_to(array, (len(run), size))
    except ValueError:
        raise UsageError(
            f"noise of {name} has shape {array.shape}: give one standard deviation, or {size}, or "
            f"that of each of {len(run)} samples"
        ) from None
    bad = np.flatnonzero(~(np.isfinite(std) & (std > 0)).all(axis=1))
    if bad.size:
        row = int(np.asarray(run.rows)[bad[0]])
        raise UsageError(
            f"noise of {name} is {np.min(std[bad[0]]):g} in row {row} of {run.file or run.name}: a "
            "standard deviation is above zero"
        )
    return np.asarray(std / count)


def _check(name: str, covariance: Array) -> None:
    try:
        checked(covariance)
    except DeclarationError as error:
        raise UsageError(f"noise of {name}: {error}") from None
    if not (np.diag(covariance) > 0).all():
        raise UsageError(f"noise of {name}: a variance is above zero")


def _root(covariance: Array) -> Array:
    """Symmetric root: it is there, too, where a combination has no noise."""
    values, vectors = np.linalg.eigh(covariance)
    scaled = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return np.asarray(scaled @ np.swapaxes(vectors, -1, -2))


def _begun(problem: Problem) -> Problem:
    """The problem with the noise of each residual at the start, and a usual one's as its scale.

    Where the model predicts readings, that of the measured signal alone: what inputs add depends
    on how steep the model is, which a start does not know.
    """
    model, noise = problem.model, problem.model.noise
    assert noise is not None
    bare, alone = Problem(replace(model, noise=None), problem.runs), model.traced.measured
    parts = [
        _linearised(bare.model, bare.parameters(bare.start(), r), run, noise, noisy=alone)
        for r, run in enumerate(bare.runs)
    ]
    variance = np.concatenate([np.diagonal(p.variance, axis1=1, axis2=2) for p in parts])
    for k, axis in enumerate(model.axes):
        if not (variance[:, k] > 0).all():
            missing = [s.name for s in model.readings if s.name not in noise.signals]
            also = f": say that of {' and '.join(missing)} too" if missing else ""
            raise UsageError(f"the residual {axis} of {model.name} has no stated noise{also}")
    noise = replace(noise, scale=float(np.sqrt(np.median(variance))))
    runs = [
        _with(p, run, noise, true=p.reading) for p, run in zip(parts, problem.runs, strict=True)
    ]
    return Problem(replace(model, noise=noise), tuple(runs))


@dataclass(frozen=True)
class _Linear:
    """One run around estimates of its true values: reading (N, k), residual at them (N, m), slope
    G (N, m, k), CGᵀ (N, k, m), variance V (N, m, m)."""

    reading: Array
    residual: Array
    slope: Array
    pull: Array
    variance: Array


def _linearised(
    model: Model, parameters: Array, run: Run, noise: Stated, noisy: str | None = None
) -> _Linear:
    """The residual and its slope at the true values that a run holds; else at the readings.

    Of the noise of one signal alone, if `noisy` names it. The model is without stated noise.
    """
    sizes = [run.signals[name].shape[1] for name in noise.signals]
    widths = dict(zip(noise.signals, sizes, strict=True))
    reading = np.concatenate([run.signals[name] for name in noise.signals], axis=1)
    true = run.signals.get(TRUE, reading)
    at = dict(zip(noise.signals, np.split(true, np.cumsum(sizes)[:-1], axis=1), strict=True))
    samples = Columns([at.get(s.name, run.signals[s.name]) for s in model.signals])
    residual, slope = _residual_and_slope(model, noise.signals)(parameters, samples)
    pulls, first = [], 0
    for group in noise.together:
        last = first + sum(widths[name] for name in group)
        pull = _times_covariance(run.signals[root_of(group)], slope[:, :, first:last])
        pulls.append(pull * (noisy is None or noisy in group))
        first = last
    pull = np.concatenate(pulls, axis=1)
    return _Linear(reading, residual[:, :, 0], slope, pull, slope @ pull)


@lru_cache(maxsize=64)
def _residual_and_slope(model: Model, names: tuple[str, ...]) -> Replay:
    """r and G of one sample of a model without stated noise."""
    plain = trace(model)
    outputs = {"r": plain.expression, "G": ca.densify(slope_in_noisy(plain, names))}
    return Replay(function_of(model, outputs, plain))


def _times_covariance(root: Array, slope: Array) -> Array:
    """CGᵀ (N, k, m) of signals together, from standard deviations (N, k) or roots (N, k²)."""
    k = slope.shape[2]
    transposed = np.swapaxes(slope, 1, 2)
    if root.shape[1] == k:
        return np.asarray(root[:, :, None] ** 2 * transposed)
    matrix = root.reshape(-1, k, k)
    return np.asarray(matrix @ np.swapaxes(matrix, 1, 2) @ transposed)


def _with(part: _Linear, run: Run, noise: Stated, true: Array, mean: Array | None = None) -> Run:
    """The run with whitening, slope, true values and the residual's mean beside its signals."""
    n, m = part.residual.shape
    mean = np.zeros((n, m)) if mean is None else mean
    whitening = noise.scale * _inverse(_lower(part.variance))
    held = {WHITENING: whitening.reshape(n, -1), SLOPE: part.slope.reshape(n, -1)}
    return replace(run, signals={**run.signals, **held, TRUE: true, MEAN: mean})


def settles(model: Model) -> bool:
    """Must the noise of the residuals be found together with the unknowns?

    It need not where the residual is as steep in the noisy signals everywhere.
    """
    return model.noise is not None and _steepness_varies(replace(model, noise=None), model.noise)


@lru_cache(maxsize=64)
def _steepness_varies(model: Model, noise: Stated) -> bool:
    plain = trace(model)
    slope = slope_in_noisy(plain, noise.signals)
    return bool(ca.symvar(slope)) or noise.signals != (plain.measured,)


@lru_cache(maxsize=64)
def _straight(model: Model, names: tuple[str, ...]) -> bool:
    """Is the residual of a model without stated noise linear in its noisy signals?"""
    plain = trace(model)
    noisy = ca.vertcat(*[flat(plain.symbols[name]) for name in names])
    return not ca.depends_on(slope_in_noisy(plain, names), noisy)


def at_true_values(problem: Problem, point: Point) -> Problem:
    """The problem with ξ, G, V and b as they are at a point, ξ as likely as can be."""
    model, noise = replace(problem.model, noise=None), problem.model.noise
    assert noise is not None
    runs = []
    for r, run in enumerate(problem.runs):
        parameters = problem.parameters(point, r)
        pieces = [slice(i, i + PIECE) for i in range(0, len(run), PIECE)]
        found = [_likeliest(model, parameters, run.take(own), noise) for own in pieces]
        true = np.concatenate(found)
        run = replace(run, signals={**run.signals, TRUE: true})
        part = _linearised(model, parameters, run, noise)
        mean = _mean(model, parameters, run, part) if problem.model.implicit else None
        runs.append(_with(part, run, noise, true, mean))
    return replace(problem, runs=tuple(runs))


def _likeliest(model: Model, parameters: Array, run: Run, noise: Stated) -> Array:
    """ξ (N, k) = s - CGᵀV⁻¹w, with G and w where it is itself.

    Step by step, each sample for itself: where steps do not shrink, shorter ones are taken. Where
    the residual is straight in the noisy signals the first step leads there.
    """
    if _straight(model, noise.signals):
        return run.signals[TRUE] + _step(_linearised(model, parameters, run, noise), run, noise)[0]
    true, moving = run.signals[TRUE].copy(), np.arange(len(run))
    share, before = np.ones(len(run)), np.full(len(run), np.inf)
    for _ in range(ROUNDS):
        own = run if len(moving) == len(run) else run.take(moving)
        own = replace(own, signals={**own.signals, TRUE: true[moving]})
        step, size = _step(_linearised(model, parameters, own, noise), own, noise)
        share[moving] *= np.where(size > SHRINKS * before[moving], 0.5, 1.0)
        true[moving] += share[moving, None] * step
        before[moving] = size
        moving = moving[size > STILL]
        if not len(moving):
            break
    return true


def _step(part: _Linear, run: Run, noise: Stated) -> tuple[Array, Array]:
    """Step (N, k) of ξ, and its length (N,) in standard deviations of a reading."""
    true = run.signals[TRUE]
    w = part.residual + np.einsum("nmk,nk->nm", part.slope, part.reading - true)
    pulled = _inverse(part.variance) @ w[:, :, None]
    step = part.reading - (part.pull @ pulled)[:, :, 0] - true
    roots = [
        (run.signals[root_of(group)], sum(run.signals[n].shape[1] for n in group))
        for group in noise.together
    ]
    spread = np.concatenate([_deviations(*of) for of in roots], axis=1)
    return step, np.max(np.abs(step) / spread, axis=1)


def _deviations(root: Array, k: int) -> Array:
    """Standard deviations (N, k) from themselves, or from roots (N, k²)."""
    return root if root.shape[1] == k else np.sqrt(np.sum(root.reshape(-1, k, k) ** 2, axis=2))


def _mean(model: Model, parameters: Array, run: Run, part: _Linear) -> Array:
    return bent(model, parameters, run, part.pull, _inverse(part.variance))


def shifts_of_curvature(problem: Problem, point: Point) -> Iterator[Array]:
    """Mean of each residual that comes of curvature, in units of the noise, (N, m) of each run."""
    model, noise = replace(problem.model, noise=None), problem.model.noise
    assert noise is not None
    straight = _straight(model, noise.signals)
    for r, run in enumerate(problem.runs):
        if straight:
            yield np.zeros_like(run.signals[MEAN])
            continue
        parameters = problem.parameters(point, r)
        mean = _mean(model, parameters, run, _linearised(model, parameters, run, noise))
        whitening = run.signals[WHITENING].reshape(*mean.shape, -1)
        yield np.einsum("nij,nj->ni", whitening, mean)


def _inverse(matrices: Array) -> Array:
    """Inverse of each of (N, m, m); of single numbers quickly."""
    try:
        return np.asarray(1 / matrices if matrices.shape[1] == 1 else np.linalg.inv(matrices))
    except np.linalg.LinAlgError:
        raise UsageError(_DEPENDENT) from None


def _lower(variance: Array) -> Array:
    try:
        return np.asarray(
            np.sqrt(variance) if variance.shape[1] == 1 else np.linalg.cholesky(variance)
        )
    except np.linalg.LinAlgError:
        raise UsageError(_DEPENDENT) from None


_DEPENDENT = (
    "a combination of the residuals of a sample has no noise, so that it would have to vanish "
    "exactly: leave residuals out that follow from others, or state more noise"
)


def chi_square(problem: Problem, point: Point, rank: int) -> ChiSquare | None:
    """χ² of a fit of so many determined unknowns; None where no noise is known beforehand.

    Also where an effect on the noise counts what lies far out as less.
    """
    scale = problem.noise_scale
    if scale is None or problem.weights is not None:
        return None
    freedom = problem.residual_count - rank
    if not freedom:
        return None
    return ChiSquare(2 * problem.cost(point) / scale**2, freedom)
