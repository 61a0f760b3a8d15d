"""`casest apply`: a saved result on new data, column by column."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from casest.correction import runtime
from casest.correction.carried import Carried
from casest.correction.numpy_module import as_data
from casest.correction.program import Program
from casest.data import load_runs
from casest.data.run import Run
from casest.data.write import write_atomically
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.results.saved import SavedResult, saved_correction
from casest.results.written import corrected_file

#: Samples corrected at once, and numbers held for them: memory does not grow with the record.
PIECE, HELD = 4096, 2**24


def corrected_csv(
    path: Path, data: str, arguments: Mapping[str, Any], *, force: bool = False
) -> tuple[str, tuple[str, ...]]:
    """CSV with time, the readings and the corrected readings, units in the header.

    Beside it the effects that are left in the readings (see `invertible`). The correction is the
    one that the result carries: nothing of the model's source is run.
    """
    result, carried = saved_correction(path, force=force, what="applies")
    program = carried.of_run(_run_number(carried, result, data))[0]
    spare = {s.name for s in carried.signals} - {s.name for s in carried.needed}
    runs = load_runs([data], carried.needed, **without(spare, arguments))
    _same_units(result, runs, data)
    found = [corrected(program, run) for run in runs]
    unit = result.units.get(program.output.name)
    given = [s.name for s in carried.needed]
    return table_of(runs, given, found, program.output.name, unit), program.left


def corrected(program: Program, run: Run) -> Array:
    """The corrected quantity of every sample, (N, size); DataError names the row without any."""
    steps, names = as_data(program), [i.name for i in program.inputs]
    x = np.hstack([np.asarray(run.signals[name], dtype=float) for name in names])
    rows = max(1, min(PIECE, HELD // max(1, program.registers)))
    pieces = [runtime.attempted(steps, x[k : k + rows]) for k in range(0, len(x), rows)]
    found: Array = np.vstack(pieces)
    bad = np.flatnonzero(~np.isfinite(found).all(axis=1))
    if bad.size:
        at, size = program.measured or (0, program.width)
        row = int(bad[0])
        value = np.array2string(x[row, at : at + size], precision=6)
        raise DataError(
            f"{run.file}: row {int(run.rows[row])}: reading {value} has no {program.output.name} "
            f"in the model ({bad.size} of {len(run)} rows): it lies outside what the model "
            "can produce; remove the rows, or calibrate over a wider range"
        )
    return found


def of_another_time(path: Path, data: str | None = None) -> tuple[str, ...]:
    """Effects that follow the time of the fitted record, unless it is that record again."""
    result, carried = saved_correction(path, force=True, what="reads")
    if data is not None and Path(data).resolve() in {Path(d).resolve() for d in result.data}:
        return ()
    return carried.timed


def without(spare: Iterable[str], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the fit may be typed again: those of signals that are not needed fall away."""
    kept, away = dict(arguments), set(spare)
    for option in ("columns", "units", "scales"):
        given = arguments.get(option) or {}
        kept[option] = {name: value for name, value in given.items() if name not in away}
    return kept


def _run_number(carried: Carried, result: SavedResult, data: str) -> int:
    """Which fitted run the data are: matters where the correction differs from run to run."""
    if not carried.own:
        return 0
    files = [Path(name).resolve() for name in result.data]
    if len(files) == len(result.runs) and Path(data).resolve() in files:
        return files.index(Path(data).resolve())
    name = next((n for n, scope in result.scopes.items() if scope == "run"), "a parameter")
    raise UsageError(
        f"{name} differs from run to run, and {data} is none of the fitted files; calibrate with "
        f"--shared {name} to apply the result to new data"
    )


def _same_units(result: SavedResult, runs: tuple[Run, ...], data: str) -> None:
    for name, unit in runs[0].units.items():
        fitted = result.units.get(name)
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
    output = corrected_file(output)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{output.parent}: cannot be made ({error.strerror})") from None
    write_atomically(output, text)
    return output
