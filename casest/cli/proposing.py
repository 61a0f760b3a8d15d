"""What `casest init` writes: a project file from what a record shows, its guesses marked."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casest import units
from casest.data import at_rest, load_runs, read_table
from casest.data.finding import find_columns, near_group
from casest.data.logs.naming import parts_of
from casest.data.matching import triads
from casest.data.run import Run
from casest.data.table import Table
from casest.data.timing import find_time, rate_in_preamble
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


def proposal(data: Sequence[str], model_name: str | None, folder: Path) -> Proposal:
    """A project file in `folder` for records that look alike; DataError where nothing fits."""
    table = _first_table(data)
    groups = [_group(table, columns) for columns in triads(_numbers(table))]
    name = model_name or _model_name(table, groups)
    model, chosen = find_model(name), dict[str, tuple[str, ...]]()
    units, comments = dict[str, str](), dict[str, str]()
    for signal in model.signals:
        if signal.name == "t":
            continue
        chosen[signal.name] = _columns(table, signal, groups)
        group = next((g for g in groups if g.columns == chosen[signal.name]), None)
        if group and group.guess and group.unit:
            units[signal.name], comments[signal.name] = group.unit, group.guess
    runs = load_runs(list(data), model.signals, columns=_given(chosen), units=units,
                     rate=1.0 if _lacks_time(table, model) else None)  # fmt: skip
    rests = _rests(model, runs)
    if model_name is None and name == "norm-triangular" and rests < ENOUGH_POSES and len(
        runs[0]
    ) < ENOUGH_POSES:  # fmt: skip
        name = "norm-diagonal"
    lines = _lines(name, model, data, folder, chosen, units, comments, rests, table)
    return Proposal("\n".join(lines) + "\n", tuple(_said(name, table, runs, rests, comments)))


def _first_table(data: Sequence[str]) -> Table:
    tables = [read_table(part) for part in parts_of(data[0])]
    if len(tables) == 1:
        return tables[0]
    columns = {n: c for table in reversed(tables) for n, c in table.columns.items()}
    return Table(data[0], columns, tables[0].notes, tables[0].preamble, tables[0].n_rows)


def _numbers(table: Table) -> list[str]:
    clock = find_time(table)
    return [n for n, c in table.columns.items() if not c.is_text and n not in clock]


def _lacks_time(table: Table, model: Model) -> bool:
    """Does the model need a time that nothing tells?"""
    told = find_time(table) or rate_in_preamble(table)
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


def _given(chosen: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    return {name: columns for name, columns in chosen.items() if columns}


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
    name: str,
    model: Model,
    data: Sequence[str],
    folder: Path,
    chosen: Mapping[str, tuple[str, ...]],
    stated: Mapping[str, str],
    why: Mapping[str, str],
    rests: int,
    table: Table,
) -> Iterator[str]:
    yield "# Options of casest for this record; what is typed overrides them, names are seen from"
    yield "# this file's folder. Every entry is an option of the command line: casest close --help."
    yield f"model = {_text(_beside(name, folder) if '.py' in name else name)}"
    yield f"data = {_text([_beside(d, folder) for d in data])}"
    yield 'output = "out"'
    if not find_time(table) and not rate_in_preamble(table):
        yield "# rate = 100  # samples per second: no column is the time"
    if rests:
        yield f"at_rest = true  # {rests} rest intervals are found; each becomes one pose"
    yield from ("", "[columns]")
    for signal, columns in chosen.items():
        yield f"{signal} = {_text(list(columns))}" if columns else f"# {signal} = […]  # which?"
    used = {c for columns in chosen.values() for c in columns}
    if others := [n for n in _numbers(table) if n not in used]:
        yield f"# kept, and tried as causes by casest close: {', '.join(others[:12])}"
    if stated:
        yield from ("", "[units]")
        yield from (f"{s} = {_text(unit)}  # {why[s]}" for s, unit in stated.items())
    yield from _constants(model, table, chosen, stated)


def _constants(
    model: Model, table: Table, chosen: Mapping[str, tuple[str, ...]], stated: Mapping[str, str]
) -> Iterator[str]:
    """What is known beforehand: gravity where something measures it, the rest to be filled in."""
    yield from ("", "[constants]")
    names = [c.name for c in model.constants]
    if "norm" in names:
        columns = chosen.get("v", ())
        unit = stated.get("v") or (table.columns[columns[0]].unit if columns else None)
        kind = _kind_of_unit(unit) if unit and units.known(unit) else ""
        if kind == "acc":
            yield f'norm = "{_G} m/s^2"  # standard gravity; gravity(latitude, height) is your own'
        else:
            yield '# norm = "48 uT"  # the known length; field(latitude, longitude, height, year)'
    for c in model.constants:
        if c.name != "norm" and not c.dims:
            yield f"# {c.name} = {_text(f'{float(c.array):.9g} {c.unit}'.strip())}"


def _beside(name: str, folder: Path) -> str:
    return "+".join(os.path.relpath(part, folder) for part in parts_of(name))


def _text(value: str | list[str]) -> str:
    return json.dumps(value, ensure_ascii=False)


def _said(
    name: str, table: Table, runs: Sequence[Run], rests: int, why: Mapping[str, str]
) -> Iterator[str]:
    rows = sum(len(run) for run in runs)
    time = runs[0].time
    lasts = "" if time is None else f" over {float(np.ptp(time)):.4g} s"
    several = "runs" if len(runs) > 1 else "run"
    yield f"{len(runs)} {several}, {rows} rows{lasts}, {len(table.columns)} columns"
    if not lasts:
        yield "no column is the time; where it matters say the rate"
    if rests:
        yield f"{rests} rest intervals: a record of poses"
    elif name in POSES and rows > MANY_ROWS:
        yield "no rest intervals: each row is taken as a pose; of a moving accelerometer none is"
    yield from (f"unit of {signal} guessed: {reason}" for signal, reason in why.items())
    yield f"model {name}"
