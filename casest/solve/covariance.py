"""Covariance of an estimate: plain, and robust against unequal noise (sandwich)."""

from __future__ import annotations

import numpy as np

from casest.declaring.shapes import Array
from casest.solve.correlation import batches
from casest.stack import Point, Problem


def inverse_normal(R: Array) -> Array:
    """(JᵀJ)⁻¹ from the triangular factor, with unit columns inside; pseudo-inverse if singular."""
    norms = np.linalg.norm(R, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    _, singular, Vt = np.linalg.svd(R / scale)
    keep = singular > 1e-10 * singular.max(initial=0.0)
    half = Vt[keep].T / singular[keep]
    return np.asarray((half @ half.T) / np.outer(scale, scale))


def sandwich(problem: Problem, point: Point, R: Array, correlated_over: float) -> Array:
    """Covariance (n, n) that holds when noise differs from place to place, or is correlated.

    HC1 (White 1980; MacKinnon & White 1985); over batches of samples ten correlation times long
    where residuals are correlated (Liang & Zeger 1986).
    """
    bread = inverse_normal(R)
    length = int(np.ceil(10 * correlated_over)) if correlated_over > 1 else 1
    numbers = [batches(run, length) for run in problem.runs]
    groups = sum(int(b.max(initial=-1)) + 1 for b in numbers)
    samples, n = sum(len(run) for run in problem.runs), problem.unknowns
    correction = groups / max(groups - 1, 1) * samples / max(samples - n, 1)
    if length == 1:
        correction = samples / max(samples - n, 1)
    return np.asarray(correction * bread @ problem.squares_of_gradients(point, numbers) @ bread)
