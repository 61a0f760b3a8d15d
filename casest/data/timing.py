"""Time in seconds, and where a record is interrupted."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from casest import units
from casest.data.matching import find_by_name
from casest.data.moments import Moments, parse_moments
from casest.data.scaling import Scale
from casest.data.table import Column, Table
from casest.errors import DataError, UnitError, UsageError

Array = NDArray[np.float64]

GAP = 5.0  # times the usual step
USUAL = 0.8  # share of the steps that do not exceed it
_BACK = 0.1  # share of steps back from which on a column is no time
_EVEN = 20  # steps that show whether a record is evenly sampled

#: What a note says of a time without a unit.
ASSUMED = "no unit stated, taken as s"
#: How the note begins that tells why a time column was left aside.
UNUSED = "time not used: "

_NAMES = ("t", "time", "timestamp", "timestamps", "unixtime")
_CLOCKS = {"millis": "ms", "milliseconds": "ms", "micros": "us", "microseconds": "us"}
#: A column that was said to be the time may be called by its unit alone, or end in it: tick_us.
_UNITS = ("s", "sec", "ms", "msec", "us", "usec", "ns")
_PAIR = ["clock", "date"]
_KINDS = ("both", "date", "clock")
_SERIES = 100  # rows in which what always grows is hardly a table's input
_LOOK = 100  # rows that tell what a column of text holds
_RATE_NAMES = ("fs", "rate", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency")


def find_time(table: Table) -> tuple[str, ...]:
    """Return the column that holds the time, or a date and a time of day; () where none does.

    It is called t, time, timestamp or unix_time, or such with a unit; else it is the only column of
    times of day, with the only column of dates if there is one.
    """
    kinds = _kinds(table)
    named = _by_name(table)
    if named is None:
        return _only(kinds)
    partner = {"clock": "date", "date": "clock"}.get(kinds.get(named, ""))
    partners = [name for name, kind in kinds.items() if kind == partner]
    if len(partners) == 1:
        return (*partners, named) if partner == "date" else (named, *partners)
    return (named,)


def _by_name(table: Table) -> str | None:
    found = [find_by_name(table, name) for name in _NAMES]
    called = [f for f in found if f and not _is_temperature(table.columns[f])]
    called += [name for name in table.columns if _unit_in_name(name)]
    # What is called t and goes back again and again is something else where there is a time.
    steady = (name for name in called if not _wanders(table.columns[name]))
    return next(steady, None) or next(iter(called), None)


def _wanders(column: Column) -> bool:
    """Do numbers go back in more steps than separate records would?"""
    if column.is_text:
        return False
    steps = np.diff(np.asarray(column.values, float))
    steps = steps[np.isfinite(steps)]
    return steps.size > 0 and bool(np.mean(steps < 0) > _BACK)


def _kinds(table: Table) -> dict[str, str]:
    """Which columns of text hold dates, times of day or both, by what they begin with."""
    found: dict[str, str] = {}
    for name, column in table.columns.items():
        moments = parse_moments(list(column.values[:_LOOK])) if column.is_text else None
        if moments:
            found[name] = moments.kind
    return found


def _only(kinds: Mapping[str, str]) -> tuple[str, ...]:
    """The one way to read a time of day from the columns of text, () where there are several."""
    by_kind = {kind: [n for n, k in kinds.items() if k == kind] for kind in _KINDS}
    both, dates, clocks = (by_kind[kind] for kind in _KINDS)
    if len(both) == 1 and not clocks:
        return (both[0],)
    if not both and len(clocks) == 1 and len(dates) <= 1:
        return (*dates, *clocks)
    return ()


def kept_as_text(table: Table) -> str | None:
    """A note on columns of dates and times that are not the time of the record."""
    names = [name for name, kind in _kinds(table).items() if kind != "date"]
    if len(names) < 2:
        return None
    return (
        f"{' and '.join(names)} hold times, kept as text; name the time of the record with "
        f"--columns t={names[0]}"
    )


def unnamed(table: Table, taken: Collection[str]) -> str | None:
    """A note on a column that could be the time, where none is called so; `taken` are signals'.

    It always grows, and has a unit of time; or none at all, in a series, and does not count rows.
    """
    names = [name for name in table.columns if name not in taken and increasing(table, name)]
    timed = [name for name in names if _has_unit_of_time(table.columns[name])]
    bare = [name for name in names if table.columns[name].unit is None and not _counts(table, name)]
    likely = next(iter(timed or bare if table.n_rows >= _SERIES else timed), None)
    if likely is None:
        return None
    return f"{likely} grows from row to row: if it is the time, say --columns t={likely}"


def _has_unit_of_time(column: Column) -> bool:
    try:
        return column.unit is not None and bool(units.conversion(column.unit, "s"))
    except UnitError:
        return False


def _counts(table: Table, name: str) -> bool:
    return bool(np.all(np.diff(np.asarray(table.columns[name].values, dtype=np.float64)) == 1))


def _is_temperature(column: Column) -> bool:
    """A capital T is a time only where its unit is one."""
    try:
        return column.name == "T" and (
            column.unit is None or not units.conversion(column.unit, "s")
        )
    except UnitError:
        return True


def first_increasing(table: Table) -> str | None:
    """Return the first column of numbers that always grows: it may be the time."""
    return next((name for name in table.columns if increasing(table, name)), None)


def increasing(table: Table, name: str) -> bool:
    """Whether a column of numbers always grows: it counts samples, or is their time."""
    column = table.columns[name]
    if column.is_text or column.bad is not None or table.n_rows < 2:
        return False
    return bool((np.diff(np.asarray(column.values, dtype=np.float64)) > 0).all())


def from_text(table: Table, columns: tuple[Column, ...]) -> Array:
    """Return dates, times of day, or a column of each, as s since row 0; NaN where one is missing.

    Raises DataError where a cell is neither, or where day and month cannot be told apart.
    """
    parts = [_moments(table, column) for column in columns]
    if sorted(part.kind for part in parts) not in (["date"], ["clock"], ["both"], _PAIR):
        raise DataError(
            f"{table.file}: columns {' and '.join(c.name for c in columns)} are not a date and a "
            f"time of day; name one column with --columns t=… or both with --columns t=DATE,TIME"
        )
    time = np.zeros(table.n_rows, dtype=np.int64)
    missing = np.zeros(table.n_rows, dtype=np.bool_)
    for column, part in zip(columns, parts, strict=True):
        if part.ambiguous and not (part.constant_date and any(p.kind != "date" for p in parts)):
            raise DataError(
                f"{table.file}: column {column.name} row 0 holds '{column.values[0]}', where day "
                f"and month cannot be told apart; write dates as 2026-03-12 or 12.03.2026, or give "
                f"--rate HZ"
            )
        time += part.clock + (0 if part.days is None else part.days)
        missing |= part.missing
    first = int(np.argmin(missing))
    return np.where(missing, np.nan, (time - time[first]) * 1e-9)


def seconds(
    table: Table, column: Column, stated: str | None, scale: Scale | None = None
) -> tuple[Array, list[str]]:
    """Return a time column of numbers in s, scaled first, and notes on what was assumed.

    Raises UnitError where its unit is no time, UsageError where the header states one that may be
    that before or after scaling.
    """
    unit = stated or column.unit or _unit_in_name(column.name) or unit_at_end(column.name)
    values = np.asarray(column.values, dtype=np.float64)
    if scale is not None:
        values = scale.apply(values, table.file, column.name)
        unit = _after_scaling(table, column, stated, unit)
    if unit is None:
        there = values[np.isfinite(values)]
        step = f"{np.median(np.diff(there)):g}" if len(there) > 1 else "unknown"
        note = f"{column.name}: {ASSUMED} (median step {step} s); "
        return values, [note + "if that is wrong say --unit t=ms"]
    factor, _ = units.conversion(unit, "s")
    return values * factor, []


def _after_scaling(
    table: Table, column: Column, stated: str | None, unit: str | None
) -> str | None:
    """The unit of scaled time stamps: as the user states it; counts are counts no more."""
    if stated or unit is None:
        return stated
    spelled = units.canonical(unit)
    if spelled == "count":
        return None
    if spelled != "s":
        raise UsageError(
            f"{table.file}: column {column.name} is in {unit} by its header, and --scale changes "
            f"its numbers: say what they are then, --unit t=s, or leave --scale out"
        )
    return spelled


def longest(steps: Array) -> float:
    """The longest step that is no gap, s: some times the one that four of five do not exceed.

    By the median every second step would be a gap where short ones and long ones take turns.
    """
    return GAP * float(np.quantile(steps, USUAL, method="lower"))


def interruptions(name: str, time: Array, rows: NDArray[np.int_]) -> list[str]:
    """A note on samples that an evenly sampled record lacks, and on gaps: how many, and where."""
    steps = np.diff(time)
    if len(steps) < _EVEN:
        return []
    median = float(np.median(steps))
    even = float(np.mean(np.abs(steps - median) < 0.1 * median)) >= 0.5
    said = []
    wide = steps > longest(steps)
    lost = np.flatnonzero((steps > 1.5 * median) & ~wide)
    if even and lost.size:
        count = int((np.rint(steps[lost] / median) - 1).sum())
        coarse = ", or the time stamps are coarse" if lost.size > 0.1 * len(steps) else ""
        said.append(
            f"{counted(count, 'sample')} missing in {counted(lost.size, 'place')}, the first "
            f"behind row {rows[lost[0]]} (t = {time[lost[0]]:.6g} s){coarse}"
        )
    found = np.flatnonzero(wide)
    if found.size:
        worst = found[np.argmax(steps[found])]
        samples = f" ({round(steps[worst] / median) - 1} samples)" if even else ""
        said.append(
            f"{counted(found.size, 'gap')}, the longest {steps[worst]:.4g} s{samples} behind "
            f"row {rows[worst]} (t = {time[worst]:.6g} s)"
        )
    return [f"{name}: {'; '.join(said)}; the median step is {median:.3g} s"] if said else []


def counted(n: int, thing: str) -> str:
    """`1 row`, `2 rows`."""
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


def rate_in_preamble(table: Table) -> tuple[str, float] | None:
    """Return the entry above the table that gives a sampling rate, in Hz."""
    for key, text in table.preamble.items():
        if re.sub(r"[^a-z]", "", re.sub(r"[\[(].*", "", key).lower()) not in _RATE_NAMES:
            continue
        found = re.match(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*(k?Hz)?\s*$", text)
        if found and float(found[1]) > 0:
            return f"{key},{text}", float(found[1]) * (1000.0 if found[2] == "kHz" else 1.0)
    return None


def checked_rate(rate: float) -> float:
    """Return `rate` in Hz, or raise UsageError."""
    if not (np.isfinite(rate) and rate > 0):
        raise UsageError(f"rate {rate} Hz makes no sense; give samples per second, for example 100")
    return float(rate)


def blocks(
    time: Array | None, pose: NDArray[np.generic] | None, rows: NDArray[np.int_]
) -> NDArray[np.int_]:
    """Number the stretches between gaps in time and changes of pose, from 0.

    Without a time the rows are one: where more than a few were dropped there is a gap.
    """
    starts = np.zeros(len(rows), dtype=np.bool_)
    if len(rows) > 2:
        steps = np.diff(rows if time is None else time)
        starts[1:] |= steps > GAP * np.median(steps)
    if pose is not None:
        starts[1:] |= pose[1:] != pose[:-1]
    return np.cumsum(starts, dtype=np.int_)


def _unit_in_name(name: str) -> str | None:
    """Return the unit in names like time_ms, t_s, timestampUs, time.sec, millis (Arduino)."""
    if unit := _CLOCKS.get(name.lower().rstrip("()")):
        return unit
    found = re.fullmatch(r"(?:t|time|time_?stamp)[_.\s]?(s|sec|ms|msec|us|usec|ns)", name.lower())
    return found[1] if found and name.lower() != "ts" else None


def unit_at_end(name: str) -> str | None:
    """Return the unit of time that is the last word of a column's name: tick_us, ms."""
    last = name.lower().rpartition("_")[2]
    return last if last in _UNITS else None


def time_units_declared(mapping: Mapping[str, str], column: str | None) -> str | None:
    """Return the unit the user states for time, by signal or by column."""
    return mapping.get("t") or (mapping.get(column) if column else None)


def _moments(table: Table, column: Column) -> Moments:
    """A column of dates (2020-03-07 15:45:00.123, 7.3.2020) or times of day (15:45:00,1)."""
    cells = [str(cell) for cell in column.values]
    if column.is_text and (found := parse_moments(cells)):
        return found
    wrong = [k for k, cell in enumerate(cells) if cell and parse_moments([cell]) is None]
    row = wrong[0] if wrong else 0
    raise DataError(
        f"{table.file}: column {column.name} row {row} holds '{cells[row]}', which is no "
        f"time; name another column with --columns t=… or give --rate HZ"
    )
