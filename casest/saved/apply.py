"""`casest apply`: a saved result on new data, column by column."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from casest.correction import runtime
from casest.correction.carried import Carried
from casest.correction.inverse import ONCE
from casest.correction.numpy_module import as_data
from casest.correction.program import Program
from casest.correction.spread import PARTS
from casest.data import load_runs
from casest.data.run import Run
from casest.data.write import make_folder, write_atomically
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import DataError, UsageError
from casest.results.saved import SavedResult, saved_correction
from casest.results.written import corrected_file

#: Samples corrected at once, and numbers held for them: memory does not grow with the record.
PIECE, HELD = 4096, 2**24
#: Share of what the calibration saw by which a reading may leave it without a remark: noise, and
#: poses that are not the extreme ones, do. Ranges that are named in one.
MARGIN, SAID = 0.1, 3


class Applied(NamedTuple):
    """CSV with time, the readings and the corrected readings, units in the header.

    Beside it the effects that are `left` in the readings (see `invertible`), and `remarks`: how
    the data were read, and where they leave what the calibration saw.
    """

    text: str
    left: tuple[str, ...]
    remarks: tuple[str, ...]


def corrected_csv(
    path: Path,
    data: str,
    arguments: Mapping[str, Any],
    *,
    force: bool = False,
    std: bool = False,
) -> Applied:
    """The data corrected as the result says; with `std`, the standard deviations beside.

    The correction is the one that the result carries: nothing of the model's source is run.
    Readings are converted to the unit that they had in the fit, or refused.
    """
    result, carried = saved_correction(path, force=force, what="applies")
    remarks: tuple[str, ...] = ()
    if carried.once and not _was_fitted(result, data):
        carried, remarks = carried.lasting, (f"{ONCE}{', '.join(carried.once)}",)
    program = carried.of_run(_run_number(carried, result, data))[0]
    spare = {s.name for s in carried.signals} - {s.name for s in carried.needed}
    needed = [s if s.unit else replace(s, unit=fitted_unit(result, s)) for s in carried.needed]
    runs = load_runs([data], needed, **without(spare, arguments))
    found = [corrected(program, run) for run in runs]
    unit = result.units.get(program.output.name)
    pairs = zip(runs, found, strict=True) if std else ()
    spreads = [stds(carried.spread, program, run, value) for run, value in pairs]
    text = table_of(runs, [s.name for s in needed], found, program.output.name, unit, spreads)
    notes = dict.fromkeys(note for run in runs for note in run.notes)
    far = () if _was_fitted(result, data) else extrapolated(carried, runs)
    return Applied(text, program.left, (*notes, *remarks, *of_units(result, runs, data), *far))


def fitted_unit(result: SavedResult, signal: Signal) -> str | None:
    """The unit that a signal had in the fit; None where nobody knew it, so that any will do."""
    stated = result.units.get(signal.name, "")
    return stated if stated and "[" not in stated and signal.kind == "plain" else None


def of_units(result: SavedResult, runs: Sequence[Run], data: str) -> Iterator[str]:
    """That a unit cannot be compared with that of the fit, which nobody stated."""
    for name, unit in runs[0].units.items():
        if unit and result.units.get(name) == f"[{name}]":
            yield (
                f"{data}: {name} is in {unit}; nobody stated the unit of {name} when the result "
                "was made, and it is taken to be the same: calibrate again with --unit to be sure"
            )


def extrapolated(carried: Carried, runs: Sequence[Run]) -> Iterator[str]:
    """How many samples lie outside what the calibration saw, and in which numbers."""
    return beyond(carried.program, with_margin(carried), runs)


def with_margin(carried: Carried) -> tuple[tuple[float, float] | None, ...]:
    """Least and greatest of each number of a sample that need no remark; None of a time or a
    rotation. Empty where an older result does not say."""
    if not carried.seen:
        return ()
    kinds = [i for i in carried.program.inputs for _ in range(i.size)]
    found: list[tuple[float, float] | None] = []
    for i, (low, high) in zip(kinds, carried.seen, strict=True):
        margin = MARGIN * (high - low) + 1e-9 * max(abs(low), abs(high))
        judged = i.kind != "rotation" and i.name != "t"  # of time, `of_another_time` speaks
        found.append((low - margin, high + margin) if judged else None)
    return tuple(found)


def beyond(
    program: Program, allowed: Sequence[tuple[float, float] | None], runs: Sequence[Run]
) -> Iterator[str]:
    """How many samples lie outside the ranges `allowed`, and in which numbers."""
    if len(allowed) != program.width:
        return
    place, far, said = 0, [np.zeros(len(run), dtype=bool) for run in runs], []
    for i in program.inputs:
        own = allowed[place : place + i.size]
        place += i.size
        for k, (axis, ends) in enumerate(zip(axes(i.size), own, strict=True)):
            if ends is None:
                continue
            low, high = ends
            parts = [run.signals[i.name][:, k] for run in runs]
            outside = [(x < low) | (x > high) for x in parts]
            if any(o.any() for o in outside):
                far = [f | o for f, o in zip(far, outside, strict=True)]
                least, most = min(x.min() for x in parts), max(x.max() for x in parts)
                inner = MARGIN / (1 + 2 * MARGIN) * (high - low)
                seen = f"{low + inner:.4g} to {high - inner:.4g}"
                said.append(f"{i.name}{axis} {least:.4g} to {most:.4g} ({seen})")
    if said:
        count, rows = sum(int(f.sum()) for f in far), sum(map(len, runs))
        more = f" and {len(said) - SAID} more" if len(said) > SAID else ""
        yield (
            f"{count} of {rows} rows lie outside what the calibration saw, in brackets: "
            f"{', '.join(said[:SAID])}{more}; there the correction extrapolates"
        )


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


def stds(spread: Program | None, program: Program, run: Run, found: Array) -> Array:
    """Standard deviations (N, 4·size) of corrected values: see `correction.spread.PARTS`."""
    x = np.hstack([np.asarray(run.signals[i.name], dtype=float) for i in program.inputs])
    steps = as_data(required(spread))
    return np.asarray(runtime.attempted(steps, np.hstack([x, found])), dtype=float)


def required(spread: Program | None) -> Program:
    """What gives standard deviations, which are asked for."""
    if spread is None:
        raise UsageError(
            "there are no standard deviations of corrected readings: an older casest made the "
            "result, it was exported without --with-std, or its correction differs from run to run"
        )
    return spread


def of_another_time(path: Path, data: str | None = None) -> tuple[str, ...]:
    """Effects that follow the time of the fitted record, unless it is that record again."""
    result, carried = saved_correction(path, force=True, what="reads")
    return () if data is not None and _was_fitted(result, data) else carried.lasting.timed


def left_out(path: Path) -> tuple[str, ...]:
    """Effects that happened in the fitted record alone: any other is corrected otherwise."""
    return saved_correction(path, force=True, what="reads")[1].once


def _was_fitted(result: SavedResult, data: str) -> bool:
    return Path(data).resolve() in {Path(d).resolve() for d in result.data}


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


def table_of(
    runs: Sequence[Run],
    given: Sequence[str],
    found: Sequence[Array],
    name: str,
    unit: str | None,
    spreads: Sequence[Array] = (),
) -> str:
    """CSV of row, time, the `given` signals and what was `found`, called `name`, in each run.

    Behind it `spreads`, its standard deviations together, and by each of their PARTS.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    first, several = runs[0], len(runs) > 1
    given = [signal for signal in given if signal != "t" or first.time is None]
    header = ["run"] * several + ["row"] + ["t [s]"] * (first.time is not None)
    for signal in given:
        own = bracket(first.units.get(signal))
        header += [f"{signal}{a}{own}" for a in axes(first.signals[signal].shape[1])]
    header += [f"{name}{'_' * bool(a)}{a}{bracket(unit)}" for a in axes(found[0].shape[1])]
    if spreads:
        found = [np.hstack([f, _together_first(s)]) for f, s in zip(found, spreads, strict=True)]
        labels = [f"_{part}" for part in PARTS[:-1]]
        size = spreads[0].shape[1] // len(PARTS)
        ends = [p + "_" * bool(a) + a for p in ("", *labels) for a in axes(size)]
        header += [f"{name}_std{end}{bracket(unit)}" for end in ends]
    writer.writerow(header)
    for run, value in zip(runs, found, strict=True):
        numbers = np.column_stack([*(run.signals[signal] for signal in given), value])
        for i in range(len(run)):
            row: list[Any] = [run.name] * several + [int(run.rows[i])]
            if run.time is not None:
                row.append(f"{float(run.time[i]):.9g}")
            writer.writerow([*row, *(f"{x:.9g}" for x in numbers[i])])
    return text.getvalue()


def _together_first(spread: Array) -> Array:
    size = spread.shape[1] // len(PARTS)
    return np.hstack([spread[:, -size:], spread[:, :-size]])


def axes(size: int) -> list[str]:
    """What follows a signal's name in a header, for each of its numbers."""
    return [""] if size == 1 else list("xyz") if size == 3 else [str(i) for i in range(size)]


def bracket(unit: str | None) -> str:
    """A unit as it stands behind a name in a header."""
    return f" [{unit}]" if unit and "[" not in unit and unit != "1" else ""


def write_to(output: Path, text: str) -> Path:
    """To a .csv file, or to corrected.csv in a folder; returns which."""
    output = corrected_file(output)
    make_folder(output.parent)
    write_atomically(output, text)
    return output
