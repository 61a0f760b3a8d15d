"""Dates and times of day as text: which column holds them, and the seconds they mean.

Years first (ISO 8601) and days with dots (12.03.2026) mean one day each. With slashes either number
may be the day: where no cell of the column decides, the order is not guessed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Nanoseconds = NDArray[np.int64]

_YEAR_FIRST = r"(?P<y>\d{4})(?P<one>[-/.])(?P<m>\d{1,2})(?P=one)(?P<d>\d{1,2})"
_DOTS = r"(?P<D>\d{1,2})\.(?P<M>\d{1,2})\.(?P<Y>\d{4}|\d\d)"
_SLASHES = r"(?P<a>\d{1,2})(?P<two>[/-])(?P<b>\d{1,2})(?P=two)(?P<c>\d{4})"
_CLOCK = (
    r"(?P<h>\d{1,2}):(?P<min>\d\d)(?::(?P<s>\d\d)(?:[.,](?P<f>\d{1,9}))?)?"
    r"(?:\s*(?P<half>[AaPp])[Mm])?"
)
_ZONE = r"(?:\s*(?:Z|UTC|(?P<sign>[+-])(?P<zh>\d\d):?(?P<zm>\d\d)))?"
_MOMENT = re.compile(
    rf"\s*(?:(?:{_YEAR_FIRST}|{_DOTS}|{_SLASHES})(?:[T ,]\s*|\s+|$))?(?:{_CLOCK}{_ZONE})?\s*"
)
_SECOND = 1_000_000_000
_DAY = 86_400 * _SECOND


@dataclass(frozen=True)
class Moments:
    """What a column of text says: whole `days` (ns), the `clock` of the day (ns), or both.

    `days` is None where each cell is a time of day alone, and where the order of day and month
    is open (`ambiguous`); `missing` marks empty cells.
    """

    kind: Literal["date", "clock", "both"]
    days: Nanoseconds | None
    clock: Nanoseconds
    missing: NDArray[np.bool_]
    ambiguous: bool = False
    constant_date: bool = False


def parse_moments(cells: Sequence[str]) -> Moments | None:
    """Read a column of dates, times of day, or both; None where a filled cell is something else."""
    filled = [k for k, cell in enumerate(cells) if cell.strip()]
    if not filled:
        return None
    found: list[re.Match[str]] = []
    for k in filled:
        match = _MOMENT.fullmatch(cells[k])
        if match is None or not (match["h"] or _has_date(match)):
            return None
        if found and bool(match["h"]) != bool(found[0]["h"]):
            return None
        if found and _has_date(match) != _has_date(found[0]):
            return None
        found.append(match)
    dated, clocked = _has_date(found[0]), bool(found[0]["h"])
    days, clock = np.zeros((2, len(cells)), dtype=np.int64)
    day_first = _day_first(found)
    ambiguous = any(m["a"] for m in found) and day_first is None
    try:
        for k, match in zip(filled, found, strict=True):
            clock[k] = _of_day(match) if clocked else 0
            days[k] = _DAY * _date(match, bool(day_first)) if dated and not ambiguous else 0
    except (ValueError, OverflowError):
        return None  # a 13th month, a 30th of February, 25 o'clock, a year beyond 2262
    missing = np.ones(len(cells), dtype=np.bool_)
    missing[filled] = False
    written = {_written_date(m) for m in found}
    return Moments(
        "both" if dated and clocked else "date" if dated else "clock",
        days if dated and not ambiguous else None,
        clock,
        missing,
        ambiguous,
        constant_date=dated and len(written) == 1,
    )


def looks_like_a_moment(cell: str) -> bool:
    """Whether one cell is a date, a time of day or both."""
    match = _MOMENT.fullmatch(cell) if cell[:1].isdigit() else None
    return match is not None and bool(match["h"] or _has_date(match))


def _has_date(match: re.Match[str]) -> bool:
    return bool(match["y"] or match["D"] or match["a"])


def _written_date(match: re.Match[str]) -> tuple[str | None, ...]:
    return tuple(match[name] for name in ("y", "m", "d", "D", "M", "Y", "a", "b", "c"))


def _day_first(found: Sequence[re.Match[str]]) -> bool | None:
    """Whether the first number of 3/12/2026 is the day: a number above 12 is no month."""
    if any(m["a"] and int(m["a"]) > 12 for m in found):
        return True
    return False if any(m["b"] and int(m["b"]) > 12 for m in found) else None


def _date(match: re.Match[str], day_first: bool) -> int:
    """Days since year 1; ValueError where there is no such day."""
    if match["y"]:
        year, month, day = match["y"], match["m"], match["d"]
    elif match["D"]:
        year, month, day = match["Y"], match["M"], match["D"]
        year = f"20{year}" if len(year) == 2 else year
    else:
        year, month, day = match["c"], match["b"], match["a"]
        if not day_first:
            month, day = day, month
    # From 1970, so that nanoseconds fit 64 bits.
    return date(int(year), int(month), int(day)).toordinal() - 719_163


def _of_day(match: re.Match[str]) -> int:
    hour, minute, second = int(match["h"]), int(match["min"]), int(match["s"] or 0)
    if match["half"]:
        if not 1 <= hour <= 12:
            raise ValueError
        hour = hour % 12 + (12 if match["half"] in "Pp" else 0)
    if hour > 23 or minute > 59 or second > 60:  # a leap second is the 60th
        raise ValueError
    fraction = int((match["f"] or "0").ljust(9, "0"))
    zone = 0
    if match["sign"]:
        zone = (int(match["zh"]) * 60 + int(match["zm"])) * (-1 if match["sign"] == "+" else 1)
    return ((hour * 60 + minute + zone) * 60 + second) * _SECOND + fraction
