"""Single samples of an explicit model: rows of a table, or of every combination of settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.leastsquares.problem import Problem
from casest.plan.candidates.candidates import (
    Candidates,
    Noise,
    blank,
    factors_of,
    others,
    predicted,
)

#: The column of a table of candidates that says what each costs.
COST = "cost"


def settings(
    model: Model, values: Mapping[str, Any], noise: Noise, varied: Mapping[str, Array]
) -> Candidates:
    """Every combination of values of the signals that can be set."""
    missing = [s.name for s in others(model) if s.name not in varied]
    if missing or model.implicit:
        need = missing[0] if missing else model.readings[0].name
        raise UsageError(
            f"{model.name}: say what {need} can be, --vary {need}=0:1:0.1, or give a table of what "
            "can be measured, --candidates FILE"
        )
    count = len(next(iter(varied.values()))) if varied else 1
    run = predicted(model, values, blank(model, count, varied))
    said = ["; ".join(_said(model, n, rows[i]) for n, rows in varied.items()) for i in range(count)]
    return of_run(model, values, noise, run, said, np.ones(count))


def _said(model: Model, name: str, row: Array) -> str:
    unit = model[name].unit if name in model.symbols else ""
    number = ", ".join(f"{x:g}" for x in row)
    return f"{name} {number}{f' {unit}' if unit and unit != '1' else ''}"


def table(model: Model, values: Mapping[str, Any], noise: Noise, runs: Sequence[Run]) -> Candidates:
    """Rows of a table that has all signals that are not predicted."""
    if len(runs) != 1:
        raise DataError(f"{runs[0].file}: holds {len(runs)} runs; candidates are rows of one table")
    run = runs[0]
    measured = model.traced.measured
    if measured is not None and measured not in run.signals:
        run = predicted(model, values, blank(model, len(run), run.signals))
    shown = [s.name for s in others(model)] or [s.name for s in model.readings]
    said = [
        f"row {int(runs[0].rows[i]) + 1}: "
        + "; ".join(_said(model, n, run.signals[n][i]) for n in shown)
        for i in range(len(run))
    ]
    return of_run(model, values, noise, run, said, cost_of(runs[0]))


def cost_of(run: Run) -> Array:
    """What each row costs: its column `cost`, else one."""
    if COST not in run.columns:
        return np.ones(len(run))
    try:
        cost = np.asarray(run.columns[COST], dtype=float)
    except ValueError:
        raise DataError(f"{run.file}: column {COST} holds what is no number") from None
    if not (np.isfinite(cost).all() and (cost > 0).all()):
        bad = int(np.argmax(~(np.isfinite(cost) & (cost > 0))))
        raise DataError(
            f"{run.file}: {COST} of row {bad + 1} is {cost[bad]:g}; it must be positive"
        )
    return cost


def of_run(
    model: Model,
    values: Mapping[str, Any],
    noise: Noise,
    run: Run,
    said: Sequence[str],
    cost: Array,
    up: Array | None = None,
    kind: str = "sample",
) -> Candidates:
    """Every sample of a run as a candidate."""
    return Candidates(
        kind,
        factors_of(model, values, run, noise),
        Problem(model, (run,)).names,
        tuple(said),
        cost,
        run.signals,
        {},
        up,
        run,
    )
