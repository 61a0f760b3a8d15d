"""Directions that data do not determine, as few unknowns at a time as can be."""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array


def sparsest(basis: Array) -> Array:
    """The same space (n, k) with few unknowns per direction: reduced column echelon form."""
    matrix = basis.copy()
    done: list[int] = []
    for k in range(matrix.shape[1]):
        size = np.abs(matrix[:, k:]).max(axis=1)
        size[done] = 0
        row = int(np.argmax(size))
        pivot = k + int(np.argmax(np.abs(matrix[row, k:])))
        matrix[:, [k, pivot]] = matrix[:, [pivot, k]]
        matrix[:, k] /= matrix[row, k]
        for j in range(matrix.shape[1]):
            if j != k:
                matrix[:, j] -= matrix[row, j] * matrix[:, k]
        done.append(row)
    return np.asarray(matrix / np.linalg.norm(matrix, axis=0))
