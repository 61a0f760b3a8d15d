"""Full-record least squares: all states at once, without a filter.

Minimised is ‖x₀ − m‖²/P₀ + Σ‖x(k+1) − F(x(k))‖²/Q + Σ‖y − h(x)‖²/R. With multipliers
λ₀ = P₀⁻¹(x₀ − m) and λ(k+1) = Q⁻¹(x(k+1) − F(x(k))) its normal equations need no inverse of P₀ or
Q, so that a state may be driven by nothing (augmented equations: Björck 1996, 1.5.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import Steps
from casest.dynamics.extended import Sampled, extended, relinearised, shifted
from casest.dynamics.filter import (
    ROUNDS,
    SETTLED,
    coefficients,
    discretised,
    filtered,
)
from casest.dynamics.inputs import uncertain
from casest.dynamics.likely import Inputs
from casest.dynamics.riccati import check_covariance


@dataclass(frozen=True)
class Record:
    """Most probable states x (N, n) of a record; covariances (n, n) at its start and its end."""

    x: Array
    P_start: Array
    P_end: Array


def least_squares(model: Dynamics, run: Run) -> Record:
    """All states of a record at once; Gauss-Newton rounds for a nonlinear model.

    For a linear model the same estimate as the smoother's, and at the end as the filter's, by other
    algebra. Constraints are not put in. Raises DataError as the filter does.
    """
    check_covariance(model.start_covariance, "the covariance at the beginning")
    if model.linear:
        noisy = uncertain(model)
        system = filtered(model, run).system if noisy else coefficients(model, run)
        return _solved(model, discretised(model, system))
    if shifted(model):
        own, sampled = filtered(model, run), Sampled.of(model, run)
        inputs = Inputs.of(sampled, run, own.smoothed, own.smoothed_P)
        return _solved(model, inputs.steps(sampled, run, own.smoothed))
    x = extended(model, run)[0]
    for _ in range(ROUNDS):
        found = _solved(model, relinearised(model, run, x))
        change = np.abs(found.x - x) / np.sqrt(np.diag(found.P_end))
        x = found.x
        if np.max(change) < SETTLED:
            break
    return found


def _solved(model: Dynamics, steps: Steps) -> Record:
    from scipy.sparse.linalg import splu

    N, n = len(steps.C), model.size
    right = np.zeros((N, 2, n))
    weighted = np.where(steps.present, (steps.y - steps.d) / steps.R, 0.0)
    right[:, 0] = np.einsum("kij,ki->kj", steps.seen, weighted)
    right[0, 1], right[1:, 1] = model.start, steps.forced
    columns = np.zeros((N, 2, n, 1 + 2 * n))
    columns[..., 0] = right
    columns[0, 0, :, 1 : 1 + n] = columns[-1, 0, :, 1 + n :] = np.eye(n)
    whole = splu(equations(steps, model.start_covariance)).solve(columns.reshape(2 * n * N, -1))
    found = whole.reshape(N, 2, n, -1)[:, 0]
    start, end = found[0, :, 1 : 1 + n], found[-1, :, 1 + n :]
    return Record(found[..., 0], 0.5 * (start + start.T), 0.5 * (end + end.T))


def equations(steps: Steps, covariance: Array) -> Any:
    """The augmented equations of x(k), λ(k), sample by sample, as a sparse matrix.

    `covariance` (n, n) holds before the first reading.
    """
    from scipy.sparse import csc_array

    N, n = len(steps.C), steps.C.shape[2]
    seen = steps.seen
    information = seen.transpose(0, 2, 1) @ (seen / steps.R[:, :, None])
    driven = np.concatenate([covariance[None], steps.Q])
    eyes = np.broadcast_to(np.eye(n), (N, n, n))
    # (row: sample, x or λ; column: sample, x or λ; entries)
    here, after = np.arange(N), np.arange(N - 1)
    parts = [
        (here, 0, here, 0, information),
        (here, 0, here, 1, eyes),
        (after, 0, after + 1, 1, -steps.Phi.transpose(0, 2, 1)),
        (here, 1, here, 0, eyes),
        (here, 1, here, 1, -driven),
        (after + 1, 1, after, 0, -steps.Phi),
    ]
    i, j = np.arange(n)[:, None], np.arange(n)[None, :]
    places: list[list[Array]] = []
    values: list[Array] = []
    for row, of_row, column, of_column, entries in parts:
        down = (2 * row + of_row)[:, None, None] * n + i
        across = (2 * column + of_column)[:, None, None] * n + j
        places.append([np.broadcast_to(p, entries.shape).ravel() for p in (down, across)])
        values.append(entries.ravel())
    data = np.concatenate(values)
    place: Any = np.concatenate(places, axis=1)
    kept = data != 0
    return csc_array((data[kept], place[:, kept]), shape=(2 * n * N, 2 * n * N))
