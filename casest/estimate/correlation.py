"""Correlated residuals: how many independent ones they are worth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import SAMPLED

#: Fewer samples in a run say nothing about correlation: of readings, and of rest intervals, which
#: are known to have followed each other.
ENOUGH, ENOUGH_RESTS = 100, 30
#: Rows from which on neighbours that are alike count in standard deviations: a series of fewer than
#: ENOUGH is judged like a table.
ENOUGH_ALIKE = 30
#: Fewer rows without a time are a table, whose order is nobody's.
TABLE = 500


def correlation_time(problem: Problem, point: Point, tables: int | None = None) -> float:
    """Samples per independent residual: 1 + 2·Σ autocorrelations, 1 where they are not significant.

    Runs of fewer than ENOUGH samples (of poses) count as uncorrelated, and so do rows without a
    time; of such `tables` those of so many rows and more count, where asked for. The sum stops
    where pairs of neighbouring autocorrelations stop being positive (Geyer 1992).
    """
    times, weights = [], []
    for run, pieces in zip(problem.runs, _stretches(problem, point), strict=True):
        table = tables is not None and not run.spread and len(run) >= tables
        if not (is_series(run) or table):
            continue
        for k in range(len(problem.model.axes)):
            times.append(_integrated([piece[:, k] for piece in pieces]))
            weights.append(sum(float(np.sum(piece[:, k] ** 2)) for piece in pieces))
    total = sum(weights)
    return float(np.dot(times, weights) / total) if times and total > 0 else 1.0


def alike_over(problem: Problem, point: Point, correlated_over: float) -> float:
    """Samples per independent residual for a standard deviation, where series have so many: a
    table's order is nobody's, but where its neighbours are alike they are not independent."""
    if all(is_series(run) for run in problem.runs):
        return correlated_over
    return max(correlated_over, correlation_time(problem, point, tables=ENOUGH_ALIKE))


def is_series(run: Run) -> bool:
    """Are there enough samples, in their order, to see correlation between neighbours?"""
    if run.spread:
        return len(run) >= ENOUGH_RESTS
    return len(run) >= (TABLE if run.time is None else ENOUGH)


def _stretches(problem: Problem, point: Point) -> list[list[Array]]:
    """Residuals of each run: all of them, or of a long record every k-th stretch."""
    if problem.sequential or problem.residual_count <= SAMPLED:
        residuals = list(problem.residuals(point))
        if problem.weights is not None:  # outliers are alike over no time
            residuals = [r * np.sqrt(w) for r, w in zip(residuals, problem.weights, strict=True)]
        return [[residual] for residual in residuals]
    every = -(-problem.residual_count // SAMPLED)
    found: list[list[Array]] = [[] for _ in problem.runs]
    for k, (run, _, residual) in enumerate(problem.residual_blocks(point)):
        if k % every == 0:
            found[run].append(residual)
    return found


def _integrated(stretches: list[Array]) -> float:
    """1 + 2·Σρ of one component, autocovariances added over its stretches."""
    count = sum(map(len, stretches))
    mean = sum(float(r.sum()) for r in stretches) / count
    stretches = [r - mean for r in stretches]
    variance = sum(float(r @ r) for r in stretches)
    if not variance > 0:
        return 1.0
    neighbours = sum(float(r[1:] @ r[:-1]) for r in stretches) / variance
    if neighbours < 2.33 / np.sqrt(count):  # one white series in a hundred gets past
        return 1.0
    longest = max(map(len, stretches)) // 2
    rho = np.zeros(longest)
    for r in stretches:
        size = 1 << (2 * len(r) - 1).bit_length()
        power = np.abs(np.fft.rfft(r, size)) ** 2
        own = np.fft.irfft(power, size)[: min(longest, len(r))]
        rho[: len(own)] += own / variance
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    pairs = pairs[: negative[0]] if negative.size else pairs
    return float(max(2 * pairs.sum() - 1, 1.0))


def batches(run: Run, length: int) -> NDArray[np.int_]:
    """First sample of every batch: consecutive samples share one, blocks never do.

    Rests followed each other, each a block of its own.
    """
    if not is_series(run) or length <= 1:
        return np.arange(len(run))
    if run.spread:
        return np.arange(0, len(run), length)
    starts = np.flatnonzero(np.diff(run.block, prepend=run.block[:1] - 1))
    ends = np.append(starts[1:], len(run))
    parts = [np.arange(start, end, length) for start, end in zip(starts, ends, strict=True)]
    return np.concatenate(parts)
