"""From files to runs: columns matched to a model's signals, units converted, rows grouped."""

from __future__ import annotations

import difflib
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from casest import units as unit_names
from casest.data import attitude, checks, timing
from casest.data.finding import Choice, as_names, find_by_name, find_column, find_columns
from casest.data.rest import at_rest as averaged_at_rest
from casest.data.run import Array, Labels, Run
from casest.data.scaling import Scale, parse_scale
from casest.data.table import Column, Table, read_table
from casest.declaring.symbols import Signal
from casest.errors import DataError, UnitError, UsageError

Path_ = str | os.PathLike[str]


@dataclass(frozen=True)
class _Options:
    columns: Choice
    units: Mapping[str, str]
    scales: Mapping[str, Scale]
    rate: float | None
    time_zero: Literal["first", "column"]
    extra: tuple[str, ...]


@dataclass(frozen=True)
class _Bound:
    """One table matched to the signals, before its rows are grouped; all arrays have its length."""

    signals: dict[str, Array]
    units: dict[str, str | None]
    sources: dict[str, tuple[str, ...]]
    time: Array | None
    time_source: str | None
    notes: list[str]


def load_runs(
    paths: Sequence[Path_] | Path_,
    signals: Mapping[str, Signal] | Iterable[Signal],
    *,
    columns: Choice | None = None,
    units: Mapping[str, str] | None = None,
    scales: Mapping[str, str] | None = None,
    rate: float | None = None,
    at_rest: bool | Sequence[str] = False,
    extra: Sequence[str] = (),
    time_zero: Literal["first", "column"] = "first",
) -> tuple[Run, ...]:
    """Read files and bind their columns to `signals`: one run per file and `run` label.

    columns: per signal its columns by name or position, {"v": ("ax", "ay", "az")}; also
        "t", "run" and "pose" where those columns are called otherwise.
    units: per signal or column the unit of its values, where the file states none or a wrong one.
    scales: per signal or column how raw counts become values, {"temp": "int16/256+25"}.
    rate: samples per second, instead of a time column or a rate stated above the table.
    at_rest: average the rest intervals; names of further columns that must be at rest too.
    extra: columns that must be there and hold numbers throughout.
    time_zero: "first" makes each run's first sample t = 0, "column" keeps the column's own zero.

    Raises DataError, UnitError or UsageError naming file, column, row, value and the way out.
    """
    wanted = tuple(signals.values() if isinstance(signals, Mapping) else signals)
    listed = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not listed:
        raise UsageError("no data file given; name at least one")
    options = _Options(
        dict(columns or {}),
        {name: _stated_unit(name, unit) for name, unit in (units or {}).items()},
        {name: parse_scale(text) for name, text in (scales or {}).items()},
        None if rate is None else timing.checked_rate(rate),
        time_zero,
        tuple(extra),
    )
    tables = [read_table(path) for path in listed]
    _refuse_unknown_names(tables, wanted, options)
    runs = [run for table in tables for run in _runs(table, wanted, options)]
    runs = _named_apart(runs)
    if at_rest is not False:
        also = () if at_rest is True else tuple(at_rest)
        runs = [averaged_at_rest(run, also=also) for run in runs]
    return tuple(runs)


def _stated_unit(name: str, unit: str) -> str:
    try:
        return unit_names.canonical(unit)
    except UnitError as error:
        raise UnitError(f"--unit {name}={unit}: {error}") from error


def _refuse_unknown_names(
    tables: Sequence[Table], signals: Sequence[Signal], options: _Options
) -> None:
    """Refuse an option for a signal or column that exists nowhere: a typing error."""
    names = [s.name for s in signals]
    headers = [name for table in tables for name in table.columns]
    for option, given, allowed in (
        ("columns", options.columns, [*names, "t", "run", "pose"]),
        ("unit", options.units, [*names, "t", *headers]),
        ("scale", options.scales, [*names, *headers]),
    ):
        for name in given:
            if name in allowed:
                continue
            if option != "columns" and any(find_by_name(table, name) for table in tables):
                continue
            near = difflib.get_close_matches(name, allowed, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(allowed[:12])}"
            raise UsageError(f"--{option} {name}=…: no signal or column {name}; {hint}")


def _runs(table: Table, signals: Sequence[Signal], options: _Options) -> list[Run]:
    """Bind one table and cut it into its runs."""
    bound = _bind(table, signals, options)
    groups = {kind: _group(table, kind, options) for kind in ("run", "pose")}
    sources = {name for names in bound.sources.values() for name in names}
    sources |= {name for name in (bound.time_source, *groups.values()) if name}
    others, other_units, notes = _others(table, sources, options)
    labels = _labels(table, groups["run"])
    pose = _labels(table, groups["pose"])
    stem = Path(table.file).stem
    runs = []
    for label in [None] if labels is None else _in_order(labels):
        rows = np.arange(table.n_rows) if labels is None else np.flatnonzero(labels == label)
        part = {name: values[rows] for name, values in bound.signals.items()}
        time, time_notes = _run_time(table, bound, rows, signals, options)
        run = Run(
            name=stem if label is None else f"{stem}:{label}",
            file=table.file,
            signals=_with_time(part, time, signals),
            units=bound.units | _time_unit(signals),
            columns={name: values[rows] for name, values in others.items()},
            column_units=other_units,
            time=time,
            rows=rows,
            block=timing.blocks(time, None if pose is None else pose[rows], len(rows)),
            count=np.ones(len(rows), dtype=np.int_),
            spread={},
            notes=(*table.notes, *bound.notes, *notes, *time_notes),
        )
        runs.append(_checked(run, signals, bound.sources))
    return runs


def _bind(table: Table, signals: Sequence[Signal], options: _Options) -> _Bound:
    """Find, scale and convert the columns of every signal but time."""
    found = _Bound({}, {}, {}, None, None, [])
    for signal in signals:
        if _is_time(signal):
            continue
        names = find_columns(table, signal, options.columns)
        found.sources[signal.name] = names
        if signal.kind == "rotation":
            values, notes = _rotation(table, signal, names, options)
            found.units[signal.name] = None
        else:
            values, unit, notes = _vector(table, signal, names, options)
            found.units[signal.name] = unit
        found.signals[signal.name] = values
        found.notes.extend(notes)
    for name in options.extra:
        column = table.columns[find_column(table, name, "the model")]
        _numbers(table, column, f"column {name}", f"--columns {name}=…")
    return _with_time_column(table, signals, options, found)


def _is_time(signal: Signal) -> bool:
    return signal.name == "t" and signal.size == 1 and signal.kind == "plain"


def _vector(
    table: Table, signal: Signal, names: tuple[str, ...], options: _Options
) -> tuple[Array, str | None, list[str]]:
    """Return a plain signal (N, size), its unit, and notes on what was assumed."""
    stated = [_unit_of(table, table.columns[name], signal.name, options) for name in names]
    target = unit_names.canonical(signal.unit) if signal.unit else next(filter(None, stated), None)
    parts = []
    for name, unit in zip(names, stated, strict=True):
        values = _scaled(table, table.columns[name], signal.name, options)
        if unit is not None and target is not None:
            values = _converted(table, name, signal, values, unit, target, stated)
        parts.append(values)
    values = np.stack(parts, axis=1)
    notes = []
    if target is not None and None in stated:
        silent = " ".join(n for n, u in zip(names, stated, strict=True) if u is None)
        size = f"median length {np.median(np.linalg.norm(values, axis=1)):.4g}"
        notes.append(
            f"{signal.name}: no unit stated for {silent}, taken as {target} ({size}); "
            f"if that is wrong say --unit {signal.name}=…"
        )
    return values, target, notes


def _converted(
    table: Table,
    name: str,
    signal: Signal,
    values: Array,
    unit: str,
    target: str,
    stated: Sequence[str | None],
) -> Array:
    try:
        factor, offset = unit_names.conversion(unit, target)
    except UnitError as error:
        wants = f"signal {signal.name} wants {target}" if signal.unit else f"its axes mix {stated}"
        raise UnitError(
            f"{table.file}: column {name} is in {unit} and {wants}: {error}; "
            f"say --unit {signal.name}=… if the file is wrong, or choose other columns"
        ) from error
    return values if (factor, offset) == (1.0, 0.0) else factor * values + offset


def _unit_of(table: Table, column: Column, signal: str, options: _Options) -> str | None:
    """Return the unit of a column: as the user states it, else the header; None if silent."""
    for name in (column.name, signal):
        if name in options.units:
            return options.units[name]
    if column.unit is None:
        return None
    try:
        unit = unit_names.canonical(column.unit)
    except UnitError as error:
        raise UnitError(
            f"{table.file}: column {column.name}: {error} (or state it: --unit {signal}=…)"
        ) from error
    scaled = _scale_of(column.name, signal, options) is not None
    return None if unit == "count" and scaled else unit  # after scaling they are counts no more


def _scale_of(column: str, signal: str | None, options: _Options) -> Scale | None:
    return options.scales.get(column) or (options.scales.get(signal) if signal else None)


def _numbers(table: Table, column: Column, purpose: str, way_out: str) -> Array:
    """Return a column's numbers; raise DataError where one of them is none."""
    if column.is_text:
        raise DataError(
            f"{table.file}: column {column.name} row 0 holds '{column.values[0]}', and {purpose} "
            f"needs numbers; choose another column: {way_out}"
        )
    if column.bad is not None:
        raise DataError(
            f"{table.file}: column {column.name} {column.bad}, and {purpose} needs finite numbers; "
            f"repair or delete that row, or choose another column: {way_out}"
        )
    return np.asarray(column.values, dtype=np.float64)


def _scaled(table: Table, column: Column, signal: str, options: _Options) -> Array:
    values = _numbers(table, column, f"signal {signal}", f"--columns {signal}=…")
    scale = _scale_of(column.name, signal, options)
    return values if scale is None else scale.apply(values, table.file, column.name)


def _rotation(
    table: Table, signal: Signal, names: tuple[str, ...], options: _Options
) -> tuple[Array, list[str]]:
    """Return a rotation signal (N, 9), body to reference frame, row by row."""
    parts = [_scaled(table, table.columns[name], signal.name, options) for name in names]
    values = np.stack(parts, axis=1)
    if len(names) == 4:
        return attitude.from_quaternions(values, table.file, names), []
    if len(names) == 9:
        return attitude.from_matrices(values, table.file, names), []
    notes = []
    for i, name in enumerate(names):
        unit = _unit_of(table, table.columns[name], signal.name, options)
        if unit is None:
            _refuse_degrees(table, signal, name, values[:, i])
            notes.append(f"{name}: no unit stated, taken as rad")
        else:
            values[:, i] = _converted(table, name, signal, values[:, i], unit, "rad", (unit, "rad"))
    return attitude.from_angles(values), notes


def _refuse_degrees(table: Table, signal: Signal, name: str, values: Array) -> None:
    largest = int(np.argmax(np.abs(values)))
    if abs(values[largest]) > 2 * np.pi * 1.01:
        raise DataError(
            f"{table.file}: column {name} row {largest} holds {values[largest]:g} without a unit, "
            f"too much for rad; say --unit {signal.name}=deg (or rad)"
        )


def _with_time_column(
    table: Table, signals: Sequence[Signal], options: _Options, found: _Bound
) -> _Bound:
    """Add the time column in s, where there is one and no rate is given."""
    needed = any(_is_time(signal) for signal in signals)
    chosen = None
    if "t" in options.columns:
        names = as_names(options.columns["t"])
        if len(names) != 1:
            raise DataError(f"{table.file}: --columns t={','.join(names)} must name one column")
        chosen = find_column(table, names[0], "time")
    name = timing.find_time(table, chosen)
    if name is None or name in {n for names in found.sources.values() for n in names}:
        return found
    if options.rate is not None:
        found.notes.append(f"time column {name} not used: rate {options.rate:g} Hz is given")
        return replace(found, time_source=name)
    column = table.columns[name]
    try:
        if not column.is_text:
            _numbers(table, column, "time", "--columns t=… or --rate HZ")
        time, note = timing.seconds(table, column, timing.time_units_declared(options.units, name))
    except UnitError as error:
        raise UnitError(f"{table.file}: column {name} as time: {error}; --unit t=ms") from error
    except DataError as error:
        if needed or chosen:
            raise
        found.notes.append(f"time not used: {error}")
        return replace(found, time_source=name)
    found.notes.extend([note] if note else [])
    return replace(found, time=time, time_source=name)


def _run_time(
    table: Table,
    bound: _Bound,
    rows: NDArray[np.int_],
    signals: Sequence[Signal],
    options: _Options,
) -> tuple[Array | None, list[str]]:
    """Return the time of one run in s, (N,), and notes; None where nothing tells it."""
    needed = any(_is_time(signal) for signal in signals)
    if bound.time is not None:
        return _from_column(table, bound, rows, needed, options)
    if options.rate is not None:
        return np.arange(len(rows)) / options.rate, []
    if stated := timing.rate_in_preamble(table):
        entry, rate = stated
        return np.arange(len(rows)) / rate, [f"time from the entry '{entry}': {rate:g} Hz"]
    if needed:
        listed = ", ".join(list(table.columns)[:12])
        raise DataError(
            f"{table.file}: no time column (t, time, timestamp) for signal t; the file has "
            f"{listed}; give --rate HZ or --columns t=NAME"
        )
    return None, []


def _from_column(
    table: Table, bound: _Bound, rows: NDArray[np.int_], needed: bool, options: _Options
) -> tuple[Array | None, list[str]]:
    assert bound.time is not None
    time = bound.time[rows]
    try:
        timing.refuse_unordered(table.file, str(bound.time_source), time, rows)
    except DataError as error:
        if needed:
            raise
        return None, [f"time not used: {error}"]
    if options.time_zero == "column" or time[0] == 0.0:
        return time, []
    return time - time[0], [f"time starts at {time[0]:.9g} s; that sample is t = 0"]


def _with_time(
    signals: dict[str, Array], time: Array | None, wanted: Sequence[Signal]
) -> dict[str, Array]:
    """Put the time signal in, in the order in which the model declares its signals."""
    ordered: dict[str, Array] = {}
    for signal in wanted:
        if not _is_time(signal):
            ordered[signal.name] = signals[signal.name]
        elif time is not None:
            factor, _ = unit_names.conversion("s", signal.unit or "s")
            ordered[signal.name] = (time * factor)[:, None]
    return ordered


def _time_unit(signals: Sequence[Signal]) -> dict[str, str | None]:
    return {s.name: unit_names.canonical(s.unit or "s") for s in signals if _is_time(s)}


def _group(table: Table, kind: str, options: _Options) -> str | None:
    """Return the column that groups rows into runs or poses."""
    if kind in options.columns:
        return find_column(table, as_names(options.columns[kind])[0], f"group {kind}")
    return find_by_name(table, kind)


def _labels(table: Table, name: str | None) -> Array | Labels | None:
    if name is None:
        return None
    column = table.columns[name]
    if column.bad is not None:
        raise DataError(f"{table.file}: column {name} {column.bad}; every row needs its {name}")
    return column.values


def _in_order(labels: Array | Labels) -> list[float | int | str]:
    _, first = np.unique(labels, return_index=True)
    found = labels[np.sort(first)].tolist()
    # a run called 1, not 1.0
    return [int(x) if isinstance(x, float) and x.is_integer() else x for x in found]


def _others(
    table: Table, used: set[str], options: _Options
) -> tuple[dict[str, Array | Labels], dict[str, str | None], list[str]]:
    """Return the columns that no signal takes: each may be the cause of a residual."""
    columns: dict[str, Array | Labels] = {}
    units: dict[str, str | None] = {}
    notes = []
    for name, column in table.columns.items():
        if name in used:
            continue
        if column.bad is not None:
            notes.append(f"column {name} left out: {column.bad}")
            continue
        values, unit = column.values, options.units.get(name, column.unit)
        if name in options.scales:
            values = options.scales[name].apply(np.asarray(values, float), table.file, name)
            unit = None if unit == column.unit and unit in ("count", "raw", "LSB") else unit
        columns[name] = values
        units[name] = unit_names.canonical(unit) if unit and unit_names.known(unit) else None
    return columns, units, notes


def _checked(run: Run, signals: Sequence[Signal], sources: Mapping[str, tuple[str, ...]]) -> Run:
    """Refuse signals that never change; note components that are dead or clipped."""
    notes: list[str] = []
    for signal in signals:
        if _is_time(signal) or signal.kind == "rotation":
            continue
        values, columns = run.signals[signal.name], sources[signal.name]
        checks.refuse_constant(run.file, signal.name, values, columns)
        notes += checks.constant_columns(values, columns) + checks.clipped(values, columns)
    return replace(run, notes=(*run.notes, *notes))


def _named_apart(runs: Sequence[Run]) -> list[Run]:
    """Give runs of the same name (imu.csv in two folders) a number."""
    total, seen = Counter(run.name for run in runs), Counter[str]()
    named = []
    for run in runs:
        seen[run.name] += 1
        name = run.name if total[run.name] == 1 else f"{run.name}#{seen[run.name]}"
        named.append(replace(run, name=name))
    return named
