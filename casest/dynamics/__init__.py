"""Estimators in motion: observability, Riccati equation and filters from one declaration."""

from __future__ import annotations

from casest.dynamics.declare import Dynamics, Motion, State, constraint, dynamics, measured, state
from casest.dynamics.filter import Filtered, filtered
from casest.dynamics.record import Record, least_squares
from casest.dynamics.statespace import to_statespace
from casest.dynamics.structural import Structure, structure

__all__ = [
    "Dynamics",
    "Filtered",
    "Motion",
    "Record",
    "State",
    "Structure",
    "constraint",
    "dynamics",
    "filtered",
    "least_squares",
    "measured",
    "state",
    "structure",
    "to_statespace",
]
