"""Estimators in motion: observability, Riccati equation and filters from one declaration."""

from __future__ import annotations

from casest.dynamics.declare import Dynamics, Motion, State, dynamics, measured, state

__all__ = ["Dynamics", "Motion", "State", "dynamics", "measured", "state"]
