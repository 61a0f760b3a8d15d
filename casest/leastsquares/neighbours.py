"""What rows with nearly the same inputs say about the noise, without believing any model.

Each row is predicted from its nearest neighbours in the space of the inputs by a local straight
line (in one input the pseudo-residuals of Gasser, Sroka & Jennen-Steinmetz 1986, Biometrika 73;
in several the same with a plane). The order of the rows plays no part. What is bent between
neighbours counts as noise: the scatter is an upper limit, and `resolved` says by how much it may
be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import function_of, sample_symbol
from casest.engine import Replay
from casest.leastsquares.problem import Point, Problem

#: Rows of one run that are predicted from their neighbours; of more, evenly chosen ones.
CENTRES = 3000
#: Rows of one run that are looked at in all.
LONG = 50_000
#: Fewer pseudo-residuals than this say nothing.
FEWEST = 10


@dataclass(frozen=True)
class Scatter:
    """Variances of one residual, pooled over components: what neighbours differ by, and what is.

    `neighbours` bounds the noise; `residual` is the sum of squares over the degrees of freedom;
    `spread` the variance of the readings about what the model says of them without the unknowns
    that bend it. `freedom` (two numbers): of the residual and of the neighbours' variance.
    `left` is the neighbours' variance of the residual itself: no structure in the readings can
    raise it once the model explains that.
    """

    neighbours: float
    residual: float
    spread: float
    left: float
    freedom: tuple[float, float]

    def p_value(self, left: bool = False) -> float:
        """Chance that noise alone leaves so much more than neighbours differ by (F test)."""
        from scipy.special import fdtrc

        within = self.left if left else self.neighbours
        ratio = self.residual / max(within, 1e-300)
        return float(fdtrc(*self.freedom, ratio))

    @property
    def resolved(self) -> float:
        """Share of the readings' spread that neighbours see as a course, not as scatter."""
        return 1 - min(self.neighbours / max(self.spread, 1e-300), 1.0)

    @property
    def explained(self) -> float:
        """Share of the readings' spread that the fit explains."""
        return 1 - self.residual / max(self.spread, 1e-300)


def scatter(problem: Problem, point: Point) -> Scatter | None:
    """The scatter of neighbours beside the residual; None where the rows cannot show it.

    For models that predict a reading from measured inputs, row by row.
    """
    model = problem.model
    if model.traced.integrates:
        return _in_time(problem, point)
    if model.implicit or problem.sequential or problem.weights is not None:
        return None
    freedom = problem.residual_count - problem.unknowns
    if freedom < 1 or model.traced.predicted is None:
        return None
    squares = np.zeros(3)
    dof = count = 0.0
    for r, samples in enumerate(problem.samples):
        chosen = samples.dense[some_of(len(samples))]
        y, e, plain = reading_of(model)(problem.parameters(point, r), chosen)
        if len(y) < FEWEST or not np.isfinite(e).all():
            continue
        C = predictors(inputs(model, chosen))
        y, e = y[:, :, 0], e[:, :, 0]
        rest = y - _fitted(plain, y)
        rows, axes = C.shape[0], y.shape[1]
        squares += [np.sum((C @ y) ** 2), np.sum((C @ e) ** 2), np.mean(rest**2) * rows * axes]
        dof += float(freedom_of(C)[0]) * axes
        count += rows * axes
    if count < FEWEST:
        return None
    own = float(2 * problem.cost(point) / freedom)
    return Scatter(
        float(squares[0] / count),
        own,
        float(squares[2] / count),
        float(squares[1] / count),
        (float(freedom), float(dof)),
    )


def _in_time(problem: Problem, point: Point) -> Scatter | None:
    """The same of differential equations: neighbours in time, each reading by itself."""
    freedom = problem.residual_count - problem.unknowns
    squares, dof, count = np.zeros(3), 0.0, 0
    for r, e in enumerate(problem.residuals(point) if freedom > 0 else ()):
        time = np.asarray(problem.runs[r].time, float)
        y = _readings(problem.model)(problem.parameters(point, r), problem.samples[r])[0][:, :, 0]
        for axis in range(y.shape[1]):
            there = np.flatnonzero(np.isfinite(y[:, axis]))[some_of(len(y))]
            if len(there) < FEWEST:
                continue
            C, free = _in_order(time[there].tobytes())
            own, left, rows = y[there, axis], e[there, axis], C.shape[0]
            squares += [np.sum((C @ own) ** 2), np.sum((C @ left) ** 2), np.var(own) * rows]
            dof += free
            count += rows
    if count < FEWEST:
        return None
    residual = float(2 * problem.cost(point) / freedom)
    neighbours, left, spread = (float(s) / count for s in squares)
    return Scatter(neighbours, residual, spread, left, (float(freedom), dof))


@lru_cache(maxsize=8)
def _in_order(time: bytes) -> tuple[Any, float]:
    """Predictors of readings at these times (N,), and their degrees of freedom: the same for every
    reading and every point that is asked about."""
    C = predictors(np.frombuffer(time)[:, None])
    return C, float(freedom_of(C)[0])


@lru_cache(maxsize=64)
def _readings(model: Model) -> Replay:
    """Readings of one sample as residuals have them: over their std where one is declared."""
    t = model.traced
    zero = ca.SX.zeros(t.reading.numel())
    return Replay(function_of(model, {"y": ca.densify(t.residual.of(t.reading, zero))}))


def some_of(count: int) -> Any:
    """Which rows of so many are looked at, chosen at random: enough to have near neighbours."""
    if count <= LONG:
        return slice(None)
    return np.sort(np.random.default_rng(0).permutation(count)[:LONG])


def inputs(model: Model, samples: Array) -> Array:
    """What the prediction reads of each sample, (N, d), each column by its own spread."""
    read, varies = by_spread(samples[:, list(read_by(model))])
    # Rows that differ in nothing are all neighbours.
    return np.asarray(read[:, varies]) if varies.any() else np.zeros((len(read), 1))


def by_spread(read: Array) -> tuple[Array, Array]:
    """Columns (…, N, d), each by its own spread, and which of them have one, (…, d)."""
    size = read.std(axis=-2)
    varies = size > 1e-12 * np.abs(read).max(axis=-2)
    return read / np.where(varies, size, 1.0)[..., None, :], varies


def predictors(x: Array) -> Any:
    """Sparse (rows, N): each row times the readings is one reading less its neighbours' line.

    Of length one, so that noise keeps its size. `x` is (N, d), or (S, N, d) for S records, whose
    blocks stand side by side in one matrix, (S·rows, S·N).
    """
    from scipy.sparse import csr_array

    x = x.reshape(-1, *x.shape[-2:])
    records, count, dimensions = x.shape
    centres = np.unique(np.linspace(0, count - 1, min(count, CENTRES)).astype(int))
    near = _nearest_in_one(x[:, :, 0], centres) if dimensions == 1 else _nearest(x, centres)
    first = count * np.arange(records)[:, None, None]
    columns = np.concatenate(
        [np.broadcast_to(centres, near[..., :1].shape[:2])[..., None], near], 2
    )
    columns = (columns + first).reshape(-1, columns.shape[2])
    flat = x.reshape(-1, dimensions)
    weights = -_weights(flat[columns[:, 1:]] - flat[columns[:, :1]])
    values = np.column_stack([np.ones(len(columns)), weights])
    values /= np.linalg.norm(values, axis=1)[:, None]
    rows = np.repeat(np.arange(len(columns)), columns.shape[1])
    return csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(columns), len(flat)))


def freedom_of(C: Any, records: int = 1) -> Array:
    """Degrees of freedom of the variance that predictors give, for each of the records, (S,)."""
    shared = np.asarray((C @ C.T).power(2).sum(axis=1)).reshape(records, -1)
    return np.asarray(shared.shape[1] ** 2 / shared.sum(axis=1))


def _nearest_in_one(x: Array, centres: Any) -> Any:
    """The rows before and after in the order of the one input, (S, rows, 2)."""
    order = np.argsort(x, axis=1, kind="stable")
    place = np.argsort(order, axis=1)
    at = np.clip(place[:, centres], 1, x.shape[1] - 2)
    before, middle, after = (np.take_along_axis(order, at + k, axis=1) for k in (-1, 0, 1))
    # At an end the other two neighbours: the middle of the three stands for itself.
    before = np.where(before == centres, middle, before)
    after = np.where(after == centres, middle, after)
    return np.stack([before, after], axis=2)


def _nearest(x: Array, centres: Any) -> Any:
    from scipy.spatial import cKDTree

    k = min(2 * (x.shape[2] + 1), x.shape[1] - 1)
    found = np.array([cKDTree(own).query(own[centres], k + 1)[1] for own in x])
    own = found == centres[:, None]
    # Among many equal rows a row may not be its own nearest: the last one is left out then.
    own[~own.any(axis=2), -1] = True
    return found[~own].reshape(*found.shape[:2], k)


def _weights(away: Array) -> Array:
    """Weights of a local straight line at its centre, from neighbours at `away` (rows, k, d)."""
    scale = np.sqrt(np.mean(away**2, axis=(1, 2), keepdims=True))
    u = away / np.where(scale > 0, scale, 1.0)
    if u.shape[1:] == (2, 1):
        return _between_two(u[:, :, 0])
    return _at_centre(u)


def _between_two(u: Array) -> Array:
    """The same where the line goes through both; of one place, their mean; (rows, 2)."""
    apart = u[:, 1] - u[:, 0]
    close = ~(np.abs(apart) > 0.01)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.column_stack([u[:, 1], -u[:, 0]]) / apart[:, None]
    if close.any():
        found[close] = _at_centre(u[close, :, None])
    return found


def _at_centre(u: Array) -> Array:
    design = np.ones((*u.shape[:2], u.shape[2] + 1))
    design[:, :, 1:] = u
    return np.asarray(np.linalg.pinv(design, rcond=1e-3)[:, 0, :])


def _fitted(plain: Array, y: Array) -> Array:
    """What a constant and the columns that no unknown bends explain of the readings, (N, m)."""
    found = np.zeros_like(y)
    for k in range(y.shape[1]):
        columns = np.column_stack([np.ones(len(y)), plain[:, k, :]])
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        found[:, k] = columns @ np.linalg.lstsq(columns, y[:, k], rcond=None)[0]
    return found


@lru_cache(maxsize=64)
def reading_of(model: Model) -> Replay:
    """Reading, residual, and columns of J that no unknown bends, of one sample."""
    t = model.traced
    J = ca.densify(ca.jacobian(t.expression, t.coordinates))
    bent = [bool(ca.depends_on(J[:, j], t.coordinates)) for j in range(J.shape[1])]
    still = [j for j, b in enumerate(bent) if not b]
    plain = ca.densify(J[:, still]) if still else ca.SX.zeros(J.shape[0], 1)
    return Replay(
        function_of(model, {"y": ca.densify(t.reading), "e": t.expression, "plain": plain})
    )


@lru_cache(maxsize=64)
def read_by(model: Model) -> tuple[int, ...]:
    """Places in a sample of the numbers that the prediction depends on."""
    t, sample = model.traced, sample_symbol(model)
    columns = ca.jacobian(t.predicted, sample).sparsity().get_triplet()[1]
    ends = np.cumsum([0, *(s.size for s in model.signals)])
    own = {
        j
        for s, (a, b) in zip(model.signals, pairwise(ends.tolist()), strict=True)
        if s.name == t.measured
        for j in range(a, b)
    }
    return tuple(sorted(set(columns) - own))
