"""A quick test of each sensor's residual: is the largest one larger than noise makes it?

The largest of M externally studentised residuals tᵢ = rᵢ/(σ₍ᵢ₎·√(1 − hᵢ)), hᵢ the leverage, with
Bonferroni's bound on its chance (Cook & Weisberg, Residuals and Influence in Regression, 1982,
2.2.2): one pose that was knocked, a glitch, a level that was misread. Leverages are computed of
the two samples with the largest residuals alone: the chance that is told is never too small.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, roots_jacobi, stdtr

from casest.declaration.shapes import Array
from casest.fleet.local import Local
from casest.fleet.sums import Sensors, Squares

#: Share of a residual that must be left beside its leverage: below, the fit follows the reading.
LEFT = 1e-6
#: Nodes of the quadrature for Student's tails, and degrees of freedom up to which it is used: where
#: a largest residual is less probable than not, it is right to 2e-13 of the tail.
NODES, MOST = 16, 100


def outlying(
    squares: Squares, sensors: Sensors, here: Local, count: Array, residuals: Array
) -> Array:
    """Probability that a sound sensor's largest residual is as large, (W,); 1 at most.

    `residuals` (m, N, W) of the fits, of which `count` (W,) of each sensor count. NaN where it has
    no two residuals more than unknowns.
    """
    freedom = count - len(here.scale)
    own = np.einsum("mns,mns->ns", residuals, residuals)
    squared = own.sum(axis=0)
    width = len(squared)
    flat = _largest(own) * width + np.arange(width)
    few = np.take(sensors.samples.reshape(len(sensors.samples), -1), flat, axis=1)
    largest = squares.studentised(here.fits.x, Sensors(few, None), here.factor, here.scale)
    # Of a residual r, r²/(1 − h) over Σr² is 1 − ν/(ν + t²) with ν one less than `freedom`.
    share = np.maximum(1 - largest / squared, LEFT)
    chance = np.minimum(1.0, count * both_tails(share, freedom - 1))
    return np.asarray(np.where(freedom > 1, chance, np.nan))


def _largest(squares: Array) -> NDArray[np.intp]:
    """The two samples of every sensor with the largest of `squares` (N, W), (2, W); overwritten."""
    # NumPy's argmax along a short axis takes longer than to compare all with the largest.
    count, width = squares.shape
    numbers = np.arange(count, dtype=np.min_scalar_type(count))[:, None]
    found = np.zeros((2, width), dtype=np.intp)
    for k in range(min(2, count)):
        found[k] = ((squares == squares.max(axis=0)) * numbers).max(axis=0)
        squares[found[k], np.arange(width)] = -1.0
    return found


def both_tails(share: Array, freedom: Array) -> Array:
    """Student's P(|T| > t) with ν = `freedom` at t² = ν/`share` − ν; (W,) each.

    It is the incomplete beta function Iₓ(ν/2, ½) at x = `share` (DLMF 8.17), x^(ν/2)/B times the
    integral of w^(ν/2 − 1)/√(1 − xw) over w from 0 to 1: Gauss-Jacobi quadrature of 1/√(1 − xw),
    whose terms are all positive, so that a small tail has as many digits as a large one. Near
    x = 1, where no residual is outlying, digits are fewer.
    """
    kinds, which = np.unique(np.clip(freedom, 1, MOST), return_inverse=True)
    rules = [_rule(float(kind)) for kind in kinds]
    nodes, weights = (np.stack(part, axis=1) for part in zip(*rules, strict=True))
    if len(kinds) > 1:  # `take` leaves sensors side by side, and sums run over nodes in their order
        nodes, weights = (np.take(part, which, axis=1) for part in (nodes, weights))
    found = share ** (freedom / 2) * (weights / np.sqrt(1 - nodes * share)).sum(axis=0)
    many = np.flatnonzero(freedom > MOST)
    if many.size:
        own = freedom[many]
        found[many] = 2 * stdtr(own, -np.sqrt(own / share[many] - own))
    return np.asarray(found)


@lru_cache(maxsize=MOST)
def _rule(freedom: float) -> tuple[Array, Array]:
    """Nodes and weights (NODES,) on 0 … 1 for w^(ν/2 − 1)/B(ν/2, ½)."""
    half = freedom / 2
    nodes, weights = roots_jacobi(NODES, 0, half - 1)
    return (1 + nodes) / 2, weights / (weights.sum() * half * np.exp(betaln(half, 0.5)))
