"""`casest export`: the correction of a saved result for the device, and JSON ones applied again."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from casest import __version__
from casest.correction import runtime
from casest.correction.c import c_source
from casest.correction.inverse import Correction, invertible
from casest.correction.numpy_module import as_data, python_source
from casest.correction.program import Program, program
from casest.data import load_runs
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import DataError, UsageError
from casest.results.file import load_result, plain
from casest.saved.apply import table_of, without
from casest.saved.model import saved_model

#: What the JSON form calls itself; its schema is `casest/correction/correction.schema.json`.
FORMAT = "casest-correction-1"
#: Samples of the self-test.
TESTED = 16


def exported(
    path: Path,
    to: Literal["c", "python", "json"],
    *,
    single: bool = False,
    run: int = 0,
    force: bool = False,
) -> str:
    """Text of the exported correction. `run` chooses among runs whose corrections differ."""
    result = load_result(path)
    if not result.get("trusted", True) and not force:
        raise UsageError(f"{path}: this estimate was refused; --force exports it all the same")
    saved, values = saved_model(result)
    model, left = invertible(saved)
    correction = Correction(model)
    several = len(result["runs"]) > 1
    own = {p.name for p in model.parameters if p.scope == "run"} & correction.parameters
    if several and own and not 0 <= run < len(result["runs"]):
        raise UsageError(f"--run {run}: there are runs 0 to {len(result['runs']) - 1}")
    known = {n: _of_run(saved[n], np.asarray(v), run) for n, v in values.items()}
    own_names = {p.name for p in model.parameters}
    known = {n: v for n, v in known.items() if n in own_names}
    found = result.get("corrected") or {}
    around = (found["low"], found["high"]) if "low" in found else None
    samples, largest = _samples(correction, known, around)
    built = program(correction, known, result.get("units", {}), around, largest)
    built = replace(built, left=left)
    expected = runtime.corrected(as_data(built), samples)
    if to == "json":
        return _as_json(built, saved, result, known)
    if to == "python":
        return python_source(built, (samples, expected))
    name = "correct_" + re.sub(r"\W", "_", model.name)
    return c_source(built, name, single, (samples, expected))


def _of_run(parameter: Any, value: Array, run: int) -> Array:
    return value[run] if value.ndim > len(parameter.shape.dims) else value


def _samples(
    correction: Correction, values: Mapping[str, Any], around: tuple[float, float] | None
) -> tuple[Array, float]:
    """Samples (TESTED, width) whose corrected values lie in the range of the fit; largest reading.

    An explicit model predicts the readings; an implicit one is given readings of that size.
    """
    low, high = around or (-1.0, 1.0)
    rng = np.random.default_rng(0)
    wanted = rng.uniform(low, high, (TESTED, correction.size))
    width = sum(s.size for s in correction.signals)
    if correction.model.implicit:
        found = rng.uniform(low, high, (TESTED, width))
        return found, float(np.abs(found).max())
    readings = correction.readings(values, wanted)
    samples, place = np.zeros((TESTED, width)), 0
    for s in correction.signals:
        if s.name == correction.measured:
            samples[:, place : place + s.size] = readings
        place += s.size
    return samples, float(np.abs(readings).max())


def _as_json(
    built: Program, model: Model, result: Mapping[str, Any], values: Mapping[str, Any]
) -> str:
    content = {
        "format": FORMAT,
        "casest": __version__,
        "model": result["model"],
        "signals": [s.name for s in model.signals],
        "not_undone": list(built.left),
        "convention": result.get("convention", ""),
        "data": result["data"],
        "parameters": {
            name: {**p, "value": plain(values.get(name, p["value"]))}
            for name, p in _with_std(result).items()
        },
        "constants": result["constants"],
        "program": as_data(built),
    }
    return json.dumps(content, indent=1) + "\n"


def _with_std(result: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    estimate = result.get("estimate") or result.get("after") or {}
    found = estimate.get("parameters", {})
    return {n: {k: p[k] for k in ("value", "std", "unit")} for n, p in found.items()}


def is_exported(path: Path) -> bool:
    """Is this file a correction that was exported as JSON?"""
    if not path.is_file() or path.suffix != ".json":
        return False
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and str(content.get("format", "")).startswith("casest-corr")


def applied(path: Path, data: str, arguments: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    """CSV of readings and corrected values by an exported JSON correction alone.

    Beside it the effects that are left in the readings.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    if content["format"] != FORMAT:
        raise UsageError(f"{path}: format {content['format']!r}; this casest reads {FORMAT}")
    steps, out = content["program"], content["program"]["output"]
    signals = [Signal(i["name"], i["size"], i["unit"] or None) for i in steps["inputs"]]
    spare = set(content.get("signals", [])) - {s.name for s in signals}
    runs = load_runs([data], signals, **without(spare, arguments))
    found = []
    for run in runs:
        x = np.hstack([np.asarray(run.signals[s.name]) for s in signals])
        try:
            found.append(runtime.corrected(steps, x))
        except ValueError as error:
            raise DataError(f"{run.file}: {error}") from None
    text = table_of(runs, [s.name for s in signals], found, out["name"], out["unit"])
    return text, tuple(content.get("not_undone", []))
