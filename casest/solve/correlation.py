"""Correlated residuals: how many independent ones they are worth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.stack import Point, Problem

#: Fewer samples in a run say nothing about correlation: of readings, and of rest intervals, which
#: are known to have followed each other.
ENOUGH, ENOUGH_RESTS = 100, 30


def correlation_time(problem: Problem, point: Point) -> float:
    """Samples per independent residual: 1 + 2·Σ autocorrelations, 1 where they are not significant.

    Runs of fewer than ENOUGH samples (a table of poses) count as uncorrelated. The sum stops
    where pairs of neighbouring autocorrelations stop being positive (Geyer 1992).
    """
    times, weights = [], []
    for run, residual in zip(problem.runs, problem.residuals(point), strict=True):
        if not is_series(run):
            continue
        for k in range(residual.shape[1]):
            times.append(_integrated(residual[:, k]))
            weights.append(float(np.sum(residual[:, k] ** 2)))
    total = sum(weights)
    return float(np.dot(times, weights) / total) if times and total > 0 else 1.0


def is_series(run: Run) -> bool:
    """Are there enough samples, in their order, to see correlation between neighbours?"""
    return len(run) >= (ENOUGH_RESTS if run.spread else ENOUGH)


def _integrated(r: Array) -> float:
    count = len(r)
    r = r - r.mean()
    size = 1 << (2 * count - 1).bit_length()
    power = np.abs(np.fft.rfft(r, size)) ** 2
    autocovariance = np.fft.irfft(power, size)[: count // 2]
    if not autocovariance[0] > 0:
        return 1.0
    rho = autocovariance / autocovariance[0]
    if rho[1] < 2.33 / np.sqrt(count):  # one white series in a hundred gets past
        return 1.0
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    pairs = pairs[: negative[0]] if negative.size else pairs
    return float(max(2 * pairs.sum() - 1, 1.0))


def batches(run: Run, length: int) -> NDArray[np.int_]:
    """Batch number of every sample: consecutive ones share a batch, blocks never do."""
    if not is_series(run) or length <= 1:
        return np.arange(len(run))
    number = np.zeros(len(run), dtype=int)
    last = -1
    for block in np.unique(run.block):
        own = np.flatnonzero(run.block == block)
        number[own] = last + 1 + np.arange(len(own)) // length
        last = int(number[own[-1]])
    return number
