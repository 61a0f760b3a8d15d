"""`casest apply` of differential equations: their states along another record.

Such a result corrects nothing; it says how states go on. What each run has of its own (where it
begins) is fitted to the record; all else is as the result has it. Without anything of its own to
fit, a record needs its inputs alone.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casest.data import load_runs
from casest.data.run import Run
from casest.declaration.flow import Flow
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.estimate.held_out import per_run, with_own
from casest.leastsquares.problem import Problem
from casest.results.file import load_result, result_file
from casest.results.saved import SavedResult, saved_result
from casest.saved.apply import axes, bracket, fitted_unit, of_units
from casest.saved.model import of_other_records


@dataclass(frozen=True)
class Followed:
    """States (N, n) and predicted readings (N, m) along a run, with what was fitted to it."""

    run: Run
    states: Array
    predicted: Array
    own: Mapping[str, Array]
    rms: float


def follows(path: Path) -> bool:
    """Is this a result of differential equations that names nothing to correct?"""
    found = load_result(path).get("correction")
    return isinstance(found, dict) and found.get("follows") is True


def followed_csv(
    path: Path, data: str, arguments: Mapping[str, Any], *, force: bool = False
) -> tuple[str, tuple[str, ...]]:
    """The table of states and predicted readings along `data`, and what is said of it.

    Runs the file of the declaration, which must be the one that the result was made with.
    """
    result = saved_result(path)
    if not result.trusted and not force:
        raise UsageError(
            f"{result_file(path)}: this estimate was refused; --force applies it all the same"
        )
    model, values = of_other_records(load_result(path))
    runs = _records(model, result, data, arguments)
    found = [_followed(model, values, run) for run in runs]
    notes = dict.fromkeys(note for run in runs for note in run.notes)
    return _table(model, found), (*notes, *of_units(result, runs, data), *_said(model, found))


def _records(
    model: Model, result: SavedResult, data: str, arguments: Mapping[str, Any]
) -> tuple[Run, ...]:
    """The runs of the file; readings are needed only where something is fitted to them."""
    signals = [s if s.unit else replace(s, unit=fitted_unit(result, s)) for s in model.signals]
    if per_run(model):
        return load_runs([data], signals, **model.reading, **arguments)
    measured = model.traced.readings
    given = [s for s in signals if s.name not in measured]
    runs = load_runs([data], given, **{**model.reading, "gaps": ()}, **arguments)
    return tuple(_without_readings(model, run) for run in runs)


def _without_readings(model: Model, run: Run) -> Run:
    """The run with readings that nobody took."""
    blank = {n: np.full((len(run), model[n].size), np.nan) for n in model.traced.readings}
    units = {n: model[n].unit for n in blank}
    return replace(run, signals={**run.signals, **blank}, units={**run.units, **units})


def _followed(model: Model, values: Mapping[str, Any], run: Run) -> Followed:
    """States along a run, from where it is found to begin."""
    names = per_run(model)
    whole = with_own(model, values, (run,)) if names else dict(values)
    problem = Problem(model, (run,))
    point = problem.point(whole)
    wanted = {"states": _states(model), "predicted": model.along.predicted}
    states, predicted = (part[:, :, 0] for part in problem.evaluate(point, wanted)[0])
    if not (np.isfinite(states).all() and np.isfinite(predicted).all()):
        stopped = problem.stopped(point) or "the prediction is not finite"
        raise DataError(f"{run.file}: {stopped}; apply the result to the record until then")
    left = problem.residuals(point)[0]
    there = ~np.isnan(np.hstack([run.signals[n] for n in model.traced.readings]))
    rms = float(np.sqrt(np.mean(left[there] ** 2))) if there.any() else np.nan
    return Followed(run, states, predicted, {n: whole[n] for n in names}, rms)


def _flows(model: Model) -> list[Flow]:
    return [stage for stage in model.along.stages if isinstance(stage, Flow)]


def _states(model: Model) -> Any:
    return ca.vertcat(*(flow.given for flow in _flows(model)))


def _said(model: Model, found: Sequence[Followed]) -> Iterator[str]:
    """What was fitted to the record, and what that leaves."""
    unit = bracket(model.residual_unit).strip(" []")
    for f in found:
        if f.own:
            own = ", ".join(
                f"{n} = {np.array2string(np.asarray(v), precision=6)}" for n, v in f.own.items()
            )
            yield (
                f"{f.run.name}: fitted to this record: {own}; all else is the result's. Readings "
                f"less predictions: rms {f.rms:.4g} {unit}".rstrip()
            )


def _table(model: Model, found: Sequence[Followed]) -> str:
    """CSV of row, time, the record's signals, every state and the predicted readings."""
    text, first, several = io.StringIO(), found[0].run, len(found) > 1
    writer = csv.writer(text, lineterminator="\n")
    given = [n for n in first.signals if n != "t" and not np.isnan(first.signals[n]).all()]
    header = ["run"] * several + ["row", "t [s]"]
    for n in given:
        header += [f"{n}{a}{bracket(first.units.get(n))}" for a in axes(first.signals[n].shape[1])]
    header += [f"{n}{bracket(unit)}" for n, unit in _named(model)]
    for n in model.traced.readings:
        header += [f"{n}_predicted{a}{bracket(model[n].unit)}" for a in axes(model[n].size)]
    writer.writerow(header)
    for f in found:
        assert f.run.time is not None  # without times nothing was integrated
        rows = np.column_stack([f.run.time, *(f.run.signals[n] for n in given), f.states,
                                f.predicted])  # fmt: skip
        for i, row in enumerate(rows):
            cells = ["" if np.isnan(x) else f"{x:.9g}" for x in row]
            writer.writerow([*[f.run.name] * several, int(f.run.rows[i]), *cells])
    return text.getvalue()


def _named(model: Model) -> Iterator[tuple[str, str | None]]:
    """Name and unit of every number of the states."""
    for flow in _flows(model):
        for name in flow.names:
            quantity = model.along.quantities.get(name.partition("[")[0])
            yield name, quantity.unit if quantity is not None else None
