"""When to read one run of a model whose states follow differential equations (`integrate`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.plan.candidates.candidates import TIME, Candidates, Noise, others, predicted
from casest.plan.candidates.rows import cost_of, of_run


def times(
    model: Model,
    values: Mapping[str, Any],
    noise: Noise,
    inputs: Mapping[str, Array],
    *,
    duration: float,
    rate: float,
) -> Candidates:
    """Every time of one run at which it can be read; inputs are held over it."""
    missing = [s.name for s in others(model) if s.name not in inputs]
    several = [name for name, rows in inputs.items() if len(rows) > 1]
    if missing or several:
        name = (missing or several)[0]
        raise UsageError(
            f"{model.name}: say what {name} is over the run: one value, --vary {name}=VALUE, or "
            "its course in a table with t, --candidates FILE"
        )
    t = np.arange(round(duration * rate) + 1) / rate
    if len(t) < 2:
        raise UsageError(
            f"--duration {duration:g} --rate {rate:g}: fewer than two times to read at"
        )
    held = {name: np.repeat(rows, len(t), axis=0) for name, rows in inputs.items()}
    return _read(model, values, noise, t, held, np.ones(len(t)))


def table(model: Model, values: Mapping[str, Any], noise: Noise, runs: Sequence[Run]) -> Candidates:
    """Rows of one table with the course of the inputs: times at which the run can be read."""
    if len(runs) != 1:
        raise DataError(f"{runs[0].file}: holds {len(runs)} runs; candidates are rows of one table")
    run = runs[0]
    if run.time is None:
        raise DataError(
            f"{run.file}: {model.name} follows differential equations, and its rows need a time: "
            "--columns t=NAME or --rate"
        )
    own = {s.name: run.signals[s.name] for s in others(model)}
    return _read(model, values, noise, np.asarray(run.time, float), own, cost_of(run))


def _read(
    model: Model,
    values: Mapping[str, Any],
    noise: Noise,
    t: Array,
    inputs: Mapping[str, Array],
    cost: Array,
) -> Candidates:
    signals = {s.name: np.zeros((len(t), s.size)) for s in model.signals}
    units = {s.name: s.unit for s in model.signals}
    made = Run.raw("planned", {**signals, **inputs, "t": t[:, None]}, units=units, time=t)
    run = predicted(model, values, made)
    said = [f"read at t = {x:.6g} s" for x in t]
    return of_run(model, values, noise, run, said, cost, kind=TIME)
