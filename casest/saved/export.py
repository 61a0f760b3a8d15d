"""`casest export`: the correction of a saved result for the device, and JSON ones applied again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import Struct

from casest import __version__
from casest.correction import runtime
from casest.correction.affine import program_of, sensors_of
from casest.correction.c import c_source
from casest.correction.carried import Carried
from casest.correction.formats import Format, refuse_corrected, written
from casest.correction.formats_read import YAML, chosen, sensors_read
from casest.correction.inverse import LEFT
from casest.correction.numpy_module import as_data, python_source
from casest.correction.program import Program, refuse_unexported
from casest.correction.reading import program_read, spread_read, typed
from casest.data import load_runs
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import DataError, UsageError
from casest.escaping import c_identifier
from casest.results.file import load_json
from casest.results.fitted import ranges
from casest.results.saved import SavedResult, saved_correction
from casest.saved.apply import (
    Applied,
    beyond,
    corrected,
    required,
    stds,
    table_of,
    with_margin,
    without,
)

#: What the JSON form calls itself; its schema is `casest/correction/correction.schema.json`.
FORMAT = "casest-correction-1"


def exported(
    path: Path,
    to: Literal["c", "python", "json"],
    *,
    single: bool = False,
    run: int = 0,
    force: bool = False,
    std: bool = False,
) -> str:
    """Text of the exported correction. `run` chooses among runs whose corrections differ.

    With `std` it gives the standard deviations of corrected values too.
    """
    result, carried = saved_correction(path, force=force, what="exports")
    carried = carried.lasting
    if carried.own and not 0 <= run < len(result.runs):
        raise UsageError(f"--run {run}: there are runs 0 to {len(result.runs) - 1}")
    bound, readings = carried.of_run(run if carried.own else 0)
    built = replace(bound, model=carried.model, seen=with_margin(carried))
    refuse_unexported(built)
    spread = required(carried.spread) if std else None
    test = _test(built, readings, path)
    if to == "json":
        return _as_json(built, carried, result, run, spread)
    if to == "python":
        return python_source(built, test, spread)
    return c_source(built, f"correct_{c_identifier(carried.model)}", single, test, spread)


def exported_as(
    path: Path, to: Format, *, sensors: Sequence[str] = (), run: int = 0, force: bool = False
) -> tuple[str, list[str]]:
    """Text of another project's file, of the `sensors` that are named (of all without), and what a
    reader should know beside it."""
    result, carried = saved_correction(path, force=force, what="exports")
    carried = carried.lasting
    if carried.own and not 0 <= run < len(result.runs):
        raise UsageError(f"--run {run}: there are runs 0 to {len(result.runs) - 1}")
    bound, readings = carried.of_run(run if carried.own else 0)
    constants = {n: result.units[n] for n in result.constants if result.units.get(n)}
    found = sensors_of(bound, readings, constants, to)
    kinds = [s.kind for s in found]
    for wanted in sensors:
        if wanted not in kinds:
            raise UsageError(f"--sensor {wanted}: the result has {', '.join(kinds)}")
    kept = [s for s in found if not sensors or s.kind in sensors]
    refuse_corrected(kept, result.conditions)
    text, remarks = written(kept, to, f"{result.model}, {', '.join(result.data)}")
    if bound.left:
        remarks.append(f"{LEFT}{', '.join(bound.left)}")
    return text, remarks


def _test(built: Program, readings: Array, path: Path) -> tuple[Array, Array]:
    """Readings of the fit that have a corrected value, and that."""
    expected = runtime.attempted(as_data(built), readings)
    good = np.isfinite(expected).all(axis=1)
    if not good.any():
        raise DataError(f"{path}: no reading of the fit has a corrected value; calibrate again")
    return readings[good], expected[good]


def _as_json(
    built: Program, carried: Carried, result: SavedResult, run: int, spread: Program | None
) -> str:
    several = len(result.runs) > 1
    content = {
        "format": FORMAT,
        "casest": __version__,
        "model": result.model,
        "signals": [s.name for s in carried.signals],
        "not_undone": list(built.left),
        "convention": result.convention,
        "data": result.data,
        "parameters": {
            name: {
                "value": _of_run(p.value, run, several and result.scopes.get(name) == "run"),
                "std": p.std,
                "unit": p.unit,
            }
            for name, p in result.parameters.items()
        },
        "constants": result.constants,
        "program": as_data(built),
        "range": [list(s) if s else None for s in built.seen],
        **({} if spread is None else {"uncertainty": as_data(spread)}),
    }
    return json.dumps(content, indent=1) + "\n"


def _of_run(value: Any, run: int, own: bool) -> Any:
    return value[run] if own and isinstance(value, list) and run < len(value) else value


def is_exported(path: Path) -> bool:
    """Is this file a correction that was exported as JSON?"""
    if not path.is_file() or path.suffix != ".json":
        return False
    try:
        content = load_json(path)
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and str(content.get("format", "")).startswith("casest-corr")


class _Exported(Struct):
    """What is read of an exported correction."""

    format: str
    program: dict[str, Any]
    signals: list[str] = []
    not_undone: list[str] = []
    range: list[tuple[float, float] | None] = []
    uncertainty: dict[str, Any] | None = None


def applied(path: Path, data: str, arguments: Mapping[str, Any], *, std: bool = False) -> Applied:
    """The data corrected by an exported JSON correction alone."""
    content = typed(load_json(path), _Exported, str(path))
    if content.format != FORMAT:
        raise UsageError(f"{path}: format {content.format!r}; this casest reads {FORMAT}")
    built = program_read(content.program, f"{path}: program", left=content.not_undone)
    signals = [Signal(i.name, i.size, _unit(i.unit), i.kind) for i in built.inputs]
    spare = set(content.signals) - {s.name for s in signals}
    runs = load_runs([data], signals, **without(spare, arguments))
    found, out = [corrected(built, run) for run in runs], built.output
    spread = spread_read(content.uncertainty, built, str(path))
    spreads = [stds(spread, built, *of) for of in zip(runs, found, strict=True)] if std else ()
    text = table_of(runs, [s.name for s in signals], found, out.name, out.unit, spreads)
    notes = dict.fromkeys(note for run in runs for note in run.notes)
    return Applied(text, built.left, (*notes, *beyond(built, content.range, runs)))


def applied_foreign(path: Path, data: str, arguments: Mapping[str, Any]) -> Applied:
    """The data corrected by a file of ROS, Kalibr, ArduPilot or PX4."""
    sensors = chosen(sensors_read(path), arguments.get("columns") or {}, path)
    built = program_of(sensors)
    signals = [Signal(i.name, i.size, i.unit, i.kind) for i in built.inputs]
    runs = load_runs([data], signals, **arguments)
    refuse_corrected(sensors, ranges(runs))
    found = [corrected(built, run) for run in runs]
    unit = built.output.unit or None
    text = table_of(runs, [s.name for s in signals], found, built.output.name, unit)
    notes = list(dict.fromkeys(note for run in runs for note in run.notes))
    if path.suffix in YAML and not any(s.offset.any() for s in sensors):
        notes.append(f"{path} holds no bias, and none is taken away")
    if any(s.per_ampere is not None for s in sensors):
        notes.append("what the motors' current adds is left in: apply reads no current")
    return Applied(text, (), tuple(notes))


def _unit(stated: str) -> str | None:
    """The unit of an input; None where the fit knew none, so that any will do."""
    return stated if stated and "[" not in stated else None
