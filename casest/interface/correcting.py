"""`corrected = estimate(readings)`: the correction of a fit, on readings of any shape."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np

from casest.correction.carried import Carried
from casest.correction.inverse import LEFT, ONCE, TIMED
from casest.data import load_runs
from casest.data.bind import Frame, Path_
from casest.data.finding import Choice
from casest.data.frames import is_frame
from casest.data.run import Run
from casest.data.table import Table, read_table, table_of
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import CasestError, UsageError
from casest.interface.reading import Reading, stated
from casest.interface.tables import as_frame, headers, like
from casest.interface.words import as_python_says
from casest.results.saved import SavedResult
from casest.saved.apply import beyond, corrected, fitted_unit, with_margin, without

#: Readings: one array of the sensor's readings, a mapping or frame of columns, a file, or runs.
Readings = Array | Frame | Path_ | Run | Sequence[Run]


class Corrects:
    """What is called with readings and returns them corrected."""

    reading: Reading

    @overload
    def __call__(
        self,
        readings: Array,
        *,
        columns: Choice | None = None,
        units: Mapping[str, str] | None = None,
        scales: Mapping[str, str] | None = None,
        rate: float | None = None,
        run: str | None = None,
        force: bool = False,
    ) -> Array: ...

    @overload
    def __call__(
        self,
        readings: Readings,
        *,
        columns: Choice | None = None,
        units: Mapping[str, str] | None = None,
        scales: Mapping[str, str] | None = None,
        rate: float | None = None,
        run: str | None = None,
        force: bool = False,
    ) -> Any: ...

    def __call__(
        self,
        readings: Readings,
        *,
        columns: Choice | None = None,
        units: Mapping[str, str] | None = None,
        scales: Mapping[str, str] | None = None,
        rate: float | None = None,
        run: str | None = None,
        force: bool = False,
    ) -> Any:
        """The corrected quantity of new readings, as what was given: an array (N, size) or a frame.

        Columns and units are those of the fit's data unless they are said (nothing is known of them
        where a saved result was loaded); an array is in the unit of the fit. `run` names the run
        whose correction it is, where they differ; `force` uses an estimate that was refused. A
        warning says where readings leave what the fit saw.
        """
        said = {"columns": columns, "units": units, "scales": scales, "rate": rate}
        with as_python_says():
            result, carried = self._correction(force)
            return corrected_readings(result, carried, readings, kept(self.reading, said), run)

    def _correction(self, force: bool) -> tuple[SavedResult, Carried]:
        raise NotImplementedError


def corrected_readings(
    result: SavedResult, carried: Carried, readings: Readings, reading: Reading, run: str | None
) -> Any:
    """What was given with the corrected quantity in it alone; NaN where a reading is missing."""
    if carried.once and not _was_fitted(result, carried, readings, reading):
        warnings.warn(ONCE + ", ".join(carried.once), stacklevel=3)
        carried = carried.lasting
    program = carried.of_run(_place(result, carried, run))[0]
    needed = _needed(result, carried)
    if isinstance(readings, Run):
        return corrected(program, _of_fit(readings, needed, result))
    if isinstance(readings, list | tuple) and readings and isinstance(readings[0], Run):
        return [corrected(program, _of_fit(one, needed, result)) for one in readings]
    if _bare(readings):
        return _of_array(np.asarray(readings, float), carried, needed, program)
    table = _table(readings)
    runs = _loaded(result, carried, table, reading)
    _warn(carried, runs)
    whole = np.full((table.n_rows, program.output.size), np.nan)
    for one in runs:
        whole[np.asarray(one.rows)] = corrected(program, one)
    if is_frame(readings):
        return like(readings, program.output.name, whole)
    names = headers(program.output.name, whole.shape[1])
    return as_frame(dict(zip(names, whole.T, strict=True)))


def _was_fitted(result: SavedResult, carried: Carried, readings: Any, reading: Reading) -> bool:
    """Are these the samples of the fit, and not those of another record?"""
    if isinstance(readings, Run):
        return carried.was_fitted([readings])
    if isinstance(readings, list | tuple) and readings and isinstance(readings[0], Run):
        return carried.was_fitted(readings)
    if _bare(readings):
        return False
    try:
        return carried.was_fitted(_loaded(result, carried, _table(readings), reading))
    except CasestError:  # it has not what the correction of the fitted record needs
        return False


def _needed(result: SavedResult, carried: Carried) -> list[Signal]:
    """What the correction reads, in the units of the fit."""
    return [replace(s, unit=s.unit or fitted_unit(result, s)) for s in carried.needed]


def _loaded(
    result: SavedResult, carried: Carried, table: Table, reading: Reading
) -> tuple[Run, ...]:
    """The runs of a table, with what the correction reads."""
    needed = _needed(result, carried)
    spare = {s.name for s in carried.signals} - {s.name for s in needed}
    return load_runs(table, needed, **without(spare, {**stated(reading), "at_rest": False}))


def _table(readings: Any) -> Table:
    if is_frame(readings):
        return table_of(readings, type(readings).__name__)
    if isinstance(readings, str | os.PathLike):
        return read_table(readings)
    raise UsageError(
        f"the readings are of type {type(readings).__name__}: give an array, a data frame, a "
        "mapping of columns or a file"
    )


def _bare(readings: Any) -> bool:
    """Numbers alone: an array, or lists of numbers."""
    if isinstance(readings, np.ndarray):
        return not readings.dtype.names
    return isinstance(readings, list | tuple | float | int)


def _of_array(values: Array, carried: Carried, needed: Sequence[Signal], program: Any) -> Array:
    """Readings of the one signal that the correction reads: (N, size), or one reading (size,)."""
    if len(needed) != 1:
        names = ", ".join(f"'{s.name}': …" for s in needed)
        raise UsageError(f"the correction reads {len(needed)} signals: give {{{names}}}")
    size = needed[0].size
    rows = values.reshape(-1, size) if size == 1 or values.shape == (size,) else values
    if rows.ndim != 2 or rows.shape[1] != size:
        raise UsageError(
            f"the readings have shape {values.shape}; of {needed[0].name} they are (N, {size}), or "
            f"({size},) for one"
        )
    run = Run.raw("readings", {needed[0].name: rows}, units={}, file="readings")
    there = np.asarray(np.isfinite(rows).all(axis=1))
    found = np.full((len(rows), program.output.size), np.nan)
    if there.any():
        found[there] = corrected(program, run.take(there))
        _warn(carried, [run.take(there)], beneath=5)
    return found.reshape(values.shape) if found.size == values.size else found


def _of_fit(run: Run, needed: Sequence[Signal], result: SavedResult) -> Run:
    """The run, if it has the signals in the units of the fit."""
    for s in needed:
        if s.name not in run.signals:
            raise UsageError(f"{run.name}: has no signal {s.name}, which the correction reads")
        unit, fitted = run.units.get(s.name), result.units.get(s.name)
        if unit and fitted and "[" not in fitted and unit != fitted:
            raise UsageError(
                f"{run.name}: {s.name} is in {unit}, and was in {fitted} in the fit; load it with "
                f"signal({s.size}, {fitted!r}), or give the file or frame"
            )
    return run


def _place(result: SavedResult, carried: Carried, run: str | None) -> int:
    """Which run's correction: that of `run`, the only one, or one for all."""
    if not carried.own:
        return 0
    if run in result.runs:
        return result.runs.index(run)
    names = ", ".join(repr(name) for name in result.runs)
    raise UsageError(f"the correction differs from run to run: say run=… ({names})")


def _warn(carried: Carried, runs: Sequence[Run], beneath: int = 4) -> None:
    """Where the readings leave what the fit saw, and what the correction leaves in them.

    The caller is `beneath` as many calls.
    """
    said = list(beyond(carried.program, with_margin(carried), runs))
    if carried.program.left:
        said.append(LEFT + ", ".join(carried.program.left))
    if timed := [name for name in carried.timed if name not in carried.once]:
        said.append(TIMED + ", ".join(timed))
    for text in said:
        warnings.warn(text, stacklevel=beneath)


def kept(reading: Mapping[str, Any], given: Mapping[str, Any]) -> Any:
    """How readings are read: as the fit's data were, but for what is said now."""
    return {**reading, **{name: value for name, value in given.items() if value is not None}}
