"""Sums over all samples of a problem, beyond those that solving needs.

Everything here runs through the record piece by piece: memory does not grow with its length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.engine import Columns
from casest.leastsquares.per_sample import laplacian, slope_in_sample
from casest.leastsquares.problem import BLOCK, Block, Point, Problem
from casest.leastsquares.stated import settles, shifts_of_curvature

#: Residuals that are looked at where a median or a correlation is wanted of a longer record.
SAMPLED = 1_000_000
#: The same where an order of magnitude is wanted.
FEW = 600


def squares_of_gradients(problem: Problem, point: Point, bread: Array) -> tuple[Array, Array]:
    """Σ(w r ∂r)(w r ∂r)ᵀ over the samples, (n, n): the middle of the sandwich covariance.

    Every residual is first divided by what the fit leaves of it, 1 − h; `bread` = (JᵀWJ)⁻¹. Second,
    how many residuals say what each unknown is, (n,): (Σl²)²/Σl⁴ of their pulls l on it. As many
    as there are where all pull alike, one where one tells it alone.
    """
    middle = np.zeros((problem.unknowns, problem.unknowns))
    second, fourth = np.zeros((2, problem.unknowns))
    for block in problem.blocks(point):
        J, weights = block.jacobian, block.weights
        pulls = J.reshape(-1, J.shape[2]) @ bread[block.x]
        moved = pulls[:, block.x].reshape(J.shape)
        residual = _without_leverage(block, moved)
        if weights is not None:
            residual = residual * weights
        scores = np.einsum("nm,nmk->nk", residual, J)
        middle[np.ix_(block.x, block.x)] += scores.T @ scores
        np.square(pulls, out=pulls)
        weight = (
            np.ones(len(pulls))
            if weights is None
            else np.broadcast_to(weights, residual.shape).ravel()
        )
        second += weight @ pulls
        np.square(pulls, out=pulls)
        fourth += weight**2 @ pulls
    return middle, np.asarray(second**2 / np.maximum(fourth, 1e-300))


def squares_of_batches(
    problem: Problem, point: Point, batches: Sequence[NDArray[np.int_]]
) -> Array:
    """Σ_batch (Σ w r ∂r)(Σ w r ∂r)ᵀ, (n, n), where the samples of one batch may be correlated.

    `batches` holds the first sample of every batch of each run.
    """
    sums = [np.zeros((len(b), problem.unknowns)) for b in batches]
    for block in problem.blocks(point):
        residual = block.residual if block.weights is None else block.residual * block.weights
        scores = np.einsum("nm,nmk->nk", residual, block.jacobian)
        own = np.arange(block.span.start, block.span.stop)
        number = np.searchsorted(batches[block.run], own, side="right") - 1
        first = np.flatnonzero(np.diff(number, prepend=-1))
        sums[block.run][np.ix_(number[first], block.x)] += np.add.reduceat(scores, first)
    return np.asarray(sum(each.T @ each for each in sums))


def _without_leverage(block: Block, moved: Array) -> Array:
    """(I − H)⁻¹r sample by sample: what the residual would be had the fit not seen it.

    `moved` (N, m, k): the Jacobian times (JᵀWJ)⁻¹.
    """
    J, root, residual = block.jacobian, block.weights, block.residual
    leverage = np.empty((*residual.shape, residual.shape[1]))
    for i in range(residual.shape[1]):
        for j in range(i + 1):
            own = np.einsum("nk,nk->n", moved[:, i], J[:, j])
            leverage[:, i, j] = leverage[:, j, i] = own
    if root is not None:
        leverage *= root[:, None, :]
    most = float(np.nanmax(np.einsum("nii->n", leverage), initial=0.0))
    if most < 0.01:
        # The geometric series Σ HᵏR: what is left out is below 1e-12.
        term = residual
        for _ in range(_terms(most)):
            term = np.einsum("nij,nj->ni", leverage, term)
            residual = residual + term
        return np.asarray(residual)
    left = np.eye(residual.shape[1]) - np.where(np.isfinite(leverage), leverage, 0.0)
    # A residual that the fit follows entirely says nothing: keep the inverse finite.
    values, vectors = np.linalg.eigh(0.5 * (left + left.transpose(0, 2, 1)))
    inverse = (vectors / np.maximum(values, 1e-3)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.asarray(np.einsum("nmk,nk->nm", inverse, residual))


def _terms(most: float) -> int:
    """Powers of a leverage until they are below 1e-12 of it, five at most."""
    return next((k for k in range(5) if most ** (k + 1) < 1e-12), 5)


def rounding(problem: Problem, point: Point) -> float:
    """Rounding error of one residual: machine precision of all that was added up in it.

    Of a long record every k-th sample is looked at: an order of magnitude is wanted.
    """
    problem = _sampled(problem, FEW)
    squares, count = 0.0, 0
    for block in problem.blocks(point):
        parameters = problem.parameters(point, block.run)
        samples = problem.samples[block.run][block.span]
        slopes = slope_in_sample(problem.model)(parameters, samples)[0]
        terms = np.sum(np.abs(slopes * samples.dense[:, None, :]), axis=2)
        terms += np.abs(block.jacobian) @ np.abs(point.x[block.x])
        squares, count = squares + float(np.sum(terms**2)), count + terms.size
    return float(4 * np.finfo(float).eps * np.sqrt(squares / max(count, 1)) + 1e-300)


def _implicit_in_noise(problem: Problem) -> bool:
    """Is the residual bent in the noise of the readings, and is that noise not stated?"""
    model = problem.model
    return model.implicit and model.noise is None and not model.resting


def second_order(problem: Problem, point: Point, sigma: float) -> float:
    """Root mean square over σ of ½Σσ_s²·∂²r/∂s²: what an implicit residual neglects of the noise.

    Zero for explicit models, whose residual is linear in the noise of the reading, unless noise of
    their inputs was stated; taken for none where rests are compared, whose means have little.
    """
    if settles(problem.model):
        shifts = np.concatenate([shift.ravel() for shift in shifts_of_curvature(problem, point)])
        return float(np.sqrt(np.mean(shifts**2)) / sigma)
    if not _implicit_in_noise(problem):
        return 0.0
    squares, count, noise = 0.0, 0, signal_noise(problem, point, sigma)
    for r, samples in enumerate(problem.samples):
        parameters = problem.parameters(point, r)
        for own in _spans(samples):
            shift = 0.5 * laplacian(problem.model)(parameters, samples[own])[0] @ noise**2
            squares, count = squares + float(np.sum(shift**2)), count + shift.size
    return float(np.sqrt(squares / max(count, 1)) / sigma)


def second_order_bias(problem: Problem, point: Point, sigma: float, bread: Array) -> Array:
    """Shift of the unknowns (n,) by what an implicit residual neglects of the noise.

    Noise of σ_s in every component of signal s shifts each residual by ½Σσ_s²·∂²r/∂s² on average.
    """
    slope = np.zeros(problem.unknowns)
    if settles(problem.model) and not problem.model.implicit:
        shifts = tuple(shifts_of_curvature(problem, point))
        if not any(shift.any() for shift in shifts):
            return slope
        for block in problem.blocks(point):
            own = shifts[block.run][block.span]
            np.add.at(slope, block.x, np.einsum("nm,nmk->k", own, block.jacobian))
        return -np.asarray(bread @ slope)
    if not _implicit_in_noise(problem):
        return slope
    noise = signal_noise(problem, point, sigma)
    for block in problem.blocks(point):
        parameters = problem.parameters(point, block.run)
        samples = problem.samples[block.run][block.span]
        shift = 0.5 * laplacian(problem.model)(parameters, samples)[0] @ noise**2
        np.add.at(slope, block.x, np.einsum("nm,nmk->k", shift, block.jacobian))
    return np.asarray(-bread @ slope)


def _spans(samples: Columns) -> Iterator[slice]:
    """Pieces of a record that are evaluated at once."""
    for first in range(0, len(samples), BLOCK):
        yield slice(first, min(first + BLOCK, len(samples)))


def signal_noise(problem: Problem, point: Point, sigma: float) -> Array:
    """Noise of each signal that makes up the residual's σ, in the signal's own unit, (signals,).

    At most σ over the slope of the residual that sees the signal best. A signal whose spread is
    zero in all runs, or that a model takes as exact (a time, an attitude), has the same formula:
    the residual tells no more. What only effects read (a temperature, the time) is exact.
    """
    ends = np.cumsum([0, *(s.size for s in problem.model.signals)])
    squares = np.zeros((len(problem.model.axes), len(ends) - 1))
    for r, samples in enumerate(problem.samples):
        for span in _spans(samples):
            G = slope_in_sample(problem.model)(problem.parameters(point, r), samples[span])[0]
            squares += np.add.reduceat(np.sum(G**2, axis=0), ends[:-1], axis=1)
    count = sum(len(run) for run in problem.runs)
    slope = np.sqrt(squares.max(axis=0) / max(count, 1))
    own = [s.name in {d.name for d in problem.model.declared} for s in problem.model.signals]
    return np.asarray(sigma / np.where((slope > 0) & own, slope, np.inf))


def repeat_noise(problem: Problem, point: Point) -> float | None:
    """Root mean square of the residual's noise that the scatter within rest intervals implies.

    None where no signal carries a spread of its own, and where rests are compared. What only
    effects read is exact.
    """
    if not any(run.spread for run in problem.runs) or problem.model.resting:
        return None
    squares, count = 0.0, 0
    declared = {s.name for s in problem.model.declared}
    for r, run in enumerate(problem.runs):
        G = slope_in_sample(problem.model)(problem.parameters(point, r), problem.samples[r])[0]
        first = 0
        for s in problem.model.signals:
            own, first = G[:, :, first : first + s.size], first + s.size
            if s.name in run.spread and s.name in declared:
                squares += float(np.einsum("nmi,nij,nmj->", own, run.covariance(s.name), own))
        count += G.shape[0] * G.shape[1]
    return float(np.sqrt(squares / count))


def some_residuals(problem: Problem, point: Point) -> tuple[Array, ...]:
    """Residuals of each run, (N, m); of a long record those of every k-th sample."""
    return _sampled(problem, SAMPLED).residuals(point)


def _sampled(problem: Problem, limit: int) -> Problem:
    every = -(-problem.residual_count // limit)
    return problem if every <= 1 or problem.sequential else problem.thinned(every)
