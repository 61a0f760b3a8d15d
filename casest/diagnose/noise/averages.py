"""What noise of recorded inputs makes of a residual: how each row differs from those around it.

White noise of an input is in the residual, negative and scaled as the model is; and a mean of the
rows before and after, alike to both sides, has most of the input and little of that noise. So the
residual goes with how the prediction differs from such a mean, whatever the noise's size is from
row to row, and where nothing is known of it. What a sensor does comes late, or bends.
"""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.kinds import noises
from casest.leastsquares.problem import Point, Problem

#: How many rows before and after, in each mean.
REACH = (1, 2, 4, 8, 16)


def averages(problem: Problem, point: Point, *, after: bool = True) -> list[Array] | None:
    """Of each run, what the mean of a row, those before and those `after` does beside the row
    alone, over each reach (N, m, k); None of a model that predicts no reading, or by a trajectory.

    Means of what is predicted: of an input behind a memory they are those of the memory's.
    """
    model, measured = problem.model, problem.model.traced.measured
    if not measured or model.implicit or model.along.integrates or noises(model):
        return None
    found = []
    for run, residual in zip(problem.runs, problem.residuals(point), strict=True):
        predicted = run.signals[measured] - residual
        parts = np.split(predicted, np.flatnonzero(np.diff(run.block)) + 1)
        found.append(np.concatenate([_of_stretch(part, after) for part in parts]))
    return found


def best_mean(residual: Array, basis: Array, columns: Array) -> Array | None:
    """Of residuals (N, m) beside unknowns with an orthonormal `basis` (N·m, p), what the best mean
    takes away (N, m): no row has a weight below zero in it. None where it takes nothing."""
    from scipy.optimize import nnls

    flat = columns.reshape(residual.size, -1)
    Q, R = np.linalg.qr(flat - basis @ (basis.T @ flat))
    weights, _ = nnls(R, Q.T @ residual.ravel())
    return (flat @ weights).reshape(residual.shape) if np.any(weights) else None


def _of_stretch(x: Array, after: bool) -> Array:
    """Second differences of values (N, m) over each reach: (N, m, k); first ones where no row after
    counts."""
    count, most = len(x), max(REACH)
    padded = np.pad(x, ((most, most), (0, 0)), mode="edge")
    shifted = {k: padded[most + k : most + k + count] for r in REACH for k in (-r, r)}
    ahead = {r: shifted[r] - x if after else 0.0 for r in REACH}
    return np.stack([shifted[-r] - x + ahead[r] for r in REACH], axis=2)
