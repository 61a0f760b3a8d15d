"""`casest apply`: a saved result on new data, column by column."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casest.apply import corrected
from casest.data import load_runs
from casest.data.run import Run
from casest.data.write import write_atomically
from casest.declaring.symbols import constant
from casest.errors import DataError, UsageError
from casest.modelling.model import Model
from casest.problem import find_model
from casest.result import load_result, saved_parameters


def saved_model(result: Mapping[str, Any]) -> tuple[Model, dict[str, Any]]:
    """Model and parameter values of a saved result, constants as they were."""
    model = find_model(result["model"])
    units = result.get("units", {})
    for name, value in result["constants"].items():
        unit = units.get(name, "")
        model = model.having(**{name: constant(value, "" if "[" in unit else unit)})
    parameters = saved_parameters(result)
    missing = [p.name for p in model.parameters if p.name not in parameters]
    if missing:
        raise DataError(f"the result has no value for {missing[0]!r} of model {model.name}")
    return model, {name: np.array(p["value"], dtype=float) for name, p in parameters.items()}


def corrected_csv(
    path: Path, data: str, arguments: Mapping[str, Any], *, force: bool = False
) -> str:
    """CSV with time, the readings and the corrected readings, units in the header."""
    result = load_result(path)
    if not result.get("trusted", True) and not force:
        raise UsageError(f"{path}: this estimate was refused; --force applies it all the same")
    model, values = saved_model(result)
    runs = load_runs([data], model.signals, **arguments)
    _same_units(result, runs, data)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for k, run in enumerate(runs):
        per_run = {p.name for p in model.parameters if p.scope == "run"}
        if per_run & _reached(model):
            raise UsageError(
                f"{sorted(per_run)[0]} differs from run to run: nothing to apply it to"
            )
        value = corrected(model, run, {n: v for n, v in values.items() if n not in per_run})
        _write(writer, model, run, value, result, header=k == 0, several=len(runs) > 1)
    return text.getvalue()


def _reached(model: Model) -> set[str]:
    """Per-run parameters that the correction itself depends on."""
    import casadi as ca

    from casest.modelling.tracing import trace

    name = model.traced.corrected
    cut = trace(model, cut=name)
    expression = (
        model.traced.quantities[name].declared if model.implicit and name else cut.expression
    )
    symbols = model.traced.symbols if model.implicit else cut.symbols
    return {
        p.name
        for p in model.parameters
        if p.scope == "run" and ca.depends_on(expression, ca.vec(symbols[p.name]))
    }


def _same_units(result: Mapping[str, Any], runs: tuple[Run, ...], data: str) -> None:
    for name, unit in runs[0].units.items():
        fitted = result.get("units", {}).get(name)
        if fitted and unit and "[" not in fitted and unit != fitted:
            raise DataError(
                f"{data}: signal {name} is in {unit}, the result was made in {fitted}; "
                f"give the data in {fitted} (--unit says what a file's numbers are)"
            )


def _write(
    writer: Any,
    model: Model,
    run: Run,
    value: Any,
    result: Mapping[str, Any],
    header: bool,
    several: bool,
) -> None:
    name = str(model.traced.corrected)
    unit = result.get("units", {}).get(model.quantities[name].unit.strip("[]"), "")
    unit = unit or model.quantities[name].unit
    unit = f" [{unit}]" if unit and "[" not in unit and unit != "1" else ""
    readings = run.signals[model.traced.measured or model.signals[-1].name]
    reading = model.traced.measured or model.signals[-1].name
    own = run.units.get(reading)
    axes = "xyz" if readings.shape[1] == 3 else [str(i) for i in range(readings.shape[1])]
    if header:
        names = ["run"] * several + ["row"] + ["t [s]"] * (run.time is not None)
        names += [f"{reading}{a}" + (f" [{own}]" if own else "") for a in axes]
        out = "xyz" if value.shape[1] == 3 else [str(i) for i in range(value.shape[1])]
        writer.writerow([*names, *(f"{name}_{a}{unit}" for a in out)])
    for i in range(len(run)):
        row: list[Any] = [run.name] * several + [int(run.rows[i])]
        if run.time is not None:
            row.append(f"{float(run.time[i]):.9g}")
        writer.writerow([*row, *(f"{x:.9g}" for x in readings[i]), *(f"{x:.9g}" for x in value[i])])


def write_or_print(text: str, output: Path | None) -> None:
    """To a .csv file, to corrected.csv in a folder, or to standard output."""
    if output is None:
        sys.stdout.write(text)
        return
    if output.suffix != ".csv":
        output.mkdir(parents=True, exist_ok=True)
        output = output / "corrected.csv"
    write_atomically(output, text)
