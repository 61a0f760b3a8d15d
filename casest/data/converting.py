"""The numbers of a signal: cells checked, counts scaled, units converted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest import units as unit_names
from casest.data import attitude, checks
from casest.data.column import BadCell
from casest.data.options import Options
from casest.data.run import Array
from casest.data.scaling import Scale
from casest.data.table import Column, Table
from casest.declaration.symbols import Signal
from casest.errors import DataError, UnitError


def vector(
    table: Table, signal: Signal, names: tuple[str, ...], options: Options
) -> tuple[Array, str | None, list[str]]:
    """Return a plain signal (N, size), its unit, and notes on what was assumed."""
    target, stated = units_of(table, signal, names, options)
    parts = columns_of(table, signal, names, options)
    values = np.stack(parts, axis=1)
    checks.refuse_too_small(table.file, signal.name, values, names)
    notes = [*_overruled(table, signal, names, options), *_missing(table, signal, values, options)]
    if target is not None and None in stated:
        silent = " ".join(n for n, u in zip(names, stated, strict=True) if u is None)
        whole = checks.without_gaps(values)
        with np.errstate(over="ignore"):
            length = np.median(np.linalg.norm(whole, axis=1)) if len(whole) else 0
        size = f"median length {length:.4g}"
        notes.append(
            f"{signal.name}: no unit stated for {silent}, taken as {target} ({size}); "
            f"if that is wrong say --unit {signal.name}=…"
        )
    return values, target, notes


def units_of(
    table: Table, signal: Signal, names: tuple[str, ...], options: Options
) -> tuple[str | None, list[str | None]]:
    """The unit of a plain signal, and what is stated of each column; None where nobody says."""
    stated = [_unit_of(table, table.columns[name], signal.name, options) for name in names]
    target = unit_names.canonical(signal.unit) if signal.unit else next(filter(None, stated), None)
    return target, stated


def columns_of(
    table: Table, signal: Signal, names: tuple[str, ...], options: Options
) -> tuple[Array, ...]:
    """The columns of a plain signal in its unit, (N,) each; nothing is noted on them."""
    target, stated = units_of(table, signal, names, options)
    parts = []
    for name, unit in zip(names, stated, strict=True):
        values = _scaled(table, table.columns[name], signal.name, options)
        if unit is not None and target is not None:
            values = _converted(table, name, signal, values, unit, target, stated)
        parts.append(values)
    return tuple(parts)


def _missing(table: Table, signal: Signal, values: Array, options: Options) -> list[str]:
    """How many readings are missing, where they may be."""
    absent = ~np.isfinite(values)
    count = int(absent.any(axis=1).sum())
    if not count:
        return []
    if absent.all(axis=1).all():
        raise DataError(
            f"{table.file}: signal {signal.name} has no reading in {len(values)} rows; choose its "
            f"columns: --columns {signal.name}=…"
        )
    if signal.name not in options.gaps:
        return []  # those rows are dropped, and said to be
    first = int(np.flatnonzero(absent.any(axis=1))[0])
    return [
        f"{signal.name}: {count} of {len(values)} readings are missing, whole or in part, the "
        f"first in row {first}; what is there is used"
    ]


def _overruled(table: Table, signal: Signal, names: tuple[str, ...], options: Options) -> list[str]:
    """A unit that the user states against the header is followed, and said."""
    notes = []
    for name in names:
        column = table.columns[name]
        stated = options.units.get(name, options.units.get(signal.name))
        known = column.unit is not None and unit_names.known(column.unit)
        if known and stated and unit_names.canonical(column.unit or "") != stated:
            notes.append(f"{name}: the header says {column.unit}, --unit says {stated}: followed")
    return notes


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


def _unit_of(table: Table, column: Column, signal: str, options: Options) -> str | None:
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


def _scale_of(column: str, signal: str | None, options: Options) -> Scale | None:
    return options.scales.get(column) or (options.scales.get(signal) if signal else None)


def numbers(
    table: Table, column: Column, purpose: str, way_out: str, *, gaps: bool = False
) -> Array:
    """Return a column's numbers; raise DataError where one of them is none.

    `gaps`: cells may be empty, and are NaN then.
    """
    if column.is_text:
        text = BadCell(0, str(column.values[0]), 1)
        raise DataError(
            f"{table.file}: column {column.name} {text}, and {purpose} needs numbers; "
            f"choose another column: {way_out}"
        )
    if column.bad is not None and not (gaps and column.bad.blank):
        raise DataError(
            f"{table.file}: column {column.name} {column.bad}, and {purpose} needs finite numbers; "
            f"repair or delete that row, or choose another column: {way_out}"
        )
    return np.asarray(column.values, dtype=np.float64)


def _scaled(table: Table, column: Column, signal: str, options: Options) -> Array:
    # A filter's reading may be missing; what drives it may not, and no row of it is dropped.
    gaps = signal in options.gaps or not options.gaps
    values = numbers(table, column, f"signal {signal}", f"--columns {signal}=…", gaps=gaps)
    scale = _scale_of(column.name, signal, options)
    if scale is not None:
        values = scale.apply(values, table.file, column.name)
    checks.refuse_too_large(table.file, f"signal {signal}", column.name, values)
    return values


def rotation(
    table: Table, signal: Signal, names: tuple[str, ...], options: Options
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
    largest = int(np.argmax(np.nan_to_num(np.abs(values))))
    if abs(values[largest]) > 2 * np.pi * 1.01:
        raise DataError(
            f"{table.file}: column {name} row {largest} holds {values[largest]:g} without a unit, "
            f"too much for rad; say --unit {signal.name}=deg (or rad)"
        )
