"""Covariance of an estimate: plain, and robust against unequal noise (sandwich)."""

from __future__ import annotations

import numpy as np

from casest.declaring.shapes import Array
from casest.stack import Point, Problem


def inverse_normal(R: Array) -> Array:
    """(JᵀJ)⁻¹ from the triangular factor, with unit columns inside; pseudo-inverse if singular."""
    norms = np.linalg.norm(R, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    _, singular, Vt = np.linalg.svd(R / scale)
    keep = singular > 1e-10 * singular.max(initial=0.0)
    half = Vt[keep].T / singular[keep]
    return np.asarray((half @ half.T) / np.outer(scale, scale))


def sandwich(problem: Problem, point: Point, R: Array) -> Array:
    """Heteroscedasticity-consistent covariance (HC1: White 1980, MacKinnon & White 1985), (n, n)."""
    bread = inverse_normal(R)
    samples = sum(len(run) for run in problem.runs)
    n = problem.unknowns
    correction = samples / max(samples - n, 1)
    return np.asarray(correction * bread @ problem.squares_of_gradients(point) @ bread)
