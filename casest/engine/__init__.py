"""Evaluating per-sample expressions over all samples of a record, fast and in constant memory.

It imports `errors` alone, and stands below the declarations, whose units follow its table of
operations (`operations`): NumPy, C and exported programs read the same rows.
"""

from __future__ import annotations

from casest.engine.chain import chained
from casest.engine.compiled import Compiled
from casest.engine.direct import Direct
from casest.engine.kernel import by_workers, evaluated
from casest.engine.lanes import stretches
from casest.engine.normal import (
    Normal,
    cost,
    normal_equations,
    residuals,
    rows,
    summed,
    triangular_factor,
)
from casest.engine.recursion import Recursion
from casest.engine.replay import Columns, Plan, Replay, Samples

__all__ = [
    "Columns",
    "Compiled",
    "Direct",
    "Normal",
    "Plan",
    "Recursion",
    "Replay",
    "Samples",
    "by_workers",
    "chained",
    "cost",
    "evaluated",
    "normal_equations",
    "residuals",
    "rows",
    "stretches",
    "summed",
    "triangular_factor",
]
