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
    if model.implicit or problem.sequential or problem.weights is not None:
        return None
    freedom = problem.residual_count - problem.unknowns
    if freedom < 1 or model.traced.predicted is None:
        return None
    squares = np.zeros(3)
    dof = count = 0.0
    for r, samples in enumerate(problem.samples):
        chosen = _some(samples.dense)
        y, e, plain = _reading(model)(problem.parameters(point, r), chosen)
        if len(y) < FEWEST or not np.isfinite(e).all():
            continue
        C = predictors(inputs(model, chosen))
        y, e = y[:, :, 0], e[:, :, 0]
        rest = y - _fitted(plain, y)
        rows, axes = C.shape[0], y.shape[1]
        squares += [np.sum((C @ y) ** 2), np.sum((C @ e) ** 2), np.mean(rest**2) * rows * axes]
        dof += rows**2 / float((C @ C.T).power(2).sum()) * axes
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


def _some(samples: Array) -> Array:
    """Rows of a longer record, chosen at random: enough to have near neighbours."""
    if len(samples) <= LONG:
        return samples
    return samples[np.sort(np.random.default_rng(0).permutation(len(samples))[:LONG])]


def inputs(model: Model, samples: Array) -> Array:
    """What the prediction reads of each sample, (N, d), each column by its own spread."""
    read = samples[:, list(_read(model))]
    size = read.std(axis=0)
    varies = size > 1e-12 * np.abs(read).max(axis=0)
    size = np.where(varies, size, 1.0)
    # Rows that differ in nothing are all neighbours.
    return np.asarray((read / size)[:, varies]) if varies.any() else np.zeros((len(read), 1))


def predictors(x: Array) -> Any:
    """Sparse (rows, N): each row times the readings is one reading less its neighbours' line.

    Of length one, so that noise keeps its size.
    """
    from scipy.sparse import csr_array

    count, dimensions = x.shape
    centres = np.unique(np.linspace(0, count - 1, min(count, CENTRES)).astype(int))
    near = _nearest_in_one(x, centres) if dimensions == 1 else _nearest(x, centres)
    weights = -_weights(x[near] - x[centres][:, None, :])
    columns = np.column_stack([centres, near])
    values = np.column_stack([np.ones(len(centres)), weights])
    values /= np.linalg.norm(values, axis=1)[:, None]
    rows = np.repeat(np.arange(len(centres)), columns.shape[1])
    return csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(centres), count))


def _nearest_in_one(x: Array, centres: Any) -> Any:
    """The rows before and after in the order of the one input."""
    order = np.argsort(x[:, 0], kind="stable")
    place = np.empty(len(x), dtype=int)
    place[order] = np.arange(len(x))
    at = np.clip(place[centres], 1, len(x) - 2)
    before, after = order[at - 1], order[at + 1]
    # At an end the other two neighbours: the middle of the three stands for itself.
    middle = order[at]
    before = np.where(before == centres, middle, before)
    after = np.where(after == centres, middle, after)
    return np.column_stack([before, after])


def _nearest(x: Array, centres: Any) -> Any:
    from scipy.spatial import cKDTree

    k = min(2 * (x.shape[1] + 1), len(x) - 1)
    found = np.asarray(cKDTree(x).query(x[centres], k + 1)[1])
    own = found == centres[:, None]
    # Among many equal rows a row may not be its own nearest: the last one is left out then.
    own[~own.any(axis=1), -1] = True
    return found[~own].reshape(len(centres), k)


def _weights(away: Array) -> Array:
    """Weights of a local straight line at its centre, from neighbours at `away` (rows, k, d)."""
    rows, k, d = away.shape
    scale = np.sqrt(np.mean(away**2, axis=(1, 2), keepdims=True))
    design = np.ones((rows, k, d + 1))
    design[:, :, 1:] = away / np.where(scale > 0, scale, 1.0)
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
def _reading(model: Model) -> Replay:
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
def _read(model: Model) -> tuple[int, ...]:
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
