"""Information matrices: how many directions they tell of, and what is left without some of them."""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array

#: A direction counts as observable from this share of the largest scaled eigenvalue on. Rounding
#: and the error of a fourth-order step stay below 1e-13.
NULL = 1e-11


def spectrum(W: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Eigenvalues, largest first, and vectors of W scaled to a unit diagonal, and that scale; where
    the diagonal is zero, what is known beforehand is."""
    told = np.diag(W) > 0
    scale = np.where(told, np.sqrt(np.where(told, np.diag(W), 1.0)), 1 / prior)
    values, vectors = np.linalg.eigh(W / np.outer(scale, scale))
    return values[::-1], vectors[:, ::-1], scale


def rank_of(values: Array) -> int:
    """How many eigenvalues, largest first, count."""
    return int(np.sum(values > NULL * values[0])) if values[0] > 0 else 0


def without(W: Array, unseen: Array | int) -> Array:
    """What W (n, n) tells of a state whatever it is in directions N (n, k): W − WN(NᵀWN)⁺NᵀW.

    An int: of so many directions at most, those of which it tells most.
    """
    values, vectors, scale = spectrum(W, np.ones(len(W)))
    N = vectors[:, unseen:] if isinstance(unseen, int) else scale[:, None] * unseen
    N = np.linalg.qr(N)[0]
    # Of a root of W, so that nothing is left of N but rounding squared.
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    own, sizes, _ = np.linalg.svd(root @ N, full_matrices=False)
    own = own[:, sizes**2 > NULL * values[0]]
    left = root - own @ (own.T @ root)
    left -= (left @ N) @ N.T
    told = np.sum(left**2, axis=0) > NULL * np.sum(root**2, axis=0)
    return even((left * told).T @ (left * told) * np.outer(scale, scale))


def even(M: Array) -> Array:
    """Symmetric to rounding."""
    return np.asarray(0.5 * (M + np.swapaxes(M, -1, -2)))
