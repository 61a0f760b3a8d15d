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
from casest.dynamics.discrete import Steps, kalman, smoothed
from casest.dynamics.riccati import check_covariance
from casest.dynamics.stepping import entries, reach
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


def discretised(model: Dynamics, system: Linearised) -> Steps:
    """The record in discrete time: exact transitions, readings as averages over their period."""
    Phi, forced = transitions(system)
    Q = process_noise(system, system.process, Phi)
    R = np.diag(model.noise)[None] / steps_to(system)[:, None]
    patterns = reach(model.traced.A), entries(model.traced.C)
    return Steps(Phi, forced, Q, system.C, system.d, R, system.y, *patterns)


def _once(model: Dynamics, system: Linearised, smooth: bool) -> Filtered:
    steps = discretised(model, system)
    found = kalman(steps, model.start, model.start_covariance)
    both = smoothed(steps, found) if smooth else (found.x, found.P)
    parts = (found.x, found.P, found.predicted_x, found.predicted_P)
    return Filtered(model, system, *parts, found.innovations, found.S, *both)
