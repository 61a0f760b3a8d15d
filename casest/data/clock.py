"""The time of a table's rows: from a column, a stated rate, or an entry of the file."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest import units as unit_names
from casest.data import checks, stamps, timing
from casest.data.converting import numbers
from casest.data.finding import as_names, find_column
from casest.data.options import Options
from casest.data.run import Array
from casest.data.table import Table
from casest.declaration.symbols import Signal
from casest.errors import DataError, UnitError


@dataclass(frozen=True)
class Clock:
    """The time of all rows of a table in s, (n_rows,), and the columns that it comes from; None
    where no column tells it."""

    time: Array | None = None
    source: tuple[str, ...] = ()

    @property
    def _name(self) -> str:
        return " and ".join(self.source)

    def in_order(self, rows: NDArray[np.int_]) -> tuple[NDArray[np.int_], list[str]]:
        """The rows of a run as they followed each other, and a note where a file has another
        order."""
        if self.time is None:
            return rows, []
        there = rows[np.isfinite(self.time[rows])]
        found = stamps.in_order(self.time[there], there)
        if found is None:
            return rows, []
        order, why = found
        return there[order], [f"{self._name}: {why}; rows are taken in the order of time"]

    def of_run(
        self,
        table: Table,
        rows: NDArray[np.int_],
        complete: NDArray[np.bool_],
        signals: Sequence[Signal],
        options: Options,
    ) -> tuple[Array | None, list[str]]:
        """The time of one run in s, of its complete rows, and notes; None where nothing tells it.

        Its first sample is t = 0, unless the column's own zero is wanted.
        """
        time, notes = self._of_rows(table, rows, complete[rows], signals, options)
        if time is None:
            return None, notes
        time = time[complete[rows]]
        of_column = self.time is not None
        if time[0] == 0.0 or (of_column and options.time_zero == "column"):
            return time, notes
        said = f"time starts at {time[0]:.9g} s; that sample is t = 0"
        return time - time[0], [said, *notes] if of_column else notes

    def _of_rows(
        self,
        table: Table,
        rows: NDArray[np.int_],
        complete: NDArray[np.bool_],
        signals: Sequence[Signal],
        options: Options,
    ) -> tuple[Array | None, list[str]]:
        needed = any(is_time(signal) for signal in signals)
        if self.time is not None:
            return self._from_column(table, rows, complete, needed=needed)
        if options.rate is not None:
            return np.arange(len(rows)) / options.rate, []
        if stated := timing.rate_in_preamble(table):
            entry, rate = stated
            return np.arange(len(rows)) / rate, [f"time from the entry '{entry}': {rate:g} Hz"]
        if needed:
            listed = ", ".join(list(table.columns)[:12])
            likely = timing.first_increasing(table) or "NAME"
            raise DataError(
                f"{table.file}: no time column (t, time, timestamp) for signal t; the file has "
                f"{listed}; give --rate HZ or --columns t={likely}"
            )
        return None, []

    def _from_column(
        self, table: Table, rows: NDArray[np.int_], complete: NDArray[np.bool_], *, needed: bool
    ) -> tuple[Array | None, list[str]]:
        assert self.time is not None
        time = self.time[rows]
        # A row that is left out as written again has the stamp of the one before, if it is so.
        again = ~complete & np.concatenate([[False], np.diff(time) == 0])
        there = np.isfinite(time) & ~again
        try:
            stamps.refuse_unordered(table.file, self._name, time[there], rows[there])
        except DataError as error:
            if needed:
                raise
            found = stamps.within_stamps(time[there])
            if found is None:
                return None, [f"{timing.UNUSED}{error}"]
            spread, why = found
            time = time.copy()
            time[there] = spread
            return time, [f"{self._name}: {why}"]
        return time, timing.interruptions(self._name, time[there], rows[there])


def is_time(signal: Signal) -> bool:
    """Is a signal the time of the record?"""
    return signal.name == "t" and signal.size == 1 and signal.kind == "plain"


def clock_of(
    table: Table, signals: Sequence[Signal], options: Options, taken: Collection[str]
) -> tuple[Clock, list[str]]:
    """The time column in s, where there is one and no rate is given, and notes; `taken` are the
    columns of other signals."""
    needed = any(is_time(signal) for signal in signals)
    chosen = _chosen(table, options)
    names = chosen or timing.find_time(table)
    if not names or set(names) & set(taken):
        note = timing.kept_as_text(table) if not names else None
        if not (names or note or options.rate or timing.rate_in_preamble(table)):
            note = timing.unnamed(table, taken)
        return Clock(), [note] if note else []
    if options.rate is not None:
        listed = " and ".join(names)
        note = f"time column {listed} not used: rate {options.rate:g} Hz is given"
        return Clock(None, names), [note]
    try:
        time, notes = _seconds(table, names, signals, options)
    except (UnitError, DataError) as error:
        if needed or chosen:
            if isinstance(error, DataError):
                raise
            raise UnitError(
                f"{table.file}: column {names[0]} as time: {error}; "
                f"name another column with --columns t=… or say its unit with --unit t=…"
            ) from error
        return Clock(None, names), [f"{timing.UNUSED}{error}"]
    return Clock(time, names), notes


def _chosen(table: Table, options: Options) -> tuple[str, ...]:
    """The columns that the user names as the time: one, or a date and a time of day."""
    if "t" not in options.columns:
        return ()
    given = as_names(options.columns["t"])
    names = tuple(find_column(table, name, "time") for name in given[:2])
    if len(given) > 2 or (len(names) == 2 and not all(table.columns[n].is_text for n in names)):
        raise DataError(
            f"{table.file}: --columns t={','.join(given)} must name one column, or one of dates "
            f"and one of times of day"
        )
    return names


def _seconds(
    table: Table, names: tuple[str, ...], signals: Sequence[Signal], options: Options
) -> tuple[Array, list[str]]:
    """The time in s, (n_rows,), and what was assumed."""
    columns = tuple(table.columns[name] for name in names)
    if any(column.is_text for column in columns):
        return timing.from_text(table, columns), [f"time from {' and '.join(names)}"]
    needed = any(is_time(signal) for signal in signals) or "t" in options.columns
    numbers(table, columns[0], "time", "--columns t=… or --rate HZ", gaps=needed)
    stated = timing.time_units_declared(options.units, names[0])
    scale = options.scales.get(names[0]) or options.scales.get("t")
    time, notes = timing.seconds(table, columns[0], stated, scale)
    checks.refuse_too_large(table.file, "the time", names[0], time)
    return time, notes


def with_time(
    signals: dict[str, Array], time: Array | None, wanted: Sequence[Signal]
) -> dict[str, Array]:
    """Put the time signal in, in the order in which the model declares its signals."""
    ordered: dict[str, Array] = {}
    for signal in wanted:
        if not is_time(signal):
            ordered[signal.name] = signals[signal.name]
        elif time is not None:
            factor, _ = unit_names.conversion("s", signal.unit or "s")
            ordered[signal.name] = (time * factor)[:, None]
    return ordered


def time_unit(signals: Sequence[Signal]) -> dict[str, str | None]:
    """That of the time signal, as the model works in it."""
    return {s.name: unit_names.canonical(s.unit or "s") for s in signals if is_time(s)}
