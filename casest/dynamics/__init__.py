"""Estimators in motion: observability, Riccati equation and filters from one declaration."""

from __future__ import annotations

from casest.dynamics.continuous import Continuous, kalman_bucy
from casest.dynamics.declare import (
    Dynamics,
    Motion,
    State,
    angle,
    constraint,
    dynamics,
    measured,
    state,
)
from casest.dynamics.dimensions import check_units
from casest.dynamics.discrete import Estimates, Steps, kalman, smoothed
from casest.dynamics.filter import Filtered, filtered
from casest.dynamics.moving_horizon import Horizon, moving_horizon
from casest.dynamics.online import Estimator
from casest.dynamics.record import Record, least_squares
from casest.dynamics.statespace import to_statespace
from casest.dynamics.structural import Structure, structure

__all__ = [
    "Continuous",
    "Dynamics",
    "Estimates",
    "Estimator",
    "Filtered",
    "Horizon",
    "Motion",
    "Record",
    "State",
    "Steps",
    "Structure",
    "angle",
    "check_units",
    "constraint",
    "dynamics",
    "filtered",
    "kalman",
    "kalman_bucy",
    "least_squares",
    "measured",
    "moving_horizon",
    "smoothed",
    "state",
    "structure",
    "to_statespace",
]
