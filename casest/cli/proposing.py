"""What `casest init` writes: a project file from what a record shows, its guesses marked."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from casest import units
from casest.data import at_rest, load_runs, read_table
from casest.data.finding import find_columns, near_group, unit_in_names
from casest.data.logs.naming import parts_of
from casest.data.matching import triads
from casest.data.run import Run
from casest.data.table import Table
from casest.data.timing import find_time, increasing, rate_in_preamble, unit_at_end
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import CasestError, DataError
from casest.results.find import find_model

#: Rest intervals from which on a record is one of poses.
ENOUGH_RESTS = 6
#: Poses from which on the usual model is safe; below, the one with fewer unknowns.
ENOUGH_POSES = 12
#: Rows from which on a record is no list of poses, of the models whose samples are poses.
MANY_ROWS, POSES = 200, ("norm-diagonal", "norm-triangular", "norm-pair")
_G = units.STANDARD_GRAVITY
#: Words in the name of a column that say what it measures, and the model's signal that it is.
_WORDS = (
    ("gyro", ("gyr", "omega", "rate", "ang")),
    ("mag", ("mag", "compass", "field", "hx", "bx", "mx")),
    ("acc", ("acc", "force", "ax", "fx", "specific")),
    ("gyro", ("wx", "gx")),
)
_SIZES = {"acc": "m/s^2", "mag": "uT", "gyro": "rad/s"}


@dataclass(frozen=True)
class Proposal:
    """Text of a project file, and what is to be said of it, a sentence each."""

    text: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Group:
    """Three columns: what they measure (`acc`, `mag`, `gyro`, or empty) and their unit.

    `guess` says why, where the unit stands in no header.
    """

    columns: tuple[str, ...]
    kind: str
    unit: str | None
    guess: str


@dataclass
class _Found:
    """What the record shows: columns and units by signal, and why, where that is a guess."""

    table: Table
    groups: Sequence[_Group]
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    why: dict[str, str] = field(default_factory=dict)
    in_order: dict[str, tuple[str, ...]] = field(default_factory=dict)
    rests: int = 0


def proposal(data: Sequence[str], model_name: str | None, folder: Path) -> Proposal:
    """A project file in `folder` for records that look alike; DataError where nothing fits."""
    table = _first_table(data)
    groups = [_group(table, columns) for columns in triads(_numbers(table))]
    name = model_name or _model_name(table, groups)
    model = find_model(name)
    found = _found(table, groups, model)
    given = {signal: columns for signal, columns in found.columns.items() if columns}
    runs = load_runs(list(data), model.signals, columns=given, units=found.units,
                     rate=1.0 if _lacks_time(table, model) else None)  # fmt: skip
    found.rests = _rests(model, runs)
    few = found.rests < ENOUGH_POSES and len(runs[0]) < ENOUGH_POSES
    if model_name is None and name == "norm-triangular" and few:
        name = "norm-diagonal"
    lines = _lines(name, model, data, folder, found)
    return Proposal("\n".join(lines) + "\n", tuple(_said(name, runs, found)))


def _found(table: Table, groups: Sequence[_Group], model: Model) -> _Found:
    """The columns of each signal of a model, and their units where no header states them."""
    found = _Found(table, groups)
    if not find_time(table) and (clock := _clock(table)):
        found.columns["t"] = clock
    for signal in model.signals:
        if signal.name == "t":
            continue
        columns = found.columns[signal.name] = _columns(table, signal, groups)
        group = next((g for g in groups if g.columns == columns), None)
        unit, why = (group.unit, group.guess) if group else _own_unit(table, signal, columns)
        if unit and why:
            found.units[signal.name], found.why[signal.name] = unit, why
    found.in_order = _in_order(model, found)
    found.columns |= found.in_order
    return found


def _first_table(data: Sequence[str]) -> Table:
    tables = [read_table(part) for part in parts_of(data[0])]
    if len(tables) == 1:
        return tables[0]
    columns = {n: c for table in reversed(tables) for n, c in table.columns.items()}
    return Table(data[0], columns, tables[0].notes, tables[0].preamble, tables[0].n_rows)


def _clock(table: Table) -> tuple[str, ...]:
    """The time: by its name, else what always grows and ends in a unit of time, tick_us."""
    if found := find_time(table):
        return found
    grows = (n for n in table.columns if "_" in n and unit_at_end(n) and increasing(table, n))
    return tuple(grows)[:1]


def _numbers(table: Table) -> list[str]:
    clock = _clock(table)
    return [n for n, c in table.columns.items() if not c.is_text and n not in clock]


def _lacks_time(table: Table, model: Model) -> bool:
    """Does the model need a time that nothing tells?"""
    told = _clock(table) or rate_in_preamble(table)
    return not told and any(s.name == "t" for s in model.signals)


def _group(table: Table, columns: tuple[str, ...]) -> _Group:
    """What three columns measure, by their unit, their name, their size."""
    stated = table.columns[columns[0]].unit
    stated = stated if stated and units.known(stated) else None
    kind = _kind_of_unit(stated) if stated else ""
    plain = "".join(columns).casefold()
    kind = kind or next((k for k, words in _WORDS if any(w in plain for w in words)), "")
    values = np.column_stack([table.columns[n].values for n in columns]).astype(float)
    if stated:
        return _Group(columns, kind, units.canonical(stated), "")
    word = columns[0].rpartition("_")[2]
    if len(word) > 1 and units.familiar(word):  # mag_x_mGauss
        return _Group(
            columns, _kind_of_unit(word) or kind, units.canonical(word), "so its name says"
        )
    return _guessed(columns, kind, values[np.isfinite(values).all(axis=1)])


def _own_unit(table: Table, signal: Signal, names: Sequence[str]) -> tuple[str | None, str]:
    """The unit of columns whose headers state none, with the reason: by their names, by size."""
    columns = [table.columns[name] for name in names]
    if columns and (unit := unit_in_names(table, names, signal)):
        return unit, "so its name says"
    angles = signal.kind == "rotation" and len(columns) == 3 and not any(c.unit for c in columns)
    largest = max(float(np.nanmax(np.abs(c.values))) for c in columns) if angles else 0.0
    if largest > 2 * np.pi:
        return "deg", f"no header says it; the largest angle is {largest:.4g}"
    return None, ""


def _kind_of_unit(unit: str) -> str:
    for kind, own in _SIZES.items():
        try:
            units.conversion(unit, own)
        except CasestError:
            continue
        return kind
    return ""


def _guessed(columns: tuple[str, ...], kind: str, values: Array) -> _Group:
    """The unit that readings of one length have most likely, with the reason."""
    if not len(values):
        return _Group(columns, kind, None, "")
    length = float(np.median(np.linalg.norm(values, axis=1)))
    said = f"no header says it; the median length is {length:.4g}"
    if length > 100 and np.all(values == np.round(values)):
        return _Group(columns, kind, "count", f"{said}, all of it whole numbers")
    if kind in ("", "acc"):
        for unit, size in (("m/s^2", _G), ("g", 1.0), ("mg", 1000.0)):
            if abs(length / size - 1) < (0.15 if kind else 0.05):
                return _Group(columns, "acc", unit, said)
    if kind == "mag":
        for unit, low, high in (("gauss", 0.2, 0.7), ("uT", 20, 70), ("mgauss", 200, 700)):
            if low < length < high:
                return _Group(columns, kind, unit, said)
    return _Group(columns, kind, None, "")


def _model_name(table: Table, groups: Sequence[_Group]) -> str:
    kinds = {g.kind for g in groups}
    turned = len(near_group(table, Signal("attitude", 9, None, "rotation"))) == 3
    if {"acc", "mag"} <= kinds:
        return "norm-pair"
    if "acc" in kinds and turned:
        return "rate-table"
    if kinds - {"gyro"}:
        return "norm-triangular"
    names = ", ".join(list(table.columns)[:12])
    raise DataError(
        f"{table.file}: no three columns look like the axes of an accelerometer or magnetometer "
        f"(it has {names}); name the model: casest init {table.file} --model FILE.py"
    )


def _columns(table: Table, signal: Signal, groups: Sequence[_Group]) -> tuple[str, ...]:
    """The columns of a signal: by its name, by what it measures, else what is nearest."""
    if signal.size == 3:
        kind = {"a": "acc", "m": "mag", "w": "gyro"}.get(signal.name, "")
        for wanted in [kind] if kind else ["acc", "mag", ""]:
            for group in groups:
                if group.kind == wanted:
                    return group.columns
    try:
        return find_columns(table, signal, {})
    except DataError:
        return tuple(near_group(table, signal))


def _in_order(model: Model, found: _Found) -> dict[str, tuple[str, ...]]:
    """Signals of one column that nothing tells, in the file's order, where none is left over."""
    used = {name for columns in found.columns.values() for name in columns}
    left = [name for name in _numbers(found.table) if name not in used]
    open_ = [signal for signal in model.signals if found.columns.get(signal.name) == ()]
    if len(open_) != len(left) or any(signal.size != 1 for signal in open_):
        return {}
    return {signal.name: (name,) for signal, name in zip(open_, left, strict=True)}


def _rests(model: Model, runs: Sequence[Run]) -> int:
    """How many rest intervals the records hold, of a model whose samples are poses; else 0."""
    if not model.implicit:
        return 0
    try:
        found = sum(len(at_rest(run)) for run in runs)
    except CasestError:
        return 0
    return found if found >= ENOUGH_RESTS else 0


def _lines(
    name: str, model: Model, data: Sequence[str], folder: Path, found: _Found
) -> Iterator[str]:
    table = found.table
    yield "# Options of casest for this record; what is typed overrides them, names are seen from"
    yield "# this file's folder. Every entry is an option of the command line: casest close --help."
    yield f"model = {_text(_beside(name, folder) if '.py' in name else name)}"
    yield f"data = {_text([_beside(d, folder) for d in data])}"
    yield 'output = "out"'
    if not _clock(table) and not rate_in_preamble(table):
        yield "# rate = 100  # samples per second: no column is the time"
    if found.rests:
        yield f"at_rest = true  # {found.rests} rest intervals are found; each becomes one pose"
    yield from ("", "[columns]")
    for signal, columns in found.columns.items():
        guess = "  # a guess, by the order of the columns" if signal in found.in_order else ""
        yield f"{signal} = {_text(list(columns))}{guess}" if columns else f"# {signal} = […]"
    used = {c for columns in found.columns.values() for c in columns}
    if others := [n for n in _numbers(table) if n not in used]:
        yield f"# kept, and tried as causes by casest close: {', '.join(others[:12])}"
    if found.units:
        yield from ("", "[units]")
        yield from (f"{s} = {_text(unit)}  # {found.why[s]}" for s, unit in found.units.items())
    yield from _constants(model, found)


def _constants(model: Model, found: _Found) -> Iterator[str]:
    """What is known beforehand: gravity where something measures it, the rest to be filled in."""
    yield from ("", "[constants]")
    if any(c.name == "norm" for c in model.constants):
        if _measured(found) == "acc":
            yield f'norm = "{_G} m/s^2"  # standard gravity; gravity(latitude, height) is your own'
        else:
            yield '# norm = "48 uT"  # the known length; field(latitude, longitude, height, year)'
    for c in model.constants:
        if c.name != "norm" and not c.dims:
            yield f"# {c.name} = {_text(f'{float(c.array):.9g} {c.unit}'.strip())}"


def _measured(found: _Found) -> str:
    """What the signal v measures: by its unit, else by the columns' names."""
    columns = found.columns.get("v", ())
    unit = found.units.get("v") or (found.table.columns[columns[0]].unit if columns else None)
    kind = _kind_of_unit(unit) if unit and units.known(unit) else ""
    return kind or next((g.kind for g in found.groups if g.columns == columns and unit), "")


def _beside(name: str, folder: Path) -> str:
    return "+".join(os.path.relpath(part, folder) for part in parts_of(name))


def _text(value: str | list[str]) -> str:
    return json.dumps(value, ensure_ascii=False)


def _said(name: str, runs: Sequence[Run], found: _Found) -> Iterator[str]:
    rows = sum(len(run) for run in runs)
    time = runs[0].time
    lasts = "" if time is None else f" over {float(np.ptp(time)):.4g} s"
    several = "runs" if len(runs) > 1 else "run"
    yield f"{len(runs)} {several}, {rows} rows{lasts}, {len(found.table.columns)} columns"
    if not lasts:
        yield "no column is the time; where it matters say the rate"
    if found.rests:
        yield f"{found.rests} rest intervals: a record of poses"
    elif name in POSES and rows > MANY_ROWS:
        yield "no rest intervals: each row is taken as a pose; of a moving accelerometer none is"
    yield from (f"unit of {signal} guessed: {reason}" for signal, reason in found.why.items())
    for signal, (column,) in found.in_order.items():
        yield f"column of {signal} guessed: {column}, by the order of the columns"
    yield f"model {name}"
