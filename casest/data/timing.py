"""Time in seconds, and where a record is interrupted."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from casest import units
from casest.data.finding import find_by_name
from casest.data.table import Column, Table
from casest.errors import DataError, UnitError, UsageError

Array = NDArray[np.float64]

GAP = 5.0  # times the median step

#: How the note begins that tells why a time column was left aside.
UNUSED = "time not used: "

_NAMES = ("t", "time", "timestamp", "timestamps")
_CLOCKS = {"millis": "ms", "milliseconds": "ms", "micros": "us", "microseconds": "us"}
_RATE_NAMES = ("fs", "rate", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency")


def find_time(table: Table, chosen: str | None) -> str | None:
    """Return the name of the time column: `chosen`, t, time, timestamp, or such with a unit."""
    if chosen is not None:
        return chosen
    for name in _NAMES:
        found = find_by_name(table, name)
        if found and not _is_temperature(table.columns[found]):
            return found
    return next((name for name in table.columns if _unit_in_name(name)), None)


def _is_temperature(column: Column) -> bool:
    """A capital T is a time only where its unit is one."""
    try:
        return column.name == "T" and (
            column.unit is None or not units.conversion(column.unit, "s")
        )
    except UnitError:
        return True


def increasing(table: Table) -> str | None:
    """Return the first column of numbers that always grows: it may be the time."""
    for name, column in table.columns.items():
        if not column.is_text and column.bad is None and table.n_rows > 1:
            values = np.asarray(column.values, dtype=np.float64)
            if (np.diff(values) > 0).all():
                return name
    return None


def seconds(table: Table, column: Column, stated: str | None) -> tuple[Array, str | None]:
    """Return a time column in s and a note on what was assumed.

    Raises UnitError where its unit is no time, DataError where it is text but no date.
    """
    if column.is_text:
        return _from_dates(table, column), None
    unit = stated or column.unit or _unit_in_name(column.name)
    values = np.asarray(column.values, dtype=np.float64)
    if unit is None:
        step = f"{np.median(np.diff(values)):g}" if len(values) > 1 else "unknown"
        note = f"{column.name}: no unit stated, taken as s (median step {step} s); "
        return values, note + "if that is wrong say --unit t=ms"
    factor, _ = units.conversion(unit, "s")
    return values * factor, None


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


def refuse_unordered(file: str, column: str, time: Array, rows: NDArray[np.int_]) -> None:
    """Raise DataError at the first row whose time does not exceed the one before."""
    wrong = np.flatnonzero(np.diff(time) <= 0)
    if wrong.size:
        at = int(wrong[0])
        what = "repeats" if time[at + 1] == time[at] else "goes backward from"
        raise DataError(
            f"{file}: column {column} row {rows[at + 1]}: time {time[at + 1]:.9g} s {what} "
            f"{time[at]:.9g} s in row {rows[at]} ({wrong.size} such rows); mark separate records "
            f"with a column run, or give --rate HZ to count samples instead"
        )


def blocks(time: Array | None, pose: NDArray[np.generic] | None, n: int) -> NDArray[np.int_]:
    """Number the stretches between gaps in time and changes of pose, from 0."""
    starts = np.zeros(n, dtype=np.bool_)
    if time is not None and n > 2:
        steps = np.diff(time)
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


def time_units_declared(mapping: Mapping[str, str], column: str | None) -> str | None:
    """Return the unit the user states for time, by signal or by column."""
    return mapping.get("t") or (mapping.get(column) if column else None)


def _from_dates(table: Table, column: Column) -> Array:
    """Read ISO dates (2020-03-07 15:45:00.123) or clock times (15:45:00.1) as s since row 0."""
    days = ["" if "-" in str(text)[1:] else "2000-01-01T" for text in column.values]
    try:
        texts = [
            day + str(text).strip().rstrip("Z")
            for day, text in zip(days, column.values, strict=True)
        ]
        dates = np.array(texts, dtype="datetime64[ns]")
    except ValueError:
        raise DataError(
            f"{table.file}: column {column.name} row 0 holds '{column.values[0]}', which is no "
            f"time; name another column with --columns t=… or give --rate HZ"
        ) from None
    return np.asarray((dates - dates[0]).astype(np.int64) * 1e-9, dtype=np.float64)
