"""Small dense linear algebra of many systems side by side: (n, n, W) matrices, (n, W) vectors.

LAPACK solves one small system after the other and spends most of its time on being called. Here
the loops run over the entries of the matrix, and each step serves all W systems. A matrix that is
not positive definite yields NaN in its own column only.
"""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array


def cholesky(matrix: Array, ridge: Array | None = None) -> Array:
    """Lower triangular L with LLᵀ = matrix, of which the lower triangle is read.

    `ridge` (n, W) is added to the diagonal. A row bᵀ below the matrix becomes (L⁻¹b)ᵀ. Above its
    diagonal L holds nothing meant to be read.
    """
    L = np.empty_like(matrix)
    for j in range(L.shape[1]):
        column = L[j:, j]
        np.einsum("iks,ks->is", L[j:, :j], L[j, :j], out=column)
        np.subtract(matrix[j:, j], column, out=column)
        if ridge is not None:
            column[0] += ridge[j]
        column /= np.sqrt(column[0])
    return L


def forward(L: Array, right: Array) -> Array:
    """L⁻¹·right, (n, W)."""
    y = right.copy()
    for j in range(len(y)):
        if j:
            y[j] -= np.einsum("ks,ks->s", L[j, :j], y[:j])
        y[j] /= L[j, j]
    return y


def backward(L: Array, right: Array) -> Array:
    """L⁻ᵀ·right, (n, W)."""
    x = right.copy()
    for j in range(len(x) - 1, -1, -1):
        if j + 1 < len(x):
            x[j] -= np.einsum("ks,ks->s", L[j + 1 :, j], x[j + 1 :])
        x[j] /= L[j, j]
    return x


def inverse(L: Array) -> Array:
    """(LLᵀ)⁻¹, (n, n, W), both triangles."""
    n = len(L)
    half = np.zeros_like(L)  # L⁻¹, lower triangular
    for i in range(n):
        half[i, i] = 1 / L[i, i]
        if i:
            half[i, :i] = np.einsum("ks,kjs->js", L[i, :i], half[:i, :i])
            half[i, :i] *= -half[i, i]
    found = np.empty_like(L)
    for i in range(n):
        found[i, : i + 1] = np.einsum("ks,kjs->js", half[i:, i], half[i:, : i + 1])
        found[:i, i] = found[i, :i]
    return found


def whole(matrix: Array) -> Array:
    """Both triangles of symmetric matrices of which the lower one is given."""
    below = np.tri(len(matrix), dtype=bool)[:, :, None]
    return np.where(below, matrix, matrix.transpose(1, 0, 2))


def times(matrix: Array, vector: Array) -> Array:
    """matrix·vector, (n, W)."""
    return np.asarray(np.einsum("ijs,js->is", matrix, vector))


def form(matrix: Array, vector: Array) -> Array:
    """vectorᵀ·matrix·vector, (W,), of a symmetric matrix given by its lower triangle alone."""
    diagonal = np.einsum("iis->is", matrix)
    return dot(vector, 2 * times(matrix, vector) - diagonal * vector)


def dot(a: Array, b: Array) -> Array:
    """aᵀb of every system, (W,)."""
    return np.asarray(np.einsum("is,is->s", a, b))


def lengths(matrix: Array) -> Array:
    """Roots of the diagonal of a JᵀJ, (n, W): lengths of J's columns, 1 where there is none."""
    diagonal = np.einsum("iis->is", matrix)
    return np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
