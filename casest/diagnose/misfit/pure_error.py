"""Pure error: what repeats of one condition scatter, against what is left of their means.

Samples for which the model predicts one level, or corrects to one, are repeats; so are the samples
within a rest interval. The scatter among them is noise whatever the model; means that are further
from the model than that scatter allows are a misfit (Draper & Smith, Applied Regression Analysis,
1.5). Where a reference is read back, its noise is in both: means of residuals are means of the
reading less means of the prediction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.evidence.held_inputs import held_stretches
from casest.diagnose.evidence.linear import Index
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.slow_course import MEMORY
from casest.estimate.correlation import TABLE, is_series
from casest.leastsquares.per_sample import slope_in_sample
from casest.leastsquares.problem import Point, Problem

#: Independent samples that a rest interval's own scatter is known by, at most.
WITHIN = 10
#: Samples whose kinship is looked at together, at most.
PIECE = 64
#: Colours that are tried: correlation of neighbours, and its share of the variance.
RHO = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
SHARES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)
#: Log-likelihood of a standard deviation.
NEAR = 0.5
#: Groups of repeats below which nothing is said: what two levels show, a line goes through.
GROUPS = 3


@dataclass(frozen=True)
class PureError:
    """F: mean square of the means' misfit over that expected from repeats; sigma: of repeats.

    `between` says what the repeats are of.
    """

    F: float
    p_value: float
    sigma: float
    between: str


def pure_error(
    problem: Problem,
    point: Point,
    residuals: Sequence[Array],
    rank: int,
    *,
    wanders: bool = False,
) -> PureError | None:
    """The test, where there are rest intervals or repeats; `residuals` (N, m) per run, clipped.

    Of noise that wanders repeats are none: it is larger between them than within.
    """
    if any(run.spread for run in problem.runs):
        return _between_rests(problem, point, residuals, rank)
    return None if wanders else _between_repeats(problem, point, residuals, rank)


def _between_rests(
    problem: Problem, point: Point, residuals: Sequence[Array], rank: int
) -> PureError | None:
    """Residuals of rest intervals against their own standard errors."""
    expected = np.concatenate([v.ravel() for v in _rest_variances(problem, point)])
    dof = problem.residual_count - rank
    if dof < 1 or not expected.sum() > 0:
        return None
    squares = sum(float(np.sum(r**2)) for r in residuals)
    F = squares / dof / float(expected.mean())
    first = dof / len(expected) * _equivalent(expected)
    second = WITHIN * _equivalent(expected)
    sigma = float(np.sqrt(expected.mean()))
    return PureError(F, _tail(F / LEVELS.lacks**2, first, second), sigma, "rest intervals")


def _rest_variances(problem: Problem, point: Point) -> Iterator[Array]:
    """Variance (N, m) of each residual that the scatter within its rest interval implies."""
    declared = {s.name for s in problem.model.declared}  # what only effects read is exact
    for r, run in enumerate(problem.runs):
        G = slope_in_sample(problem.model)(problem.parameters(point, r), problem.samples[r])[0]
        variance, first = np.zeros(G.shape[:2]), 0
        for s in problem.model.signals:
            own, first = G[:, :, first : first + s.size], first + s.size
            if s.name in run.spread and s.name in declared:
                variance += np.einsum("nmi,nij,nmj->nm", own, run.covariance(s.name), own)
        yield variance


def _equivalent(variances: Array) -> float:
    """Number of equal ones that scatter as much (Satterthwaite)."""
    return float(variances.sum() ** 2 / np.sum(variances**2))


def _between_repeats(
    problem: Problem, point: Point, residuals: Sequence[Array], rank: int
) -> PureError | None:
    """Means of repeats against the scatter among them, its colour counted."""
    traced = problem.model.traced
    met = traced.predicted
    if met is None and traced.corrected:
        met = traced.quantities[traced.corrected].value
    if met is None or problem.sequential:
        return None
    levels = [v[0].reshape(len(v[0]), -1) for v in problem.evaluate(point, {"met": met})]
    series = any(is_series(run) for run in problem.runs)
    groups = [
        r[a:b]
        for run, r, level in zip(problem.runs, residuals, levels, strict=True)
        for a, b in _repeats(run, level)
    ]
    if len(groups) < GROUPS and not series and sum(map(len, residuals)) < TABLE:
        groups = _anywhere(np.concatenate(residuals), np.concatenate(levels))
    if len(groups) < GROUPS:
        return None
    return _lack_of_fit(groups, rank, series)


def _anywhere(residual: Array, level: Array) -> list[Array]:
    """Rows of a table (N, m) at which one level (N, q) is met, wherever they are.

    None if most of them agree to the last digit: those are one reading, written down again.
    """
    scale = np.maximum(np.ptp(level, axis=0), 1e-300)
    _, place = np.unique(np.round(level / scale, 9), axis=0, return_inverse=True)
    each = [residual[place.ravel() == k] for k in range(int(place.max(initial=-1)) + 1)]
    groups = [g for g in each if len(g) > 1]
    same = sum(bool(np.all(np.ptp(g, axis=0) <= 1e-9 * np.abs(residual).max())) for g in groups)
    return [] if 2 * same > len(groups) else groups


def _repeats(run: Run, level: Array) -> Iterator[tuple[int, int]]:
    """First and last sample of stretches in one block over which what is met is held."""
    held = held_stretches(level, run.block[1:] != run.block[:-1])
    edges = np.concatenate([[0], np.flatnonzero(np.diff(held)) + 1, [len(run)]])
    for a, b in pairwise(edges):
        if held[a] >= 0:
            yield int(a), int(b)


def _lack_of_fit(groups: Sequence[Array], rank: int, series: bool) -> PureError | None:
    # At a full scale readings do not scatter, whatever their noise.
    groups = [g for g in groups if len(g) < LEVELS.repeats or np.any(np.ptp(g, axis=0) > 0)]
    if len(groups) < GROUPS:
        return None
    axes, sizes = groups[0].shape[1], np.array([len(g) for g in groups], float)
    means = np.array([g.mean(axis=0) for g in groups])
    within = np.array([np.sum((g - g.mean(axis=0)) ** 2) for g in groups])
    dof = len(groups) * axes - rank
    if dof < 1 or not within.sum() > 0:
        return None
    inflation = _inflation(groups, series) if np.median(sizes) >= LEVELS.repeats else np.ones(1)
    pooled = within.sum() / ((sizes.sum() - len(groups)) * axes)
    own = within / ((sizes - 1) * axes)
    squares = float(np.sum(sizes[:, None] * means**2))
    F = squares / (float(np.sum(own * inflation)) * dof / len(groups))
    first = dof / len(groups) * _equivalent(own)
    second = float(np.mean((sizes - 1) / inflation)) * axes * _equivalent(own)
    return PureError(F, _tail(F, first, second), float(np.sqrt(pooled)), "positions")


def _inflation(groups: Sequence[Array], series: bool) -> Array:
    """Variance of each group's mean over s²/n: the largest that the scatter within them allows.

    The noise is white and AR(1) together. In a series memories no longer than a colour's are usual,
    and those count whose likelihood is within a standard deviation of the likeliest; in a table,
    whose order is nobody's, none is. Another one counts if it is likelier by as much, and fades
    within the groups: what reaches from group to group is a slow course.
    """
    sizes = np.array([len(g) for g in groups])
    size = int(np.clip(np.median(sizes), LEVELS.repeats, PIECE))
    longest = np.exp(-LEVELS.fades / max(size, LEVELS.fades * MEMORY))
    tried = [(0.0, 0.0), *((rho, share) for rho in RHO for share in SHARES if rho < longest)]
    likelihood = _likelihood(_pieces(groups, size), tried)
    usual = np.array([rho for rho, _ in tried]) < (np.exp(-1 / MEMORY) if series else 0.01)
    likely = float(likelihood[usual].max())
    allowed = usual & (likelihood >= likely - NEAR)
    allowed |= (likelihood == likelihood.max()) & (likelihood > likely + NEAR)
    found = [_of_mean(sizes, *tried[k]) for k in np.flatnonzero(allowed)]
    return np.asarray(np.max(found, axis=0))


def _pieces(groups: Sequence[Array], size: int) -> Array:
    """Consecutive samples of an axis, (K, size), those left away that stay the same."""
    cut = [
        g[: len(g) // size * size].reshape(-1, size, g.shape[1]).swapaxes(1, 2).reshape(-1, size)
        for g in groups
    ]
    rows = np.concatenate(cut)
    return np.asarray(rows[np.ptp(rows, axis=1) > 0])


def _likelihood(pieces: Array, tried: Sequence[tuple[float, float]]) -> Array:
    """Log-likelihood of pieces (K, n), each with a mean and a size of its own, in each noise."""
    n, found = pieces.shape[1], []
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    contrasts = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, 1:]]))[0][:, 1:]
    differences = contrasts.T @ pieces.T
    for rho, share in tried:
        covariance = (1 - share) * np.eye(n) + share * rho**lags
        L = np.linalg.cholesky(contrasts.T @ covariance @ contrasts)
        squares = np.sum(np.linalg.solve(L, differences) ** 2, axis=0)
        volume = 2 * len(pieces) * np.log(np.diag(L)).sum()
        found.append(-0.5 * ((n - 1) * np.log(squares).sum() + volume))
    return np.array(found)


def _of_mean(n: Index, rho: float, share: float) -> Array:
    """Variance of a mean of n over s²/n, s² being about that mean."""
    kin = rho * (n * (1 - rho) - (1 - rho**n)) / (1 - rho) ** 2
    total = 1 + 2 * share * kin / n
    return np.asarray(total * (n - 1) / (n - total))


def _tail(F: float, first: float, second: float) -> float:
    from scipy.special import fdtrc

    return float(fdtrc(first, second, F))
