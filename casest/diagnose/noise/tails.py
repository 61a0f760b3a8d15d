"""Tails of the noise: heavy everywhere (Student's t), or a few samples that are no noise at all.

Both have large residuals. What tells them apart is the middle: outliers leave the rest normal, with
a gap between; heavy tails thin out. So two models are fitted, t_ν(σ) and the contaminated normal
(1 − ε) N(0, σ²) + ε N(0, τ²σ²) (Tukey 1960), and their likelihoods compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.leastsquares.weights import robust_scale

#: Outliers are few, and so many times further out than the noise.
FEW, FAR = 0.05, 5.0
#: Residuals of a batch from which on it has a scale of its own.
OWN_SCALE = 8
#: Outliers within the record's length over twice this are near to each other.
NEAR = 20
#: Degrees of freedom that are tried, evenly in 1/ν, and above which tails count as normal.
FREEDOMS, NORMAL = 1 / np.linspace(1 / 200, 1 / 1.5, 28), 50.0


@dataclass(frozen=True)
class Tails:
    """Log-likelihoods of three models of the tails, with what they found.

    `freedom` is ν of Student's t (inf where tails are no heavier than normal), `far` (n,) the
    probability of each residual to be an outlier under the contaminated normal.
    """

    normal: float
    student: float
    contaminated: float
    freedom: float
    far: Array

    @property
    def outliers(self) -> bool:
        """Do outliers explain the tails better than any heavy-tailed noise?"""
        return self.contaminated - max(self.student, self.normal) > LEVELS.outliers


def tails(z: Array) -> Tails:
    """Fit the three models to residuals z (n,) about zero."""
    z = z / max(robust_scale([z]), 1e-300)
    normal = -0.5 * len(z) * (np.log(2 * np.pi * np.mean(z**2)) + 1)
    student, freedom = _student(z**2)
    contaminated, far = _contaminated(z**2, normal)
    # χ² with one degree of freedom for ν, at 1 in 1000.
    heavy = student - normal > 5.4 and freedom < NORMAL
    return Tails(normal, student, contaminated, freedom if heavy else np.inf, far)


def _student(q: Array) -> tuple[float, float]:
    """Largest log-likelihood of Student's t over σ and ν, and ν; q are squares."""
    from scipy.special import gammaln

    n, variance, found = len(q), 1.0, []
    for nu in FREEDOMS:
        for _ in range(6):  # EM for the scale, from that of the last ν
            variance = float(((nu + 1) / (nu + q / variance) * q).mean())
        constant = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi * variance)
        found.append(n * constant - (nu + 1) / 2 * float(np.log1p(q / (nu * variance)).sum()))
    best = int(np.argmax(found))
    return float(found[best]), _between(1 / FREEDOMS, np.array(found), best)


def _between(x: Array, y: Array, best: int) -> float:
    """1/x at the maximum of a parabola through the best point and its neighbours."""
    if not 0 < best < len(x) - 1:
        return float(1 / x[best])
    a, b, c = y[best - 1 : best + 2]
    shift = 0.5 * (a - c) / (a - 2 * b + c)
    return float(1 / (x[best] + shift * (x[1] - x[0])))


def _contaminated(q: Array, normal: float) -> tuple[float, Array]:
    """Largest log-likelihood of the contaminated normal; probabilities of outliers (EM)."""
    variance, far = 1.0, (q > (FAR + 1) ** 2).astype(float)
    if not far.any():
        return normal, far
    for _ in range(60):
        share = min(max(float(far.mean()), 1e-9), FEW)
        inside = 1 - far
        variance = float((inside * q).sum() / max(inside.sum(), 1e-300))
        wide = max(float((far * q).sum() / max(far.sum(), 1e-300)), FAR**2 * variance)
        near = np.log1p(-share) - 0.5 * np.log(variance) - q / (2 * variance)
        out = np.log(share) - 0.5 * np.log(wide) - q / (2 * wide)
        far = 1 / (1 + np.exp(np.minimum(np.maximum(near - out, -700), 700)))
    likelihood = float(np.sum(np.logaddexp(near, out))) - 0.5 * len(q) * np.log(2 * np.pi)
    return likelihood, far


def scales(residuals: Sequence[Array]) -> Array:
    """Standard deviation (m,) of each axis, from the median of what residuals (N, m) are.

    Where most are one value the reading stands still on one level: it has the noise of rounding.
    """
    from casest.data.stillness import resolution

    every = np.concatenate(residuals)
    found = np.array([robust_scale([column]) for column in every.T])
    for k, column in enumerate(every.T):
        away = np.abs(column - np.median(column))
        if np.mean(away <= 1e-9 * away.max()) > 0.5:
            found[k] = max(found[k], resolution(column) / np.sqrt(12))
    return found


def even_scale(
    residuals: Sequence[Array], batches: Sequence[NDArray[np.int_]], unequal: bool
) -> tuple[Array, ...]:
    """Residuals of each run in units of their axis' scale, or of their batch's where `unequal`.

    A position that shakes has large residuals and no outliers.
    """
    scale = scales(residuals)
    even = [r / scale for r in residuals]
    if not unequal:
        return tuple(even)
    for r, first in zip(even, batches, strict=True):
        for start, end in zip(first, np.append(first[1:], len(r)), strict=True):
            if r[start:end].size >= OWN_SCALE:
                r[start:end] /= robust_scale([r[start:end]])
    return tuple(even)


def outlier_share(
    residuals: Sequence[Array],
    batches: Sequence[NDArray[np.int_]],
    levels: Sequence[Array] | None = None,
) -> float:
    """Share of samples that are outliers; 0 where anything else explains the tails as well.

    residuals (N, m) per run; `batches` the first sample of each batch; `levels` (N, m) what the
    model predicts. No outliers are samples that are far off where heavy tails expect them, where
    their batch scatters, where others are, or where the reading is large: those are a misfit.
    """
    found = _found(residuals, batches, levels)
    return 0.0 if found is None else float(np.mean(np.concatenate(found[1])))


def outliers_p_value(
    residuals: Sequence[Array],
    batches: Sequence[NDArray[np.int_]],
    levels: Sequence[Array] | None = None,
) -> float | None:
    """Chance of as much evidence for outliers in heavy-tailed noise, at most; None without any.

    exp(−x) for a log-likelihood of x over Student's t (tests/test_adequacy.py).
    """
    found = _found(residuals, batches, levels)
    if found is None:
        return None
    best = found[0]
    return float(np.exp(max(best.student, best.normal) - best.contaminated))


def _found(
    residuals: Sequence[Array],
    batches: Sequence[NDArray[np.int_]],
    levels: Sequence[Array] | None,
) -> tuple[Tails, list[NDArray[np.bool_]]] | None:
    """The tails and which samples (N,) of each run are outliers; None where there are none."""
    own = even_scale(residuals, batches, unequal=True)
    if not tails(np.concatenate([z.ravel() for z in own])).outliers:
        return None
    even = even_scale(residuals, batches, unequal=False)
    found = tails(np.concatenate([z.ravel() for z in even]))
    if not found.outliers:
        return None
    ends = np.cumsum([z.size for z in even])[:-1]
    far: list[NDArray[np.bool_]] = [
        np.asarray(f.reshape(z.shape) > 0.5)
        for f, z in zip(np.split(found.far, ends), even, strict=True)
    ]
    if _in_rows(far) or (levels is not None and _at_level(far, levels)):
        return None
    return found, [np.asarray(f.any(axis=1)) for f in far]


def _in_rows(far: Sequence[NDArray[np.bool_]]) -> bool:
    """Are they nearer to each other than accidents are? Pairs within a fortieth of the record."""
    near, expected = 0, 0.0
    for f in far:
        where = np.flatnonzero(f.any(axis=1))
        reach = max(len(f) // (2 * NEAR), 2)
        near += int(np.sum(np.searchsorted(where, where + reach, "right") - np.arange(len(where))))
        near -= len(where)
        expected += len(where) * (len(where) - 1) / 2 * min(2 * reach / max(len(f), 1), 1.0)
    return bool(near > 1 + expected + 3 * np.sqrt(expected))


def _at_level(far: Sequence[NDArray[np.bool_]], levels: Sequence[Array]) -> bool:
    """Do they come where the prediction is large or small? Rank sum, four standard deviations."""
    here = np.concatenate([f.ravel() for f in far])
    level = np.abs(np.concatenate([x.ravel() for x in levels]))
    rank = np.argsort(np.argsort(level)) / max(len(level) - 1, 1)
    count = int(here.sum())
    return bool(count >= 5 and abs(rank[here].mean() - 0.5) > 4 * np.sqrt(1 / (12 * count)))
