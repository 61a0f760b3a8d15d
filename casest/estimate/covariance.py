"""Covariance of an estimate: plain, and robust against unequal noise (sandwich)."""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.correlation import batches
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import squares_of_gradients

#: Fewer batches than this say too little; the plain covariance is then widened as a whole.
FEWEST_BATCHES = 30


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

    HC3 (MacKinnon & White 1985); over batches of samples ten correlation times long where residuals
    are correlated (Liang & Zeger 1986). Too few batches for n² numbers give standard deviations
    but no correlations: those are then taken from the plain covariance.
    """
    bread = inverse_normal(R)
    if correlated_over <= 1:
        return np.asarray(bread @ squares_of_gradients(problem, point, bread=bread) @ bread)
    length = int(np.ceil(10 * correlated_over))
    firsts = [batches(run, length) for run in problem.runs]
    groups = sum(len(first) for first in firsts)
    if groups < FEWEST_BATCHES:
        plain = 2 * problem.cost(point) / max(problem.residual_count - problem.unknowns, 1)
        return np.asarray(correlated_over * plain * bread)
    correction = groups / max(groups - 1, 1)
    robust = correction * bread @ squares_of_gradients(problem, point, firsts) @ bread
    if groups >= 20 * problem.unknowns:
        return np.asarray(robust)
    with np.errstate(invalid="ignore"):  # nothing is known of an unknown that no residual has
        ratio = np.sqrt(np.diag(robust) / np.diag(bread))
    return np.asarray(bread * np.outer(ratio, ratio))
