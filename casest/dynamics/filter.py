"""Kalman filter and fixed-interval smoother on a sampled record with A(t), gaps and missing readings.

Between samples the exact transition of the (straight-line) signals; readings are taken as averages
over their sampling period, so that their variance is Θ/Δt. A reading that is missing in part is used
in part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.riccati import check_covariance
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
    predicted_P: Array
    innovations: Array
    S: Array
    smoothed: Array
    smoothed_P: Array

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

    Raises DataError where time or inputs are not usable, or a covariance is none.
    """
    check_covariance(model.start_covariance, "the covariance at the beginning")
    system = linearised(model, run)
    found = _once(model, system, smooth or not model.linear)
    if model.linear:
        return found
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
    Q = process_noise(system, model.process, Phi)
    R = model.noise[None] / steps_to(system)[:, None, None]
    N, n = len(system.time), model.size
    m = system.C.shape[1]
    x, P = model.start.copy(), model.start_covariance
    xs, Ps = np.empty((N, n)), np.empty((N, n, n))
    before_x, before_P = np.empty((N, n)), np.empty((N, n, n))
    innovations, S = np.full((N, m), np.nan), np.full((N, m, m), np.nan)
    present = np.isfinite(system.y)
    for k in range(N):
        if k:
            x = Phi[k - 1] @ x + forced[k - 1]
            P = Phi[k - 1] @ P @ Phi[k - 1].T + Q[k - 1]
        before_x[k], before_P[k] = x, P
        seen = present[k]
        if seen.all():
            C, r, nu = system.C[k], R[k], system.y[k] - system.C[k] @ x - system.d[k]
        elif seen.any():
            C, r = system.C[k][seen], R[k][np.ix_(seen, seen)]
            nu = system.y[k][seen] - C @ x - system.d[k][seen]
        else:
            xs[k], Ps[k] = x, P
            continue
        PC = P @ C.T
        s = C @ PC + r
        gain = np.linalg.solve(s, PC.T).T
        x = x + gain @ nu
        # Joseph's form: symmetric and positive to rounding.
        left = -gain @ C
        left[np.diag_indices(n)] += 1.0
        P = left @ P @ left.T + gain @ r @ gain.T
        xs[k], Ps[k] = x, P
        innovations[k, seen] = nu
        S[np.ix_([k], np.flatnonzero(seen), np.flatnonzero(seen))] = s
    smoothed, smoothed_P = _smoothed(Phi, xs, Ps, before_x, before_P) if smooth else (xs, Ps)
    return Filtered(model, system, xs, Ps, before_x, before_P, innovations, S, smoothed, smoothed_P)


def _smoothed(
    Phi: Array, x: Array, P: Array, before_x: Array, before_P: Array
) -> tuple[Array, Array]:
    """Rauch, Tung & Striebel (1965), backwards over the record."""
    smooth_x, smooth_P = x.copy(), P.copy()
    gains = np.linalg.solve(before_P[1:], Phi @ P[:-1]).transpose(0, 2, 1)
    for k in range(len(x) - 2, -1, -1):
        G = gains[k]
        smooth_x[k] = x[k] + G @ (smooth_x[k + 1] - before_x[k + 1])
        smooth_P[k] = P[k] + G @ (smooth_P[k + 1] - before_P[k + 1]) @ G.T
    return smooth_x, smooth_P
