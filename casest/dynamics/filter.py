"""Kalman filter and fixed-interval smoother on a sampled record with A(t), gaps, missing readings.

Between samples the exact transition of the (straight-line) signals; readings are taken as averages
over their sampling period, so that their variance is Θ/Δt. A reading that is missing in part is
used in part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.riccati import check_covariance
from casest.dynamics.stepping import kalman_step, reach, run_steps
from casest.dynamics.transition import (
    Linearised,
    linearised,
    process_noise,
    steps_to,
    transitions,
)

#: Rounds of an extended filter: linearised along its own smoothed states.
ROUNDS = 20


@dataclass(frozen=True)
class Filtered:
    """States over time with covariances, and what each reading said.

    time (N,); x (N, n) and P (N, n, n) after each reading; predicted_x, predicted_P before it;
    innovations y − Cx (N, m), their covariance S (N, m, m), NaN where a reading is missing.
    `smoothed` and `smoothed_P` use the whole record.
    """

    model: Dynamics
    system: Linearised
    x: Array
    P: Array
    predicted_x: Array
    predicted_P: Array  # noqa: N815
    innovations: Array
    S: Array
    smoothed: Array
    smoothed_P: Array  # noqa: N815

    @property
    def time(self) -> Array:
        """Time of every sample, s."""
        return self.system.time

    @property
    def std(self) -> Array:
        """Standard deviation of every state after each reading, (N, n)."""
        return np.sqrt(np.diagonal(self.P, axis1=1, axis2=2))

    @property
    def normalised_innovations(self) -> Array:
        """νᵀS⁻¹ν of every complete reading, (N,): χ² with m degrees of freedom if all is right."""
        whole = np.isfinite(self.innovations).all(axis=1)
        found = np.full(len(self.innovations), np.nan)
        solved = np.linalg.solve(self.S[whole], self.innovations[whole][:, :, None])[:, :, 0]
        found[whole] = np.sum(self.innovations[whole] * solved, axis=1)
        return found


def filtered(model: Dynamics, run: Run, *, smooth: bool = True) -> Filtered:
    """Kalman filter over a record; an extended one, iterated, for a nonlinear model.

    Where the inputs' noise reaches the states through the states themselves, it is taken along
    the estimates of a first pass.

    Raises DataError where time or inputs are not usable, or a covariance is none.
    """
    check_covariance(model.start_covariance, "the covariance at the beginning")
    system = linearised(model, run)
    found = _once(model, system, not model.linear or (smooth and model.input_noise is None))
    if model.linear:
        if model.input_noise is None:
            return found
        return _once(model, linearised(model, run, along=found.x), smooth)
    for _ in range(ROUNDS):
        system = linearised(model, run, along=found.smoothed)
        again = _once(model, system, True)
        change = np.max(np.abs(again.smoothed - found.smoothed) / np.maximum(again.std, 1e-300))
        found = again
        if change < 1e-6:
            break
    return found


def _once(model: Dynamics, system: Linearised, smooth: bool) -> Filtered:
    Phi, forced = transitions(system)
    Q = process_noise(system, system.process, Phi)
    R = np.diag(model.noise)[None] / steps_to(system)[:, None]
    n, m = model.size, system.C.shape[1]
    present = np.isfinite(system.y)
    # A reading that is missing is one that the state does not reach: no row, no innovation.
    C = np.where(present[:, :, None], system.C, 0.0)
    y = np.where(present, system.y - system.d, 0.0)
    eye = np.eye(n)[None]
    Phi_first = np.concatenate([eye, Phi])
    moved = np.concatenate([np.zeros((1, n)), forced])
    added = np.concatenate([np.zeros((1, n, n)), Q])
    columns = [Phi_first, moved, added, C, R, y]
    found = run_steps(
        kalman_step(n, m, reach(model.traced.A)), model.start, model.start_covariance, columns
    )
    x, P, before_x, before_P = found
    innovations = np.where(present, y - np.einsum("kij,kj->ki", C, before_x), np.nan)
    S = C @ before_P @ C.transpose(0, 2, 1)
    S[:, np.arange(m), np.arange(m)] += R
    S = np.where(present[:, :, None] & present[:, None, :], S, np.nan)
    smoothed, smoothed_P = _smoothed(Phi, x, P, before_x, before_P) if smooth else (x, P)
    return Filtered(model, system, x, P, before_x, before_P, innovations, S, smoothed, smoothed_P)


def _smoothed(
    Phi: Array, x: Array, P: Array, before_x: Array, before_P: Array
) -> tuple[Array, Array]:
    """Rauch, Tung & Striebel (1965), backwards over the record."""
    smooth_x, smooth_P = x.copy(), P.copy()
    gains = np.linalg.solve(before_P[1:], Phi @ P[:-1]).transpose(0, 2, 1)
    # What does not depend on later samples, all at once.
    own_x = x[:-1] - np.einsum("kij,kj->ki", gains, before_x[1:])
    own_P = P[:-1] - gains @ before_P[1:] @ gains.transpose(0, 2, 1)
    later_x, later_P = x[-1], P[-1]
    for k in range(len(x) - 2, -1, -1):
        G = gains[k]
        smooth_x[k] = later_x = own_x[k] + G.dot(later_x)
        smooth_P[k] = later_P = own_P[k] + G.dot(later_P).dot(G.T)
    return smooth_x, smooth_P
