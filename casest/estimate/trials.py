"""A fit repeated many times at once, each time with other errors of what went into it.

Readings are those that the fit makes of them (adjusted ones, with no error that it can tell), plus
noise as it was stated or found; known numbers and priors are drawn from their distributions. All
trials are solved side by side by damped Gauss-Newton steps, true values of noisy signals with them.
Nothing here is to first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.declaration.model import Model
from casest.declaration.noise import MEAN, root_of, slope_in_noisy
from casest.declaration.shapes import Array
from casest.declaration.tracing import sample_symbol
from casest.engine import Replay
from casest.errors import UsageError
from casest.estimate.covariance import inverse_normal
from casest.estimate.estimate import Estimate
from casest.estimate.propagation import extended_at
from casest.leastsquares.problem import Point, Problem, prior_rows
from casest.leastsquares.sums import signal_noise

#: Rows (trials times samples) that are evaluated at once.
ROWS = 100_000
#: Steps at most, the last one in standard deviations of the unknowns, a damping that is slight, and
#: a rise of the sum of squares over their variance that is nothing.
STEPS, STILL, SLIGHT, NOTHING = 60, 1e-4, 1e-3, 1e-3


class Trials(NamedTuple):
    """Unknowns (T, n) and known numbers (T, k) of T trials, and which of them found a minimum."""

    unknowns: Array
    known: Array
    settled: NDArray[np.bool_]


@dataclass(frozen=True)
class _Record:
    """One run: whole samples (N, width) with adjusted values, roots (N, k, k) of the noise of the
    `noisy` columns (k,), mean (N, m) of the residual, and the unknowns and references it sees."""

    samples: Array
    root: Array
    mean: Array
    seen: NDArray[np.intp]
    references: Array


@dataclass(frozen=True)
class Refits:
    """What trials of one estimate have in common; see `of`.

    Unknowns are those of `problem`, in which the uncertain known numbers are unknowns too, at
    `own` and `known`; `stated`: true values of the signals `names` are sought.
    """

    estimate: Estimate
    problem: Problem
    point: Point
    own: NDArray[np.intp]
    known: NDArray[np.intp]
    names: tuple[str, ...]
    stated: bool

    @classmethod
    def of(cls, estimate: Estimate) -> Refits:
        """Raises UsageError where samples are not each for itself, or weigh by their residual."""
        problem, model = estimate.problem, estimate.model
        where = "Monte Carlo follows no"
        if problem.sequential or model.resting:
            raise UsageError(f"{model.name}: {where} residual that depends on other samples")
        if problem.weights is not None or problem.whitening is not None:
            raise UsageError(f"{model.name}: {where} effect on the noise, nor several kinds of it")
        plain = Problem(model.without_noise, problem.runs)
        at = estimate.optimum or estimate.point
        extended, there, own, known = extended_at(plain, at)
        stated = model.noise is not None
        if model.noise is not None:
            names = model.noise.signals
        elif model.implicit:
            each = signal_noise(problem, at, estimate.noise.sigma)
            names = tuple(s.name for s, std in zip(model.signals, each, strict=True) if std > 0)
        else:
            names = (str(model.traced.measured),)
        return cls(estimate, extended, there, own, known, names, stated)

    @property
    def first_order(self) -> Array:
        """Covariance (n, n) of the unknowns, to first order, by the noise that trials have."""
        estimate = self.estimate
        R = estimate.problem.factor(estimate.optimum or estimate.point)[0]
        found = estimate.noise.sigma**2 * inverse_normal(R, estimate.free)
        return found if estimate.inputs is None else found + estimate.inputs.carried

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the size of the noise; infinite where it is known."""
        noise = self.estimate.noise
        known = noise.known or self.estimate.model.prior is not None
        return np.inf if known else float(noise.degrees_of_freedom)

    @cached_property
    def _scale(self) -> float:
        """By which residuals are divided, so that one standard deviation is about one."""
        return self.estimate.problem.noise_scale or float(self.estimate.noise.sigma)

    @cached_property
    def _records(self) -> tuple[_Record, ...]:
        return tuple(self._record(r) for r in range(len(self.problem.runs)))

    def _record(self, r: int) -> _Record:
        run = self.problem.runs[r]
        seen, ref = self.problem.seen(r)
        samples = np.array(self.problem.samples[r].dense, dtype=float)
        m = len(self.problem.model.axes)
        mean = run.signals[MEAN] if self.stated else np.zeros((len(run), m))
        references = np.append(self.point.references[ref], 0.0)
        found = _Record(samples, self._root(r), mean, seen, references)
        true = self._adjusted(found, samples[:, self.columns])
        samples[:, self.columns] = true
        return found

    def _root(self, r: int) -> Array:
        """Roots of the covariance of the noise of each sample of a run, (N, k, k)."""
        run, stated = self.problem.runs[r], self.estimate.model.noise
        groups = stated.together if stated is not None else tuple((n,) for n in self.names)
        sizes = [sum(map(self._size, group)) for group in groups]
        found, first = np.zeros((len(run), sum(sizes), sum(sizes))), 0
        each = None
        if not self.stated and self.problem.model.implicit:
            at = self.estimate.optimum or self.estimate.point
            noise = signal_noise(self.estimate.problem, at, self._scale)
            each = dict(zip((s.name for s in self.problem.model.signals), noise, strict=True))
        for group, size in zip(groups, sizes, strict=True):
            span = slice(first, first + size)
            if self.stated:
                held = run.signals[root_of(group)]
                diagonal = held.shape[1] == size
                own = held[:, :, None] * np.eye(size) if diagonal else held.reshape(-1, size, size)
            else:
                own = np.eye(size) * (self._scale if each is None else each[group[0]])
            found[:, span, span], first = own, first + size
        return found

    def _size(self, name: str) -> int:
        return int(self.problem.model[name].size)

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Where the noisy signals are in a sample, (k,)."""
        places, first = {}, 0
        for s in self.problem.model.signals:
            places[s.name], first = range(first, first + s.size), first + s.size
        return np.array([i for name in self.names for i in places[name]])

    def _evaluated(self, record: _Record, samples: Array, x: Array) -> tuple[Array, Array, Array]:
        """r (R, m), ∂r/∂x (R, m, n) and ∂r/∂s (R, m, k) of rows of samples and unknowns."""
        found = _sampled(self.problem.model, self.names)(
            record.references, np.column_stack([samples, x])
        )
        return found[0][:, :, 0], found[1], found[2]

    def _adjusted(self, record: _Record, reading: Array) -> Array:
        """True values (N, k) nearest to the readings, at the estimate."""
        true, samples = reading.copy(), record.samples.copy()
        x = np.tile(self.point.x[record.seen], (len(samples), 1))
        spread = np.sqrt(np.sum(record.root**2, axis=2))
        for _ in range(STEPS):
            samples[:, self.columns] = true
            r, _, G = self._evaluated(record, samples, x)
            off = reading - true
            w = r + np.einsum("nmk,nk->nm", G, off)
            step = off - np.einsum("nkm,nm->nk", _pull(G, record.root)[1], w)
            true = true + step
            if np.all(np.abs(step) <= 1e-9 * spread):
                break
        return true

    def run(self, count: int, rng: np.random.Generator) -> Trials:
        """So many trials."""
        rows = max(sum(len(run) for run in self.problem.runs), 1)
        most = max(1, ROWS // rows)
        parts = [self._some(min(most, count - k), rng) for k in range(0, count, most)]
        return Trials(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _some(self, count: int, rng: np.random.Generator) -> Trials:
        x = np.tile(self.point.x, (count, 1))
        x[:, self.known] += self._drawn_numbers(count, rng)
        size = np.full(count, self.estimate.noise.sigma / self._scale)
        if np.isfinite(self.freedom):  # how large the noise is is not known better than this
            size *= np.sqrt(self.freedom / rng.chisquare(self.freedom, count))
        readings = []
        for record in self._records:
            z = rng.standard_normal((count, *record.root.shape[:2])) * size[:, None, None]
            noise = np.einsum("nkl,tnl->tnk", record.root, z)
            readings.append(record.samples[:, self.columns] + noise)
        prior = self._prior(count, rng)
        return self._solved(x, readings, prior)

    def _drawn_numbers(self, count: int, rng: np.random.Generator) -> Array:
        inputs = self.estimate.inputs
        if inputs is None:
            return np.zeros((count, 0))
        values, vectors = np.linalg.eigh(inputs.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(rng.standard_normal((count, len(values))) @ root.T)

    def _prior(self, count: int, rng: np.random.Generator) -> tuple[Array, Array] | None:
        """Slopes (p, n) of the rows of a prior and its errors (T, p), divided by the scale."""
        if self.estimate.model.prior is None:
            return None
        at = self.estimate.optimum or self.estimate.point
        rows = prior_rows(self.estimate.problem, at)[:, :-1] / self._scale
        sigma = self.estimate.noise.sigma / self._scale
        slopes = np.zeros((len(rows), self.problem.unknowns))
        slopes[:, self.own] = rows
        return slopes, sigma * rng.standard_normal((count, len(rows)))

    def _solved(self, x: Array, readings: list[Array], prior: tuple[Array, Array] | None) -> Trials:
        """Minima from the estimate; a step that makes the sum of squares larger is taken back."""
        free = self.own[self.estimate.free]
        lower, upper = (side[free] for side in self.problem.bounds)
        true = [reading.copy() for reading in readings]
        damping, settled = np.full(len(x), 1e-9), np.zeros(len(x), dtype=bool)
        here = self._normal(x, readings, true, prior)
        for _ in range(STEPS):
            own = here.matrix[:, free[:, None], free]
            step = _stepped(own, -here.slope[:, free], damping)
            step = np.clip(x[:, free] + step, lower, upper) - x[:, free]
            size = np.sqrt(np.maximum(np.einsum("tk,tkl,tl->t", step, own, step), 0.0))
            settled = (size <= STILL) & (damping <= SLIGHT)
            if settled.all():
                break
            trial, moved = x.copy(), here.moved(step, free)
            trial[:, free] += step
            sought = [t + d for t, d in zip(true, moved, strict=True)]
            there = self._normal(trial, readings, sought, prior)
            better = there.cost <= here.cost + NOTHING
            x = np.where(better[:, None], trial, x)
            true = [_chosen(better, new, old) for new, old in zip(sought, true, strict=True)]
            here = here.where_better(better, there)
            damping = np.where(better, 0.1 * damping, np.maximum(10 * damping, SLIGHT))
        return Trials(x[:, self.own], x[:, self.known], settled)

    def _normal(
        self, x: Array, readings: list[Array], true: list[Array], prior: tuple[Array, Array] | None
    ) -> _Normal:
        count, n = x.shape
        found = _Normal(np.zeros((count, n, n)), np.zeros((count, n)), np.zeros(count), [])
        for record, reading, at in zip(self._records, readings, true, strict=True):
            r, J, moves = self._rows(record, x[:, record.seen], reading, at)
            r, J = r.reshape(count, -1), J.reshape(count, -1, J.shape[2])
            turned = np.swapaxes(J, 1, 2)
            found.matrix[:, record.seen[:, None], record.seen] += turned @ J
            found.slope[:, record.seen] += (turned @ r[:, :, None])[:, :, 0]
            found.cost[:] += np.einsum("tm,tm->t", r, r)
            found.moves.append((*moves, record.seen))
        if prior is not None:
            slopes, errors = prior
            r = (x - self.point.x) @ slopes.T + errors
            found.matrix[:] += slopes.T @ slopes
            found.slope[:] += r @ slopes
            found.cost[:] += np.einsum("tp,tp->t", r, r)
        return found

    def _rows(
        self, record: _Record, x: Array, reading: Array, true: Array
    ) -> tuple[Array, Array, tuple[Array, Array]]:
        """Residuals (R, m) and slopes (R, m, n of the run) in standard deviations; where true
        values belong (T, N, k), and how they follow the unknowns (T, N, k, n)."""
        count, rows, k = reading.shape
        samples = np.tile(record.samples, (count, 1))
        samples[:, self.columns] = true.reshape(-1, k)
        r, J, G = self._evaluated(record, samples, np.repeat(x, rows, axis=0))
        if not self.stated:
            nothing = np.zeros((1, 1, 1))
            return r / self._scale, J / self._scale, (nothing, nothing[..., None])
        off = (reading - true).reshape(-1, k)
        D, pull = _pull(G, np.tile(record.root, (count, 1, 1)))
        w = r + np.einsum("nmk,nk->nm", G, off) - np.tile(record.mean, (count, 1))
        W = _whitening(D @ np.swapaxes(D, 1, 2))
        to = (off - np.einsum("nkm,nm->nk", pull, w)).reshape(reading.shape)
        return (
            np.einsum("nij,nj->ni", W, w),
            W @ J,
            (to, (-pull @ J).reshape(count, rows, k, -1)),
        )


class _Normal(NamedTuple):
    """JᵀJ (T, n, n), Jᵀr (T, n), Σr² (T,); moves of the true values of each run (`_rows`)."""

    matrix: Array
    slope: Array
    cost: Array
    moves: list[tuple[Array, Array, NDArray[np.intp]]]

    def moved(self, step: Array, free: NDArray[np.intp]) -> list[Array]:
        """What is added to the true values of each run with a step of the free unknowns."""
        whole = np.zeros_like(self.slope)
        whole[:, free] = step
        return [
            to + np.einsum("tnkj,tj->tnk", along, whole[:, seen]) if along.size > 1 else to
            for to, along, seen in self.moves
        ]

    def where_better(self, better: NDArray[np.bool_], there: _Normal) -> _Normal:
        """Those of `there` in trials that are better there."""
        if better.all():
            return there
        moves = [
            (_chosen(better, new[0], old[0]), _chosen(better, new[1], old[1]), old[2])
            if new[1].size > 1
            else new
            for new, old in zip(there.moves, self.moves, strict=True)
        ]
        return _Normal(
            _chosen(better, there.matrix, self.matrix),
            _chosen(better, there.slope, self.slope),
            _chosen(better, there.cost, self.cost),
            moves,
        )


def _chosen(better: NDArray[np.bool_], new: Array, old: Array) -> Array:
    return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def _stepped(matrix: Array, slope: Array, damping: Array) -> Array:
    """(M + λD)⁻¹g of each trial, with unit diagonals inside."""
    scale = np.sqrt(np.maximum(np.einsum("tkk->tk", matrix), 1e-300))
    scaled = matrix / scale[:, :, None] / scale[:, None, :]
    scaled = scaled + damping[:, None, None] * np.eye(matrix.shape[1])
    return np.asarray(np.linalg.solve(scaled, (slope / scale)[:, :, None])[:, :, 0] / scale)


def _pull(G: Array, root: Array) -> tuple[Array, Array]:
    """G·R (N, m, k), and CGᵀV⁻¹ (N, k, m), by which a residual pulls true values."""
    D = G @ root
    turned = np.swapaxes(D, 1, 2)
    return D, root @ turned @ _inverse(D @ turned)


def _inverse(matrices: Array) -> Array:
    return np.asarray(1 / matrices if matrices.shape[1] == 1 else np.linalg.inv(matrices))


def _whitening(V: Array) -> Array:
    if V.shape[1] == 1:
        return np.asarray(1 / np.sqrt(V))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(V)))


@lru_cache(maxsize=16)
def _sampled(model: Model, names: tuple[str, ...]) -> Replay:
    """r, ∂r/∂x and ∂r/∂s of (references and a nought, [sample, unknowns])."""
    t = model.traced
    J = ca.densify(ca.jacobian(t.expression, t.coordinates))
    G = ca.densify(slope_in_noisy(t, names))
    parameters = ca.vertcat(t.references, ca.SX.sym("none"))
    sample = ca.vertcat(sample_symbol(model), t.coordinates)
    inputs = [parameters, sample]
    return Replay(ca.Function("trials", inputs, [ca.densify(t.expression), J, G],
                              ["parameters", "sample"], ["r", "J", "G"]))  # fmt: skip
