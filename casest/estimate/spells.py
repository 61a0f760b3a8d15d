"""Spells: parts of a record, far longer than the noise remembers, that disagree.

A lag that depends on the load, a gain that changes with the day: within each spell the noise is as
it seems, and the spells contradict each other by more than that noise allows. What a residual's
correlation does not show, the gradients do that each spell adds to an unknown: were all as the
model says, they scatter as its variance says (batch means; Liang & Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.estimate.correlation import batches, is_series
from casest.leastsquares.problem import Point, Problem

#: Spells that a record is cut into, and the rows in each at least.
SPELLS, ROWS = (10, 20, 40), 10
#: Chance, over all cuts and unknowns, that spells scatter so much more than a variance says.
CHANCE = 0.01
#: Spells whose gradients count as so many equal ones at least: of fewer nobody knows a scatter.
FEWEST = 3.0
#: Correlation times of the noise in a spell from which on what spells scatter is all that it does.
MANY_TIMES = 10
#: Unknowns up to which all that each spell says is kept at once.
MOST = 200


def by_spells(problem: Problem, point: Point, bread: Array) -> list[tuple[Array, Array]]:
    """Variances (n,) by the scatter of spells, and their degrees of freedom (n,), of each cut.

    None where rows are no series, or too few. Unbiased for noise that is alike everywhere; the
    degrees of freedom are those of spells that say unequal amounts (Satterthwaite 1946).
    """
    rows = sum(map(len, problem.runs))
    series = all(is_series(run) and not run.spread for run in problem.runs)
    if not series or problem.unknowns > MOST:
        return []
    cuts = [count for count in SPELLS if rows >= count * max(ROWS, problem.unknowns)]
    return [_scatter(problem, point, bread, rows // count) for count in cuts]


def _scatter(problem: Problem, point: Point, bread: Array, length: int) -> tuple[Array, Array]:
    firsts = [batches(run, length) for run in problem.runs]
    scores, normal = _of_batches(problem, point, firsts)
    moved = scores @ bread
    own = np.einsum("ik,gij,jk->gk", bread, normal, bread)
    inner = np.einsum("gij,jk->gik", normal, bread)
    taken = np.einsum("gik,ij,gjk->gk", inner, bread, inner)
    left = np.maximum(own - taken, 0.0)  # what a spell's own weight in the fit leaves of it
    total = left.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(total > 0, np.diag(bread) / total, 0.0)
        freedom = np.where(total > 0, total**2 / np.sum(left**2, axis=0), 0.0)
    return np.sum(moved**2, axis=0) * size, np.minimum(freedom, len(scores) - 1)


def _of_batches(
    problem: Problem, point: Point, firsts: Sequence[NDArray[np.int_]]
) -> tuple[Array, Array]:
    """Gradients (G, n) and normal matrices (G, n, n) of all batches, one run after the other."""
    before = np.cumsum([0, *map(len, firsts)])
    count, n = int(before[-1]), problem.unknowns
    scores, normal = np.zeros((count, n)), np.zeros((count, n, n))
    for block in problem.blocks(point):
        weights = np.ones((1, 1)) if block.weights is None else block.weights
        x = np.arange(n)[block.x]
        weighted = block.jacobian * np.broadcast_to(weights, block.residual.shape)[:, :, None]
        gradient = np.einsum("nm,nmk->nk", block.residual, weighted)
        place = np.arange(block.span.start, block.span.stop)
        number = np.searchsorted(firsts[block.run], place, side="right") - 1
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        for a, b in zip(starts, [*starts[1:], len(number)], strict=True):
            g = before[block.run] + number[a]
            scores[g, x] += gradient[a:b].sum(axis=0)
            own = weighted[a:b].reshape(-1, len(x))
            normal[g][np.ix_(x, x)] += own.T @ block.jacobian[a:b].reshape(own.shape)
    return scores, normal


def contradicted(
    variance: Array, several: Sequence[tuple[Array, Array]]
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Unknowns (n,) whose spells scatter by more than chance beyond their variance, and by the cut
    that says so most clearly the variance (n,) and its degrees of freedom (n,)."""
    from scipy.special import chdtri

    more, found, free = (
        np.zeros(len(variance), bool),
        variance.copy(),
        np.full(len(variance), np.inf),
    )
    for own, freedom in several:
        freedom = np.maximum(freedom, 1e-9)
        most = chdtri(freedom, CHANCE / len(several) / len(variance)) / freedom * variance
        better = (freedom >= FEWEST) & (own > most) & (own > found)
        found, free = np.where(better, own, found), np.where(better, freedom, free)
        more |= better
    return more, found, free


def at_most(
    variance: Array, several: Sequence[tuple[Array, Array]], length: int, correlated_over: float
) -> Array:
    """Variances (n,) no larger than the longest spells, of so many rows, could say: a spectrum that
    is drawn on below all frequencies that a fit leaves may be anything there. As they are where a
    spell is not many correlation times long."""
    from scipy.special import chdtri

    if not several or length < MANY_TIMES * correlated_over:
        return variance
    own, freedom = several[0]
    least = chdtri(np.maximum(freedom, FEWEST), 1 - CHANCE) / np.maximum(freedom, FEWEST)
    return np.where((freedom >= FEWEST) & (own > 0), np.minimum(variance, own / least), variance)
