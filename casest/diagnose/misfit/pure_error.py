"""Pure error: what repeats of one condition scatter, against what is left of their means.

Samples for which the model predicts one level are repeats; so are the samples within a rest
interval. The scatter among them is noise whatever the model; means that are further from the model
than that scatter allows are a misfit (Draper & Smith, Applied Regression Analysis, 1.5).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.evidence.held_inputs import held_stretches
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.noise_model import likelihood_of_walk, likelihood_of_white, power
from casest.leastsquares.per_sample import slope_in_sample
from casest.leastsquares.problem import Point, Problem

#: Independent samples that a rest interval's own scatter is known by, at most.
WITHIN = 10
#: Neighbours that are looked at for correlation among repeats, at most.
LAGS = 100
#: Groups of repeats below which nothing is said.
GROUPS = 5


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
    problem: Problem, point: Point, residuals: Sequence[Array], rank: int
) -> PureError | None:
    """The test, where there are rest intervals or repeats; `residuals` (N, m) per run, clipped."""
    if any(run.spread for run in problem.runs):
        return _between_rests(problem, point, residuals, rank)
    return _between_repeats(problem, point, residuals, rank)


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
    """Means of repeats against the scatter among them, neighbours' correlation counted."""
    predicted = problem.model.traced.predicted
    if predicted is None or problem.sequential:
        return None
    levels = [v[0][:, :, 0] for v in problem.evaluate(point, {"p": predicted})]
    groups = [
        r[a:b]
        for run, r, level in zip(problem.runs, residuals, levels, strict=True)
        for a, b in _repeats(run, level)
    ]
    if len(groups) < GROUPS:
        return None
    return _lack_of_fit(groups, rank)


def _repeats(run: Run, level: Array) -> Iterator[tuple[int, int]]:
    """First and last sample of stretches in one block over which the prediction is held."""
    held = held_stretches(level, run.block[1:] != run.block[:-1])
    edges = np.concatenate([[0], np.flatnonzero(np.diff(held)) + 1, [len(run)]])
    for a, b in pairwise(edges):
        if held[a] >= 0:
            yield int(a), int(b)


def _lack_of_fit(groups: Sequence[Array], rank: int) -> PureError | None:
    axes, sizes = groups[0].shape[1], np.array([len(g) for g in groups], float)
    means = np.array([g.mean(axis=0) for g in groups])
    within = np.array([np.sum((g - g.mean(axis=0)) ** 2) for g in groups])
    dof = len(groups) * axes - rank
    if dof < GROUPS or not within.sum() > 0:
        return None
    inflation = _correlation(groups)
    pooled = within.sum() / ((sizes.sum() - len(groups)) * axes)
    own = within / ((sizes - 1) * axes)
    squares = float(np.sum(sizes[:, None] * means**2))
    # A slow wander moves neighbours alike: their differences show what is left of it.
    steps = np.diff(np.sqrt(sizes)[:, None] * means, axis=0)
    alternating = float(np.sum(steps**2)) / 2 * len(groups) / (len(groups) - 1)
    expected = float(own.sum()) * axes * dof / (len(groups) * axes) * inflation
    F = min(squares, alternating) / expected
    if F > 1 and _walks(np.sqrt(sizes)[:, None] * means, inflation * pooled):
        return None
    first = dof / len(groups) * _equivalent(own)
    second = float(np.mean(sizes - 1)) * axes * _equivalent(own) / inflation
    return PureError(F, _tail(F, first, second), float(np.sqrt(pooled)), "positions")


def _walks(means: Array, variance: float) -> bool:
    """Do means in their order look like a random walk above their noise, not like scatter?"""
    squares = power(means)
    walk = likelihood_of_walk(squares, np.full(means.shape[1], variance))
    return walk > likelihood_of_white(squares)


def _correlation(groups: Sequence[Array]) -> float:
    """Variance of a mean of repeats over s²/n: 1 + 2·Σρ, at least as for AR(1) noise."""
    centred = [g - g.mean(axis=0) for g in groups]
    longest = max(min(map(len, groups)) - 1, 1)
    total = 0.0
    for lag in range(1, min(longest, LAGS)):
        rho, pairs = _at_lag(centred, lag)
        if rho < 2.33 / np.sqrt(pairs):
            break
        total += rho
    decaying = _decaying(*_at_lag(centred, 1), int(np.median([len(g) for g in groups])))
    return max(1 + 2 * total, decaying)


def _at_lag(centred: Sequence[Array], lag: int) -> tuple[float, int]:
    """Correlation at a lag within the groups, and the pairs that it comes from."""
    pairs = sum(c[lag:].size for c in centred)
    products = sum(float(np.sum(c[lag:] * c[:-lag])) for c in centred)
    variance = sum(float(np.sum(c**2)) for c in centred) / sum(c.size for c in centred)
    return products / max(pairs, 1) / max(variance, 1e-300), max(pairs, 1)


def _decaying(rho: float, pairs: int, n: int) -> float:
    """The same of AR(1) noise whose neighbours correlate so in groups of n about their mean.

    Taking the mean off lowers both the correlation and s²: both are computed, not neglected.
    """
    n = min(n, LAGS)
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    centre = np.eye(n) - 1 / n
    factor = 1.0
    for true in np.arange(0.0, 0.96, 0.05):
        covariance = true**lags
        seen = centre @ covariance @ centre
        expected = np.diag(seen, 1).mean() / np.diag(seen).mean()
        if true == 0.0 and rho < expected + 2.33 / np.sqrt(pairs):
            return 1.0
        factor = float(covariance.sum() / n / (np.trace(seen) / (n - 1)))
        if expected >= rho:
            break
    return factor


def _tail(F: float, first: float, second: float) -> float:
    from scipy.special import fdtrc

    return float(fdtrc(first, second, F))
