"""Kalman-Bucy filter: readings as a curve in time, as the papers write it.

x̂' = A x̂ + c + K(y − C x̂ − d) with K = PCᵀΘ⁻¹ and P of the Riccati equation; c holds the known
inputs. Readings are straight lines between samples, as the inputs are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.filter import coefficients
from casest.dynamics.riccati import riccati
from casest.dynamics.transition import Linearised, transitions, usual
from casest.errors import UsageError


@dataclass(frozen=True)
class Continuous:
    """States x (N, n), covariances P (N, n, n) and gains K (N, n, m) at every sample."""

    time: Array
    x: Array
    P: Array
    K: Array


def kalman_bucy(model: Dynamics, run: Run) -> Continuous:
    """Kalman-Bucy filter of a linear model along a record; where a reading is missing, no gain.

    Raises UsageError for a nonlinear model, DataError where time or inputs are not usable.
    """
    if not model.linear:
        raise UsageError(f"{model.name} is nonlinear: the Kalman-Bucy filter is for linear models")
    system = coefficients(model, run)
    P = riccati(model, system)
    K = P @ system.C.transpose(0, 2, 1) @ np.linalg.inv(model.noise_at(usual(system.steps)))
    reading = np.nan_to_num(system.y - system.d)[:, :, None]
    closed = system.A - K @ system.C
    driven = system.c + (K @ reading)[:, :, 0]
    zero = np.zeros_like(system.C)
    steps = transitions(
        Linearised(system.time, closed, driven, zero, system.d, system.y, system.process)
    )
    x = np.empty_like(driven)
    x[0] = model.start
    for k, (Phi, added) in enumerate(zip(*steps, strict=True)):
        x[k + 1] = Phi.dot(x[k]) + added
    return Continuous(system.time, x, P, K)
