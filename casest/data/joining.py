"""One run of several files, `a.csv+b.csv`, each with a clock of its own.

The samples are those of the first file. What the others recorded is interpolated at its times,
within what they recorded: no gap is bridged. As it was recorded it is kept beside: it may be late.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeVar

import numpy as np

from casest.data.curves import Curve
from casest.data.finding import as_names, find_columns
from casest.data.logs import file_and_topics, file_name
from casest.data.matching import find_by_name
from casest.data.options import Options
from casest.data.run import Array, Run, Series
from casest.data.table import Table
from casest.data.timing import UNUSED
from casest.declaration.symbols import Signal
from casest.errors import DataError, UsageError
from casest.units import conversion

T = TypeVar("T")

#: Samples of the first file that the others must cover.
_FEWEST = 2


def stems(tables: Sequence[Table | Run]) -> list[str]:
    """What each file is called before the dot of a column: `phone.gyro_x`."""
    names = [file_and_topics(table.file)[0].stem for table in tables]
    total, seen, found = Counter(names), Counter[str](), list[str]()
    for name in names:
        seen[name] += 1
        found.append(name if total[name] == 1 else f"{name}#{seen[name]}")
    return found


def shared_out(
    tables: Sequence[Table], signals: Sequence[Signal], options: Options
) -> list[tuple[Table, tuple[Signal, ...], Options]]:
    """Each file with the signals that it holds, and what is said of its columns.

    Raises DataError for a signal that no file holds, or more than one; UsageError for a rate.
    """
    if options.rate is not None:
        raise UsageError(
            f"--rate {options.rate:g}: files joined by + have clocks of their own; leave it out, "
            "and name their time columns with --columns t=…"
        )
    said = [_said(table, stem, tables, options) for table, stem in _called(tables)]
    own: list[list[Signal]] = [[] for _ in tables]
    for signal in signals:
        # The run's time is the first file's.
        own[0 if signal.name == "t" else _holder(tables, signal, options, said)].append(signal)
    extra = [[n for n in options.extra if find_by_name(table, n)] for table in tables]
    extra[0] += [n for n in options.extra if not any(n in names for names in extra)]
    return [
        (
            table,
            tuple(mine),
            replace(
                options,
                columns=columns,
                extra=tuple(more),
                units=_of_file(options.units, stem),
                scales=_of_file(options.scales, stem),
            ),
        )
        for (table, stem), mine, columns, more in zip(
            _called(tables), own, said, extra, strict=True
        )
    ]


def _of_file(given: Mapping[str, T], stem: str) -> dict[str, T]:
    """What is said of one of the files: phone.t=ms is of phone.csv alone, and goes before t=s."""
    own = {n.removeprefix(f"{stem}."): v for n, v in given.items() if n.startswith(f"{stem}.")}
    return {**given, **own}


def _called(tables: Sequence[Table]) -> list[tuple[Table, str]]:
    return list(zip(tables, stems(tables), strict=True))


def _said(
    table: Table, stem: str, tables: Sequence[Table], options: Options
) -> dict[str, Sequence[str] | str]:
    """What --columns says of one of the files: NAME=phone.x,phone.y of phone.csv alone."""
    others = [other for _, other in _called(tables) if other != stem]
    found: dict[str, Sequence[str] | str] = {}
    for name, choice in options.columns.items():
        columns = as_names(choice)
        mine = [c for c in columns if c.startswith(f"{stem}.")]
        if mine and len(mine) < len(columns) and name != "t":  # each file has a time
            raise DataError(
                f"--columns {name}={','.join(columns)} names columns of two files: what belongs "
                "together is in one"
            )
        theirs = [c for c in columns if any(c.startswith(f"{other}.") for other in others)]
        if mine:
            found[name] = tuple(c.removeprefix(f"{stem}.") for c in mine)
        elif name == "t":
            free = [c for c in columns if c not in theirs]
            found |= {"t": tuple(free)} if free and _has(table, free, tables) else {}
        elif not theirs and (
            name not in ("run", "pose") or all(find_by_name(table, c) for c in columns)
        ):
            found[name] = choice
    return found


def _has(table: Table, columns: Sequence[str], tables: Sequence[Table]) -> bool:
    """Does a file have these columns? Positions are those of the first."""
    return all(find_by_name(table, c) or (c.isdigit() and table is tables[0]) for c in columns)


def _holder(
    tables: Sequence[Table],
    signal: Signal,
    options: Options,
    said: Sequence[Mapping[str, Sequence[str] | str]],
) -> int:
    """Which file holds a signal. Raises DataError where none does, or several."""
    holders: dict[int, tuple[str, ...]] = {}
    refused: list[DataError] = []
    for k, (table, columns) in enumerate(zip(tables, said, strict=True)):
        if signal.name in options.columns and signal.name not in columns:
            continue  # it is said to be in another file
        try:
            holders[k] = find_columns(table, signal, columns)
        except DataError as error:
            refused.append(error)
    if not holders:
        raise DataError("; ".join(str(error) for error in refused))
    if len(holders) > 1:
        names = stems(tables)
        ways = [
            f"--columns {signal.name}={','.join(f'{names[k]}.{c}' for c in columns)}"
            for k, columns in holders.items()
        ]
        files = " and ".join(tables[k].file for k in holders)
        raise DataError(f"{files} both have signal {signal.name}: say {' or '.join(ways)}")
    return next(iter(holders))


def joined(
    runs: Sequence[Run], signals: Sequence[Signal], time_zero: Literal["first", "column"]
) -> Run:
    """One run at the samples of the first, with what the others recorded at those times.

    Raises DataError where a file has no time, or the first has no sample that all others cover.
    """
    first, *others = runs
    time, *clocks = times_of(runs)
    time, clocks, notes = _common(runs, time, clocks)
    covered = np.ones(len(first), dtype=np.bool_)
    for run, clock in zip(others, clocks, strict=True):
        covered &= Curve.through(clock, clock[:, None], run.block).covers(time)
    names = "+".join(run.file for run in runs)
    if np.count_nonzero(covered) < _FEWEST:
        spans = [f"{r.file} {t[0]:g} to {t[-1]:g} s" for r, t in _paired(runs, [time, *clocks])]
        raise DataError(f"{names}: no time that all files recorded: {', '.join(spans)}")
    if not covered.all():
        lost = int(np.count_nonzero(~covered))
        notes.append(f"{lost} of {len(first)} samples dropped: not all files recorded then")
    zero = float(time[covered][0]) if time_zero == "first" else 0.0
    whole = _at(first.take(covered), time[covered] - zero)
    for run, clock in zip(others, clocks, strict=True):
        whole = _with_other(whole, run, clock - zero, signals)
    return replace(whole, file=names, notes=(*whole.notes, *notes))


def times_of(runs: Sequence[Run]) -> list[Array]:
    """The time of each file. Raises DataError where one has none."""
    for run in runs:
        if run.time is None:
            why = [note for note in run.notes if note.startswith(UNUSED)]
            if why:
                raise DataError(why[0].removeprefix(UNUSED))
            raise DataError(
                f"{run.file}: no time column: files joined by + need one each; give "
                f"--columns t={file_and_topics(run.file)[0].stem}.NAME, or both as t=NAME,"
                f"{file_and_topics(run.file)[0].stem}.NAME; it has {', '.join([*run.columns][:12])}"
            )
    return [np.asarray(run.time) for run in runs]


def _paired(runs: Sequence[Run], times: Sequence[Array]) -> list[tuple[Run, Array]]:
    return list(zip(runs, times, strict=True))


def _common(
    runs: Sequence[Run], time: Array, clocks: list[Array]
) -> tuple[Array, list[Array], list[str]]:
    """Times on one clock: as they are, or from each file's start where they have none in common."""
    every = [time, *clocks]
    if max(t[0] for t in every) < min(t[-1] for t in every):
        return time, clocks, []
    said = ", ".join(f"{run.file} at {t[0]:.9g} s" for run, t in _paired(runs, every))
    note = f"the clocks have no time in common: each file's first sample is taken as one ({said})"
    return time, [t - t[0] + time[0] for t in clocks], [note]


def _at(run: Run, time: Array) -> Run:
    """The run with its time moved, also where that is a signal."""
    signals = dict(run.signals)
    if "t" in signals:
        factor, _ = conversion("s", run.units["t"] or "s")
        signals["t"] = (time * factor)[:, None]
    return replace(run, signals=signals, time=time, whole=None, places=None)


def _with_other(whole: Run, run: Run, clock: Array, wanted: Sequence[Signal]) -> Run:
    """The run with what another file recorded at times `clock`; cut where that has a gap."""
    assert whole.time is not None
    signals, columns, elsewhere = dict(whole.signals), dict(whole.columns), dict(whole.elsewhere)
    column_units = dict(whole.column_units)
    stem = file_and_topics(run.file)[0].stem
    for name, one in _series(run, clock, wanted).items():
        curve = Curve.through(one.time, one.values, one.block, rotation=one.rotation)
        values = curve.at(whole.time, curve.nearest(whole.time))[0]
        if name in run.signals:
            signals[name], elsewhere[name] = values, one
            continue
        # Two columns of one name are told apart by their file.
        called = f"{stem}.{name}" if name in {*columns, *signals} else name
        columns[called], column_units[called] = values[:, 0], run.column_units.get(name)
        elsewhere[called] = one
    piece = Curve.through(clock, clock[:, None], run.block).nearest(whole.time)
    cuts = (np.diff(whole.block) != 0) | (np.diff(piece) != 0)
    return replace(
        whole,
        signals=signals,
        columns=columns,
        units={**whole.units, **run.units},
        column_units=column_units,
        elsewhere=elsewhere,
        block=np.cumsum(np.r_[False, cuts], dtype=np.int_),
        notes=(*whole.notes, *(f"{file_name(run.file)}: {note}" for note in run.notes)),
    )


def _series(run: Run, time: Array, wanted: Sequence[Signal]) -> dict[str, Series]:
    """What a file holds of signals and of columns with numbers, at times on the run's clock."""
    turned = {s.name for s in wanted if s.kind == "rotation"}
    found = {
        name: Series(run.file, time, values, run.block, name in turned)
        for name, values in run.signals.items()
    }
    for name, column in run.columns.items():
        if np.issubdtype(column.dtype, np.number):
            values = np.asarray(column, float)[:, None]
            found.setdefault(name, Series(run.file, time, values, run.block))
    return found
