"""What the columns of a data set are: the sensor's name, its readings, what else is kept of it.

One row for each sensor, its readings as lists; or in long form one row for each reading, the rows
of a sensor together. Which of the two it is, the columns of the model's signals say: lists of
numbers (or of vectors), or plain numbers (or vectors).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.data import timing
from casest.data.column import Column, name_and_unit, numeric_column
from casest.data.converting import columns_of, units_of
from casest.data.finding import find_column, find_columns
from casest.data.matching import find_by_name, listed
from casest.data.options import Options, refuse_unknown_names
from casest.data.table import Table
from casest.dataset.files import File
from casest.dataset.names import plain
from casest.declaration.symbols import Signal
from casest.errors import DataError

_NUMBER = r"u?int\d+|float|double|halffloat"
_LIST = r"(?:large_|fixed_size_)?list<\w+: "
#: A number; a list of numbers; a list of vectors.
_SCALAR = re.compile(rf"(?:{_NUMBER})$")
_VECTOR = re.compile(rf"{_LIST}(?:{_NUMBER})(?: not null)?>(?:\[(\d+)\])?$")
_VECTORS = re.compile(rf"{_LIST}{_LIST}(?:{_NUMBER})(?: not null)?>(?:\[(\d+)\])?(?: not null)?>")


_Columns = tuple[tuple[str, tuple[str, ...]], ...]
_Units = tuple[tuple[str, str | None], ...]


@dataclass(frozen=True)
class Readings:
    """A column of readings: its name in the file, its header with unit, numbers in each reading.

    `size` is 0 for a plain number, which is no vector.
    """

    field: str
    header: str
    size: int

    @property
    def headers(self) -> list[str]:
        """Headers of its numbers, as a table has them."""
        if not self.size:
            return [self.header]
        name, unit = name_and_unit(self.header)
        return [f"{name}[{k}]" + (f" [{unit}]" if unit else "") for k in range(self.size)]


@dataclass(frozen=True)
class Layout:
    """`sensor`: the column of names; `wide`: one row for each sensor; `readings`: columns used.

    `named_by_folder`: the name is that of the folder; `signals`: for each the headers' columns;
    `time`: the column of the time, if the model needs it; `kept`: columns that go to the results.
    """

    sensor: str
    wide: bool
    readings: tuple[Readings, ...]
    signals: tuple[tuple[str, tuple[str, ...]], ...]
    time: str | None
    kept: tuple[str, ...]
    named_by_folder: bool
    #: Type and unit of each column used, which all files must share.
    kinds: tuple[tuple[str, str], ...]
    #: Unit of each signal, None where nobody says.
    units: tuple[tuple[str, str | None], ...]
    #: Arrow types of the name and of what is kept, as results have them.
    types: tuple[Any, ...]

    @property
    def columns(self) -> list[str]:
        """Columns that are read."""
        named = [] if self.named_by_folder else [self.sensor]
        return [*named, *(r.field for r in self.readings), *self.kept]


def is_time(signal: Signal) -> bool:
    """Is it the time of a sample?"""
    return signal.name == "t" and signal.size == 1 and signal.kind == "plain"


def layout_of(
    file: File,
    table: Any,
    signals: Sequence[Signal],
    options: Options,
    *,
    sensor: str = "sensor",
    kept: Sequence[str] = (),
) -> Layout:
    """The layout of an open Parquet file. Raises DataError where a column is missing."""
    schema = table.schema_arrow
    by_folder = sensor not in schema.names and file.folder_value(sensor) is not None
    if not by_folder:
        sensor = _found(file, schema, sensor)
    kept = tuple(_kept(file, schema, name) for name in kept)
    others = [entry for entry in schema if entry.name not in (sensor, *kept)]
    errors: list[DataError] = []
    for wide in (True, False):
        readings = [r for r in (_readings(table, entry, wide) for entry in others) if r]
        if not readings:
            continue
        try:
            bound, units, time, used = _bound(file, readings, signals, options)
        except DataError as error:
            errors.append(error)
            continue
        names = [] if by_folder else [sensor]
        fields = [*names, *(r.field for r in used), *kept]
        kinds = tuple((name, _kind(schema.field(name))) for name in fields)
        types = (_name_type(schema, names), *(schema.field(name).type for name in kept))
        return Layout(sensor, wide, tuple(used), bound, time, kept, by_folder, kinds, units, types)
    raise (
        errors[0]
        if errors
        else DataError(
            f"{file.name}: holds no columns of numbers, nor of lists of numbers; it has "
            f"{listed(schema.names)}"
        )
    )


def differing(layout: Layout, first: File, file: File, table: Any) -> DataError | None:
    """What is said where a file's columns are not those of the first; None where they are."""
    schema = table.schema_arrow
    for name, kind in layout.kinds:
        if name not in schema.names:
            return DataError(
                f"{file.name}: has no column {name}, which {first.name} has; a data set has one "
                f"schema: it has {listed(schema.names)}"
            )
        own = _kind(schema.field(name))
        if own != kind:
            return DataError(
                f"{file.name}: column {name} is {own}, and in {first.name} {kind}; a data set has "
                "one schema: convert it, or calibrate these files apart"
            )
    if layout.named_by_folder and file.folder_value(layout.sensor) is None:
        return DataError(
            f"{file.name}: lies in no folder {layout.sensor}=…, as {first.name} does; every file "
            "says whose readings it holds"
        )
    return None


def table_of(file: str, columns: Mapping[str, Any]) -> Table:
    """Columns of numbers by header as a table, which knows their names and units."""
    found = [numeric_column(header, values, None) for header, values in columns.items()]
    return Table(file, {c.name: c for c in found}, (), {}, len(found[0].values) if found else 0)


def _found(file: File, schema: Any, sensor: str) -> str:
    names = dict.fromkeys(schema.names, Column("", None, np.zeros(0)))
    found = find_by_name(Table(file.name, names, (), {}, 0), sensor)
    if found is None:
        raise DataError(
            f"{file.name}: no column {sensor} says which sensor a row belongs to; it has "
            f"{listed(schema.names)}; name it with --sensor COLUMN"
        )
    kind = str(schema.field(found).type)
    if not re.match(r"(large_)?string|u?int\d+|dictionary", kind):
        raise DataError(
            f"{file.name}: column {found} is of type {kind}, and the name of a sensor is text or a "
            "whole number; name another with --sensor COLUMN"
        )
    return found


def _name_type(schema: Any, names: Sequence[str]) -> Any:
    """The Arrow type of names, as `names.plain` makes them."""
    import pyarrow

    return plain(pyarrow.array([], schema.field(names[0]).type if names else None)).type


def _kept(file: File, schema: Any, name: str) -> str:
    if name not in schema.names:
        raise DataError(f"{file.name}: no column {name} to keep; it has {listed(schema.names)}")
    kind = str(schema.field(name).type)
    if "<" in kind and not kind.startswith("dictionary"):
        raise DataError(f"{file.name}: column {name} of type {kind} holds no one value per sensor")
    return name


def _readings(table: Any, entry: Any, wide: bool) -> Readings | None:
    """A column as readings of this form; None where it is none."""
    kind, unit = str(entry.type), (entry.metadata or {}).get(b"unit", b"").decode()
    header = f"{entry.name} [{unit}]" if unit else entry.name
    if wide and _VECTOR.match(kind):
        return Readings(entry.name, header, 0)
    if not wide and _SCALAR.match(kind):
        return Readings(entry.name, header, 0)
    found = (_VECTORS if wide else _VECTOR).match(kind)
    if not found:
        return None
    size = int(found[1]) if found[1] else _first_size(table, entry.name, wide)
    return Readings(entry.name, header, size) if size else None


def _first_size(table: Any, name: str, wide: bool) -> int:
    """Numbers in the first reading of a column, where its type does not tell."""
    for piece in table.iter_batches(batch_size=64, columns=[name]):
        lists = piece.column(0)
        lists = lists.flatten() if wide else lists
        sizes = [len(one) for one in lists.slice(0, 64).to_pylist() if one is not None]
        return sizes[0] if sizes else 0
    return 0


def _bound(
    file: File, readings: Sequence[Readings], signals: Sequence[Signal], options: Options
) -> tuple[_Columns, _Units, str | None, list[Readings]]:
    """Columns and unit of each signal, the column of time, and the readings that hold them."""
    owner = {h: r for r in readings for h in r.headers}
    table = table_of(file.name, {header: np.zeros(0) for header in owner})
    names = [name_and_unit(h)[0] for r in readings for h in r.headers]
    if twice := next((name for name in names if names.count(name) > 1), ""):
        raise DataError(f"{file.name}: two columns are named '{twice}'; rename one of them")
    named = dict(zip(table.columns, owner.values(), strict=True))
    refuse_unknown_names([table], signals, options)
    bound = [(s, find_columns(table, s, options.columns)) for s in signals if not is_time(s)]
    time = None
    if any(map(is_time, signals)) and options.rate is None:
        chosen = options.columns.get("t")
        time = find_column(table, str(chosen[0]), "time") if chosen else None
        time = time or next(iter(timing.find_time(table)), None)
        if time is None:
            raise DataError(
                f"{file.name}: no time column (t, time, timestamp) for signal t; it has "
                f"{listed([*table.columns])}; give --rate HZ or --columns t=NAME"
            )
    used = {name for _, names in bound for name in names} | ({time} if time else set())
    units = tuple(_unit(table, s, names, options) for s, names in bound)
    columns = tuple((s.name, names) for s, names in bound)
    return columns, units, time, [r for r in readings if r in [named[n] for n in used]]


def _unit(
    table: Table, signal: Signal, names: tuple[str, ...], options: Options
) -> tuple[str, str | None]:
    if signal.kind == "rotation":
        return signal.name, None
    columns_of(table, signal, names, options)  # refused here if it is no such quantity
    return signal.name, units_of(table, signal, names, options)[0]


def _kind(entry: Any) -> str:
    """Type and unit of a column; how a list is stored is the file's own business."""
    unit = (entry.metadata or {}).get(b"unit", b"").decode()
    kind = re.sub(r"<\w+: ", "<", str(entry.type)).replace(" not null", "")
    return kind + (f" in {unit}" if unit else "")
