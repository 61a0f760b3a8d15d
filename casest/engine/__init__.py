"""Evaluating per-sample expressions over all samples of a record, fast and in constant memory."""

from __future__ import annotations

from casest.engine.normal import (
    Normal,
    cost,
    normal_equations,
    rows,
    triangular_factor,
)
from casest.engine.replay import Plan, Replay

__all__ = [
    "Normal",
    "Plan",
    "Replay",
    "cost",
    "normal_equations",
    "rows",
    "triangular_factor",
]
