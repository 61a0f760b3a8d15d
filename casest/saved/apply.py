"""`casest apply`: a saved result on new data, column by column."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from casest.correction.inverse import Correction, invertible, of_their_time
from casest.data import load_runs
from casest.data.run import Run
from casest.data.write import write_atomically
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter
from casest.errors import DataError, UsageError
from casest.results.file import load_result
from casest.saved.model import saved_model


def corrected_csv(
    path: Path, data: str, arguments: Mapping[str, Any], *, force: bool = False
) -> tuple[str, tuple[str, ...]]:
    """CSV with time, the readings and the corrected readings, units in the header.

    Beside it the effects that are left in the readings (see `invertible`).
    """
    result = load_result(path)
    if not result.get("trusted", True) and not force:
        raise UsageError(f"{path}: this estimate was refused; --force applies it all the same")
    saved, values = saved_model(result)
    model, left = invertible(saved)
    correction = Correction(model)
    which = _run_number(model, correction, result, data)
    needed = {
        n: _of_one_run(saved[n], v, which) for n, v in values.items() if n in correction.parameters
    }
    spare = {s.name for s in model.signals} - {s.name for s in correction.signals}
    runs = load_runs([data], correction.signals, **without(spare, arguments))
    _same_units(result, runs, data)
    known = result.get("corrected") or {}
    around = (known["low"], known["high"]) if "low" in known else None
    given, unit = correction.signals, result.get("units", {}).get(correction.name)
    found = [correction(run, needed, around) for run in runs]
    return table_of(runs, [s.name for s in given], found, correction.name, unit), left


def of_another_time(path: Path, data: str | None = None) -> tuple[str, ...]:
    """Effects that follow the time of the fitted record, unless it is that record again."""
    result = load_result(path)
    if data is not None and Path(data).resolve() in {Path(d).resolve() for d in result["data"]}:
        return ()
    return of_their_time(invertible(saved_model(result)[0])[0])


def without(spare: Iterable[str], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the fit may be typed again: those of signals that are not needed fall away."""
    kept, away = dict(arguments), set(spare)
    for option in ("columns", "units", "scales"):
        given = arguments.get(option) or {}
        kept[option] = {name: value for name, value in given.items() if name not in away}
    return kept


def _run_number(model: Model, correction: Correction, result: Mapping[str, Any], data: str) -> int:
    """Which fitted run the data are: matters where the correction differs from run to run."""
    differing = {p.name for p in model.parameters if p.scope == "run"} & correction.parameters
    if len(result["runs"]) == 1 or not differing:
        return 0
    files = [Path(name).resolve() for name in result["data"]]
    if len(files) == len(result["runs"]) and Path(data).resolve() in files:
        return files.index(Path(data).resolve())
    name = sorted(differing)[0]
    raise UsageError(
        f"{name} differs from run to run, and {data} is none of the fitted files; calibrate with "
        f"--shared {name} to apply the result to new data"
    )


def _of_one_run(parameter: Parameter, value: Array, which: int) -> Array:
    """The value of one run; only several runs have a run axis."""
    return value[which] if value.ndim > len(parameter.shape.dims) else value


def _same_units(result: Mapping[str, Any], runs: tuple[Run, ...], data: str) -> None:
    for name, unit in runs[0].units.items():
        fitted = result.get("units", {}).get(name)
        if fitted and unit and "[" not in fitted and unit != fitted:
            raise DataError(
                f"{data}: signal {name} is in {unit}, the result was made in {fitted}; "
                f"give the data in {fitted} (--unit says what a file's numbers are)"
            )


def table_of(
    runs: Sequence[Run], given: Sequence[str], found: Sequence[Array], name: str, unit: str | None
) -> str:
    """CSV of row, time, the `given` signals and what was `found`, called `name`, in each run."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    first, several = runs[0], len(runs) > 1
    given = [signal for signal in given if signal != "t" or first.time is None]
    header = ["run"] * several + ["row"] + ["t [s]"] * (first.time is not None)
    for signal in given:
        own = _bracket(first.units.get(signal))
        header += [f"{signal}{a}{own}" for a in _axes(first.signals[signal])]
    header += [f"{name}{'_' * bool(a)}{a}{_bracket(unit)}" for a in _axes(found[0])]
    writer.writerow(header)
    for run, value in zip(runs, found, strict=True):
        numbers = np.column_stack([*(run.signals[signal] for signal in given), value])
        for i in range(len(run)):
            row: list[Any] = [run.name] * several + [int(run.rows[i])]
            if run.time is not None:
                row.append(f"{float(run.time[i]):.9g}")
            writer.writerow([*row, *(f"{x:.9g}" for x in numbers[i])])
    return text.getvalue()


def _axes(values: Array) -> list[str]:
    size = values.shape[1]
    return [""] if size == 1 else list("xyz") if size == 3 else [str(i) for i in range(size)]


def _bracket(unit: str | None) -> str:
    return f" [{unit}]" if unit and "[" not in unit and unit != "1" else ""


def write_to(output: Path, text: str) -> Path:
    """To a .csv file, or to corrected.csv in a folder; returns which."""
    if output.suffix != ".csv":
        output.mkdir(parents=True, exist_ok=True)
        output = output / "corrected.csv"
    write_atomically(output, text)
    return output
