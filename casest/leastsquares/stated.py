"""Noise that was stated of single readings, put beside them; what it makes of each residual.

χ² then has a meaning: the sum of squared residuals in units of their noise, of which as many are
expected as there are degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

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
    bare, alone = Problem(model.without_noise, problem.runs), model.traced.measured
    parts = [
        _linearised(bare.model, bare.parameters(bare.start(), r), run, noise, noisy=alone)
        for r, run in enumerate(bare.runs)
    ]
    variance = np.concatenate([np.diagonal(p.variance) for p in parts])
    for k, axis in enumerate(model.axes):
        if not (variance[:, k] > 0).all():
            missing = [s.name for s in model.readings if s.name not in noise.signals]
            also = f": say that of {' and '.join(missing)} too" if missing else ""
            raise UsageError(f"the residual {axis} of {model.name} has no stated noise{also}")
    noise = replace(noise, scale=float(np.sqrt(np.median(variance))))
    runs = [_with(p, run, noise, p.reading) for p, run in zip(parts, problem.runs, strict=True)]
    return Problem(replace(model, noise=noise), tuple(runs))


@dataclass(frozen=True)
class _Linear:
    """One run around estimates of its true values, sample by sample along the last axis, which is
    how they are computed: reading and true values (k, N), residual at these (m, N), slope G
    (m, k, N), CGᵀ (k, m, N), variance V (m, m, N)."""

    reading: Array
    true: Array
    residual: Array
    slope: Array
    pull: Array
    variance: Array

    @property
    def likeliest(self) -> Array:
        """ξ (k, N) = s - CGᵀV⁻¹w."""
        w = self.residual + np.einsum("mkn,kn->mn", self.slope, self.reading - self.true)
        pulled = np.einsum("abn,bn->an", _inverse(self.variance), w)
        return np.asarray(self.reading - np.einsum("kmn,mn->kn", self.pull, pulled))


def _linearised(
    model: Model, parameters: Array, run: Run, noise: Stated, noisy: str | None = None
) -> _Linear:
    """The residual and its slope at the true values that a run holds; else at the readings.

    Of the noise of one signal alone, if `noisy` names it. The model is without stated noise.
    """
    sizes = [run.signals[name].shape[1] for name in noise.signals]
    first = np.cumsum([0, *sizes])
    places = {name: slice(*ends) for name, ends in zip(noise.signals, pairwise(first), strict=True)}
    reading = np.concatenate([run.signals[name].T for name in noise.signals])
    true = run.signals[TRUE].T if TRUE in run.signals else reading
    at = [
        true[places[s.name]].T if s.name in places else run.signals[s.name] for s in model.signals
    ]
    residual, slope = _residual_and_slope(model, noise.signals).by_entry(parameters, Columns(at))
    pulls = []
    for group in noise.together:
        own = slice(places[group[0]].start, places[group[-1]].stop)
        pull = _times_covariance(run.signals[root_of(group)], slope[:, own])
        pulls.append(pull if noisy is None or noisy in group else np.zeros_like(pull))
    pull = np.concatenate(pulls)
    variance = np.einsum("akn,kbn->abn", slope, pull)
    return _Linear(reading, true, residual[:, 0], slope, pull, variance)


@lru_cache(maxsize=64)
def _residual_and_slope(model: Model, names: tuple[str, ...]) -> Replay:
    """r and G of one sample of a model without stated noise."""
    plain = trace(model)
    outputs = {"r": plain.expression, "G": ca.densify(slope_in_noisy(plain, names))}
    return Replay(function_of(model, outputs, plain))


def _times_covariance(root: Array, slope: Array) -> Array:
    """CGᵀ (k, m, N) of signals together, from standard deviations (N, k) or roots (N, k²)."""
    k = slope.shape[1]
    transposed = np.swapaxes(slope, 0, 1)
    if root.shape[1] == k:
        return np.asarray(root.T[:, None] ** 2 * transposed)
    matrix = root.T.reshape(k, k, -1)
    half = np.einsum("lin,lmn->imn", matrix, transposed)
    return np.asarray(np.einsum("iln,lmn->imn", matrix, half))


def _with(
    part: _Linear, run: Run, noise: Stated, true: Array | None = None, mean: Array | None = None
) -> Run:
    """The run with whitening, slope, true values (k, N) and the residual's mean (N, m) beside its
    signals."""
    m, k, n = part.slope.shape
    true = part.true if true is None else true
    mean = np.zeros((m, n)).T if mean is None else mean
    whitening = noise.scale * _inverse(_lower(part.variance))
    held = {WHITENING: whitening.reshape(m * m, n).T, SLOPE: part.slope.reshape(m * k, n).T}
    return replace(run, signals={**run.signals, **held, TRUE: true.T, MEAN: mean})


def settles(model: Model) -> bool:
    """Must the noise of the residuals be found together with the unknowns?

    It need not where the residual is as steep in the noisy signals everywhere.
    """
    noise = model.noise
    if noise is None or noise.as_read:
        return False
    return _steepness_varies(model.without_noise, noise)


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
    model, noise = problem.model.without_noise, problem.model.noise
    assert noise is not None
    runs = []
    for r, run in enumerate(problem.runs):
        parameters, read = problem.parameters(point, r), problem.as_taken(point, r)
        if _straight(model, noise.signals):
            # One step leads there, G and V are the same there, and b is zero.
            part = _linearised(model, parameters, read, noise)
            runs.append(_with(part, run, noise, part.likeliest))
            continue
        pieces = [slice(i, i + PIECE) for i in range(0, len(run), PIECE)]
        found = [_likeliest(model, parameters, read.take(own), noise) for own in pieces]
        read = replace(read, signals={**read.signals, TRUE: np.concatenate(found, axis=1).T})
        part = _linearised(model, parameters, read, noise)
        mean = _mean(model, parameters, read, part) if problem.model.implicit else None
        runs.append(_with(part, run, noise, mean=mean))
    return replace(problem, runs=tuple(runs))


def in_usual_units(problem: Problem) -> Problem:
    """The problem with the noise of a usual residual as its scale, that of the inputs with it,
    which hangs on how steep the model is: now it is known."""
    noise, m = problem.model.noise, len(problem.model.axes)
    assert noise is not None
    held = [run.signals[WHITENING].reshape(len(run), m, m) for run in problem.runs]
    lower = np.concatenate([np.linalg.inv(w) for w in held])
    usual = noise.scale * float(np.sqrt(np.median(np.sum(lower**2, axis=2))))
    larger = usual / noise.scale
    runs = [
        replace(run, signals={**run.signals, WHITENING: larger * run.signals[WHITENING]})
        for run in problem.runs
    ]
    model = replace(problem.model, noise=replace(noise, scale=usual))
    return replace(problem, model=model, runs=tuple(runs))


def _likeliest(model: Model, parameters: Array, run: Run, noise: Stated) -> Array:
    """ξ (k, N) = s - CGᵀV⁻¹w, with G and w where it is itself.

    Step by step, each sample for itself: where steps do not shrink, shorter ones are taken.
    """
    true, moving = run.signals[TRUE].T.copy(), np.arange(len(run))
    share, before = np.ones(len(run)), np.full(len(run), np.inf)
    spread = _deviations(run, noise)
    for _ in range(ROUNDS):
        own = run if len(moving) == len(run) else run.take(moving)
        own = replace(own, signals={**own.signals, TRUE: true[:, moving].T})
        part = _linearised(model, parameters, own, noise)
        step = part.likeliest - part.true
        size = np.max(np.abs(step) / spread[:, moving], axis=0)
        share[moving] *= np.where(size > SHRINKS * before[moving], 0.5, 1.0)
        true[:, moving] += share[moving] * step
        before[moving] = size
        moving = moving[size > STILL]
        if not len(moving):
            break
    return true


def _deviations(run: Run, noise: Stated) -> Array:
    """Standard deviations (k, N) of one reading of all noisy signals."""
    found = []
    for group in noise.together:
        root, k = run.signals[root_of(group)].T, sum(run.signals[n].shape[1] for n in group)
        matrix = None if len(root) == k else root.reshape(k, k, -1)
        found.append(root if matrix is None else np.sqrt(np.sum(matrix**2, axis=1)))
    return np.concatenate(found)


def _mean(model: Model, parameters: Array, run: Run, part: _Linear) -> Array:
    pull, inverse = (np.moveaxis(a, -1, 0) for a in (part.pull, _inverse(part.variance)))
    return bent(model, parameters, run, pull, inverse)


def shifts_of_curvature(problem: Problem, point: Point) -> Iterator[Array]:
    """Mean of each residual that comes of curvature, in units of the noise, (N, m) of each run."""
    model, noise = problem.model.without_noise, problem.model.noise
    assert noise is not None
    straight = _straight(model, noise.signals)
    for r, run in enumerate(problem.runs):
        if straight:
            yield np.zeros_like(run.signals[MEAN])
            continue
        parameters = problem.parameters(point, r)
        read = problem.as_taken(point, r)
        mean = _mean(model, parameters, read, _linearised(model, parameters, read, noise))
        whitening = run.signals[WHITENING].reshape(*mean.shape, -1)
        yield np.einsum("nij,nj->ni", whitening, mean)


def _inverse(matrices: Array) -> Array:
    """Inverse of each of (m, m, N); of single numbers quickly."""
    return np.asarray(1 / matrices) if len(matrices) == 1 else _each(np.linalg.inv, matrices)


def _lower(variance: Array) -> Array:
    return np.sqrt(variance) if len(variance) == 1 else _each(np.linalg.cholesky, variance)


def _each(function: Callable[[Any], Any], matrices: Array) -> Array:
    """What a function of (N, m, m) makes of (m, m, N)."""
    try:
        return np.ascontiguousarray(np.moveaxis(function(np.moveaxis(matrices, -1, 0)), 0, -1))
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
