"""Stamps of time as logs have them: rows in another order, and clocks that are too coarse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.data.timing import Array, counted
from casest.errors import DataError

#: Places by which a row that comes late may be off, and the share of such rows at most.
LATE, MANY = 20, 0.1
#: Rows from which on those of one stamp are a log's, and no repeats of a table; the share of steps
#: at least that go nowhere where a clock is coarse.
LOG, SHARED = 100, 0.1


def in_order(time: Array, rows: NDArray[np.int_]) -> tuple[NDArray[np.int_], str] | None:
    """How rows follow each other where a log begins with its end, wraps, or has some that come
    late, and what to say of that.

    time (N,), s, of these rows of a file. None where there is nothing to do, or no telling: where
    it starts again, the parts are records of their own, and a stamp far from its neighbours' is
    wrong.
    """
    back = np.flatnonzero(~(np.diff(time) > 0)) + 1
    if not back.size:
        return None
    order = np.argsort(time, kind="stable")
    if not (np.diff(time[order]) > 0).all():
        return None
    if back.size == len(time) - 1:
        return order, "the newest row comes first"
    if back.size == 1 and time[-1] < time[0]:
        return (
            order,
            f"the log wraps: it begins at row {rows[back[0]]}, behind which it was overwritten",
        )
    late = time < np.maximum.accumulate(time)
    away = np.abs(order - np.arange(len(order)))
    if away.max() > LATE or np.mean(late) > MANY:
        return None
    return order, f"{counted(int(late.sum()), 'row')} came late, the first row {rows[back[0]]}"


def within_stamps(time: Array) -> tuple[Array, str] | None:
    """Times (N,), s, of rows that a coarse clock gave one stamp, evenly over its step, and what to
    say of that; None where stamps go back, or where the clock is fine and a row is there twice."""
    steps = np.diff(time)
    again = steps == 0
    if len(time) < LOG or np.mean(again) < SHARED or (steps < 0).any() or again.all():
        return None
    tick, usual = float(steps[~again].min()), float(np.median(steps[~again]))
    if tick < 0.5 * usual:
        return None
    _, first, count = np.unique(time, return_index=True, return_counts=True)
    place = np.arange(len(time)) - np.repeat(first, count)
    spread = time + tick * place / np.repeat(count, count)
    shared = int(count[count > 1].sum())
    return spread, (
        f"its stamps are {tick:.6g} s apart, and {shared} of {len(time)} rows share one: these are "
        "taken as evenly spaced over it"
    )


def refuse_unordered(file: str, column: str, time: Array, rows: NDArray[np.int_]) -> None:
    """Raise DataError at the first row whose time does not exceed the one before."""
    wrong = np.flatnonzero(np.diff(time) <= 0)
    if wrong.size:
        at = int(wrong[0])
        what = "repeats" if time[at + 1] == time[at] else "goes backward from"
        again = int(np.sum(np.diff(time) == 0))
        some = f", {again} of which repeat a time" if 0 < again < wrong.size else ""
        raise DataError(
            f"{file}: column {column} row {rows[at + 1]}: time {time[at + 1]:.9g} s {what} "
            f"{time[at]:.9g} s in row {rows[at]} ({wrong.size} such rows{some}); mark "
            f"separate records with a column run, or give --rate HZ to count samples instead"
        )
