"""Held-out squares: each part of a record foretold by the rest, with columns beside the fit or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index, Linear, robust_sd
from casest.diagnose.levels import LEVELS

#: Robust standard deviations (before) that a held-out residual counts as at most.
FAR = 4.0


@dataclass(frozen=True)
class Fall:
    """What columns do to held-out squares: ratio after over before; t of the fall, from part to part."""

    ratio: float
    t: float


def squares(linear: Linear, columns: Sequence[Array], parts: Index) -> Array:
    """Held-out squares of every part (parts,), each by a fit to the others; columns (N, m, k)."""
    e = _near(linear, foretold(linear, columns, parts))
    return np.bincount(parts, np.sum(e**2, axis=1))


def foretold(linear: Linear, columns: Sequence[Array], parts: Index) -> Array:
    """Held-out residuals (N, m)."""
    flat = np.concatenate([linear.basis, *[_flat(c, linear) for c in columns]], axis=1)
    y, found = linear.residual.ravel(), np.empty(linear.residual.size)
    for own, values in _fits(linear, flat, parts):
        found[own] = y[own] - flat[own] @ values
    return found.reshape(linear.residual.shape)


def fall(linear: Linear, columns: Sequence[Array], parts: Index) -> Fall:
    """Of the squares by columns.

    Were they right, with errors a after and predictions that differ by δ, the squares would fall by
    Σ(δ² + 2aδ): the error of the fall is that of 2Σaδ, from batch to batch of the record, and not
    below that of white noise. So what is gained in a few places only is a gain as well.
    """
    b, a = (foretold(linear, c, parts) for c in ((), columns))
    moved, nearer = b - a, np.abs(a) < np.abs(b)
    # What is far from both is neither's; what one of them is far from counts in full.
    least = _near(linear, np.where(nearer, a, b))
    a, b = np.where(nearer, least, least - moved), np.where(nearer, least + moved, least)
    gained = float(np.sum(b**2) - np.sum(a**2))
    wide = np.bincount(linear.parts.batches, np.sum(2 * a * moved, axis=1))
    white = 4 * float(np.mean(a**2)) * float(np.sum(moved**2))
    spread = np.sqrt(max(float(np.sum(wide**2)), white))
    ratio = float(np.sum(a**2) / max(np.sum(b**2), 1e-300))
    return Fall(ratio, float(gained / max(spread, 1e-300)))


def standard_errors(gained: Array) -> float:
    """A sum over parts in its own standard errors."""
    spread = np.sqrt(len(gained)) * np.std(gained, ddof=1) if len(gained) > 1 else np.inf
    return float(gained.sum() / max(spread, 1e-300))


def _near(linear: Linear, e: Array) -> Array:
    """Errors (N, m), those far out counted as less: by what is far before."""
    far = FAR * robust_sd(linear.residual)
    return np.clip(e, -far, far) if linear.series else e


def _fits(linear: Linear, flat: Array, parts: Index):  # type: ignore[no-untyped-def]
    """Rows of each part, and the least-squares values of the others."""
    row = np.repeat(parts, linear.residual.shape[1])
    y = clipped(linear).ravel()
    A, b = flat.T @ flat, flat.T @ y
    for k in np.unique(parts):
        own = np.flatnonzero(row == k)
        X = flat[own]
        yield own, np.linalg.lstsq(A - X.T @ X, b - X.T @ y[own], rcond=1e-9)[0]


def clipped(linear: Linear) -> Array:
    """Residuals that fits are made to: those far out brought near."""
    if not linear.series:
        return linear.residual
    far = FAR * LEVELS.clip * robust_sd(linear.residual)
    return np.clip(linear.residual, -far, far)


def _flat(columns: Array, linear: Linear) -> Array:
    flat = columns.reshape(linear.residual.size, -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300))
