"""What rows with nearly the same inputs differ by, for many sensors side by side.

The figures of `leastsquares.neighbours`, whose predictors stand here as blocks of one matrix.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.engine import Replay
from casest.fleet.sums import Sensors, SideBySide
from casest.leastsquares.neighbours import (
    FEWEST,
    Scatter,
    by_spread,
    freedom_of,
    predictors,
    read_by,
    reading_of,
    some_of,
)


def scatters(model: Model, x: Array, cost: Array, sensors: Sensors) -> list[Scatter | None]:
    """The scatter of every sensor at its own x (n, W); None where its rows cannot show it."""
    found: list[Scatter | None] = [None] * len(cost)
    if model.traced.predicted is None:
        return found
    total = sensors.samples.shape[1]
    counts = np.full(len(cost), total)
    if sensors.mask is not None:
        counts = sensors.mask.sum(axis=0).astype(int)
    for count in np.unique(counts):
        if count < FEWEST or count * len(model.axes) <= len(x):
            continue
        k = np.flatnonzero(counts == count)
        samples = np.ascontiguousarray(sensors.samples[:, :count, k])
        for i, own in zip(k, _of_equal_length(model, x[:, k], cost[k], samples), strict=True):
            found[i] = own
    return found


def _of_equal_length(model: Model, x: Array, cost: Array, samples: Array) -> list[Scatter | None]:
    """Those of W sensors with samples (k, N, W), all of which count."""
    freedom = float(samples.shape[1] * len(model.axes) - len(x))
    samples = samples[:, some_of(samples.shape[1])]
    reading, residual, plain = _outputs(model, x, samples)
    rest = reading - _fitted(plain, reading)
    spread = np.mean(rest**2, axis=(1, 2))
    read, varies = by_spread(samples[list(read_by(model))].transpose(2, 1, 0))
    found: list[Scatter | None] = [None] * len(cost)
    seen = np.isfinite(residual).all(axis=(1, 2))
    for pattern in np.unique(varies[seen], axis=0):
        k = np.flatnonzero(seen & (varies == pattern).all(axis=1))
        inputs = read[k][:, :, pattern] if pattern.any() else np.zeros((*read[k].shape[:2], 1))
        within, left, dof = _differences(inputs, reading[k], residual[k])
        for j, i in enumerate(k):
            own = float(2 * cost[i] / freedom)
            figures = float(within[j]), own, float(spread[i]), float(left[j])
            found[i] = Scatter(*figures, (freedom, float(dof[j])))
    return found


def _differences(inputs: Array, reading: Array, residual: Array) -> tuple[Array, Array, Array]:
    """Variances that neighbours show of readings and of residuals, and their freedom, (S,)."""
    records, _, axes = reading.shape
    C = predictors(inputs)

    def variance(values: Array) -> Array:
        apart = (C @ values.reshape(-1, axes)).reshape(records, -1)
        return np.asarray(np.mean(apart**2, axis=1))

    return variance(reading), variance(residual), freedom_of(C, records) * axes


def _fitted(plain: Array, reading: Array) -> Array:
    """What a constant and the columns that no unknown bends explain of the readings, (W, N, m)."""
    if not plain.any():
        return np.asarray(reading.mean(axis=1, keepdims=True))
    found = np.zeros_like(reading)
    for m in range(reading.shape[2]):
        columns = np.concatenate([np.ones((*plain.shape[:2], 1)), plain[:, :, m]], axis=2)
        columns = np.where(np.isfinite(columns).all(axis=(1, 2), keepdims=True), columns, 0.0)
        columns /= np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300)
        U, size, _ = np.linalg.svd(columns, full_matrices=False)
        least = np.finfo(float).eps * max(columns.shape[1:]) * size[:, :1]
        U = np.where((size > least)[:, None, :], U, 0.0)
        found[:, :, m] = np.einsum("wni,wki,wk->wn", U, U, reading[:, :, m], optimize=True)
    return found


@lru_cache(maxsize=64)
def _beside(replay: Replay) -> SideBySide:
    return SideBySide(replay, [e for o in range(3) for e in replay.entries(o)])


def _outputs(model: Model, x: Array, samples: Array) -> tuple[Array, Array, Array]:
    """Readings and residuals (W, N, m), and the plain columns of J, (W, N, m, q)."""
    replay = reading_of(model)
    found = [np.zeros((*shape, *samples.shape[1:])) for shape in replay.shapes]
    for span, s, values in _beside(replay).chunks(x, Sensors(samples, None)):
        first = 0
        for own, (row, column) in zip(found, replay.sparsity, strict=True):
            own[row, column, span, s] = values[first : first + len(row)]
            first += len(row)
    reading, residual, plain = (own.transpose(3, 2, 0, 1) for own in found)
    return reading[..., 0], residual[..., 0], plain
