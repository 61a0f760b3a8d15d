"""From files to runs: columns matched to a model's signals, units converted, rows grouped."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest import units as unit_names
from casest.data import checks, timing
from casest.data.clock import Clock, clock_of, is_time, time_unit, with_time
from casest.data.converting import numbers, rotation, vector
from casest.data.finding import Choice, also_missing, as_names, find_column, find_columns
from casest.data.frames import is_frame
from casest.data.joining import joined, shared_out
from casest.data.logs import file_and_topics, parts_of
from casest.data.matching import find_by_name
from casest.data.merging import merged, one_clock_each
from casest.data.options import Options, refuse_unknown_names, stated_units
from casest.data.renewing import Renewed, renewed, whole_rows_again
from casest.data.rest import at_rest as averaged_at_rest
from casest.data.run import Array, Labels, Run
from casest.data.scaling import parse_scale
from casest.data.table import Table, read_table, table_of
from casest.declaration.symbols import Signal
from casest.errors import DataError, UsageError

Path_ = str | os.PathLike[str]
#: A table in memory: a data frame of any library, a mapping of arrays, an array.
Frame = Any


class _Met(NamedTuple):
    """Values (N, size) of a signal in one run, with the columns of its file."""

    file: str
    columns: tuple[str, ...]
    values: Array


@dataclass(frozen=True)
class _Bound:
    """One table matched to the signals, before its rows are grouped; all arrays have its length."""

    signals: dict[str, Array]
    units: dict[str, str | None]
    sources: dict[str, tuple[str, ...]]
    clock: Clock
    notes: list[str]


def load_runs(
    paths: Sequence[Path_ | Frame] | Path_ | Frame,
    signals: Mapping[str, Signal] | Iterable[Signal],
    *,
    columns: Choice | None = None,
    units: Mapping[str, str] | None = None,
    scales: Mapping[str, str] | None = None,
    rate: float | None = None,
    at_rest: bool | Sequence[str] = False,
    extra: Sequence[str] = (),
    time_zero: Literal["first", "column"] = "first",
    gaps: Sequence[str] = (),
    between: Sequence[str] | None = None,
    steady: Sequence[str] = (),
) -> tuple[Run, ...]:
    """Read files and bind their columns to `signals`: one run per file and `run` label.

    In place of a file stands also a data frame (pandas, polars, PyArrow, xarray), a mapping of
    arrays by name or an array of numbers (N, k), whose columns are 0 to k - 1.

    A path `a.csv+b.csv` is one run of two files, each with a clock of its own: at the samples of a,
    within what b recorded too, the columns of b are interpolated.

    * columns: per signal its columns by name or position, {"v": ("ax", "ay", "az")}, with a unit
      behind the last where the header has none, {"v": "ax,ay,az [g]"}; also "t", "run" and "pose"
      where those columns are called otherwise.
    * units: per signal or column the unit of its values, where the file states none or a wrong one.
    * scales: per signal or column how raw counts become values, {"temp": "int16/256+25"}.
    * rate: samples per second, instead of a time column or a rate stated above the table.
    * at_rest: average the rest intervals; names of further columns that must be at rest too.
    * extra: columns that must be there; like a signal's, their empty cells cost the row, and the
      run calls them as they are called here.
    * gaps: signals whose cells may be empty; a reading that is missing is NaN in the run.
    * between: inputs of an estimator in motion, whose signals may have clocks of their own: where
      one has no sample it is a straight line, or held. The samples of a.csv+b.csv are then those of
      all files, every reading at the time when it was made.
    * steady: signals that may be the same in all rows, which is a dead channel's sign otherwise.
    * time_zero: "first" makes each run's first sample t = 0, "column" keeps the column's own zero.

    A row in which a signal, the time of a model that needs it or an extra column has no number
    (empty, nan) is dropped; the run's notes count them. Where `gaps` are allowed none is: the other
    signals need all their numbers. What is neither empty nor a number is refused.

    Raises DataError, UnitError or UsageError naming file, column, row, value and the way out.
    """
    for name, said in (("columns", columns), ("units", units), ("scales", scales)):
        _refuse_no_mapping(name, said)
    wanted = tuple(signals.values() if isinstance(signals, Mapping) else signals)
    listed = listed_data(paths)
    if not listed:
        raise UsageError("no data file given; name at least one")
    options = Options(
        dict(columns or {}),
        stated_units(columns, units),
        {name: parse_scale(text) for name, text in (scales or {}).items()},
        None if rate is None else timing.checked_rate(rate),
        time_zero,
        tuple(extra),
        frozenset(gaps) | frozenset(between or ()),
        None if between is None else frozenset(between),
        frozenset(steady),
    )
    groups = [_tables(given, k if len(listed) > 1 else None) for k, given in enumerate(listed)]
    refuse_unknown_names([table for tables in groups for table in tables], wanted, options)
    met = dict[str, list[_Met]]()
    runs = [run for tables in groups for run in _group_runs(tables, wanted, options, met)]
    _refuse_dead(met)
    runs = _named_apart(runs)
    if at_rest is not False:
        also = () if at_rest is True else tuple(at_rest)
        wanders = [s.name for s in wanted if s.wanders]
        runs = [averaged_at_rest(run, also=also, wanders=wanders) for run in runs]
    return tuple(runs)


def _refuse_no_mapping(name: str, said: object) -> None:
    """A list of columns does not say of which signal they are."""
    if said is not None and not isinstance(said, Mapping):
        raise UsageError(
            f"{name}={said!r:.60} is of type {type(said).__name__}, and does not say what it is "
            f'of: give a mapping from signals, like {name}={{"v": {said!r:.60}}}'
        )


def listed_data(given: Any) -> list[Any]:
    """Files and tables, one or several, as a list; UsageError where it is neither."""
    if isinstance(given, str | os.PathLike | Table) or is_frame(given):
        return [given]
    found = list(given) if isinstance(given, Iterable) else [given]
    for one in found:
        if not (isinstance(one, str | os.PathLike | Table) or is_frame(one)):
            raise UsageError(
                f"the data hold {one!r:.40}, of type {type(one).__name__}: give files, data "
                "frames, mappings of arrays by name, or arrays of numbers"
            )
    return found


def _tables(given: Any, place: int | None) -> list[Table]:
    """The tables of one entry: of the files that a + joins, or of a frame, called by its place."""
    if isinstance(given, Table):
        return [given]
    if isinstance(given, str | os.PathLike):
        return [read_table(part) for part in parts_of(given)]
    kind = type(given).__name__
    return [table_of(given, kind if place is None else f"{kind} {place}")]


def _refuse_dead(met: Mapping[str, Sequence[_Met]]) -> None:
    """Refuse a signal that is one value in all runs: another one in each is a run's setting."""
    for name, every in met.items():
        values = [one.values for one in every]
        if all(checks.constant(v) and np.array_equal(v[0], values[0][0]) for v in values):
            checks.refuse_constant(every[0].file, name, values[0], every[0].columns)


def _group_runs(
    tables: Sequence[Table],
    signals: Sequence[Signal],
    options: Options,
    met: dict[str, list[_Met]],
) -> list[Run]:
    """The runs of one file, or the one run of several files; adds what their signals `met`."""
    if len(tables) == 1:
        runs = _runs(tables[0], signals, options, met)
        return [one_clock_each(run, signals, options) for run in runs]
    apart = replace(options, time_zero="column")
    parts = []
    for table, own, chosen in shared_out(tables, signals, apart):
        runs = _runs(table, own, chosen, met)
        if len(runs) > 1:
            raise DataError(
                f"{table.file}: holds {len(runs)} runs, and files joined by + are one: give the "
                "runs in files of their own"
            )
        parts += runs
    if options.between is not None:
        return [merged(parts, signals, options)]
    return [joined(parts, signals, options.time_zero)]


def _runs(
    table: Table, signals: Sequence[Signal], options: Options, met: dict[str, list[_Met]]
) -> list[Run]:
    """Bind one table and cut it into its runs."""
    bound = _bind(table, signals, options)
    groups = {kind: _group(table, kind, options) for kind in ("run", "pose")}
    sources = {name for names in bound.sources.values() for name in names}
    clock = bound.clock
    dates = {name for name in clock.source if table.columns[name].is_text}
    sources |= {name for name in (*clock.source, *groups.values()) if name} - dates
    plain = {bound.sources[s.name] for s in signals if s.kind == "plain" and not is_time(s)}
    repeated = _without_repeats(bound, options)
    complete, dropped = _complete(table, bound, options, plain)
    dropped = [*dropped, *repeated]
    others, other_units, notes = _others(table, sources, options, complete)
    labels = _labels(table, groups["run"])
    pose = _labels(table, groups["pose"])
    stem = file_and_topics(table.file)[0].stem
    runs = []
    in_order: list[Any] = [None] if labels is None else _in_order(labels)
    if labels is not None:
        empty = [label for label in in_order if not complete[labels == label].any()]
        in_order = [label for label in in_order if label not in empty]
        notes += [f"run {label} left out: none of its rows is complete" for label in empty]
    for label in in_order:
        every = np.arange(table.n_rows) if labels is None else np.flatnonzero(labels == label)
        every, order_notes = clock.in_order(every)
        rows = every[complete[every]]
        part = {name: values[rows] for name, values in bound.signals.items()}
        time, time_notes = clock.of_run(table, every, complete, signals, options)
        used = time is not None and options.rate is None  # dates that are no time are labels
        run = Run(
            name=stem if label is None else f"{stem}:{label}",
            file=table.file,
            signals=with_time(part, time, signals),
            units=bound.units | time_unit(signals),
            columns={n: values[rows] for n, values in others.items() if not (n in dates and used)},
            column_units=other_units,
            time=time,
            rows=rows,
            block=timing.blocks(time, None if pose is None else pose[rows], rows - every[0]),
            count=np.ones(len(rows), dtype=np.int_),
            spread={},
            called=bound.sources,
            notes=(*table.notes, *bound.notes, *dropped, *notes, *order_notes, *time_notes),
        )
        varying = [s for s in signals if s.name not in options.steady]
        runs.append(_checked(run, varying, bound.sources, met))
    return runs


def _bind(table: Table, signals: Sequence[Signal], options: Options) -> _Bound:
    """Find, scale and convert the columns of every signal but time."""
    found = _Bound({}, {}, {}, Clock(), [])
    read = [signal for signal in signals if not is_time(signal)]
    for k, signal in enumerate(read):
        try:
            names = find_columns(table, signal, options.columns)
        except DataError as error:
            if signal.name in options.columns:
                raise
            more = also_missing(table, read[k + 1 :], options.columns, str(error))
            raise DataError(f"{error}{more}") from None
        found.sources[signal.name] = names
        if signal.kind == "rotation":
            values, notes = rotation(table, signal, names, options)
            found.units[signal.name] = None
        else:
            values, unit, notes = vector(table, signal, names, options)
            found.units[signal.name] = unit
        found.signals[signal.name] = values
        found.notes.extend(notes)
    for name in options.extra:
        column = table.columns[find_column(table, name, "the model")]
        numbers(table, column, f"column {name}", f"--columns {name}=…", gaps=True)
    taken = {name for names in found.sources.values() for name in names}
    clock, notes = clock_of(table, signals, options, taken)
    return replace(found, clock=clock, notes=[*found.notes, *_shared(found.sources), *notes])


def _shared(sources: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """A note on signals that are the same column: one told by itself is told exactly."""
    for one, other in combinations(sources, 2):
        if sources[one] == sources[other]:
            yield f"{one} and {other} are one column, {' '.join(sources[one])}"


def _complete(
    table: Table, bound: _Bound, options: Options, plain: Collection[tuple[str, ...]]
) -> tuple[NDArray[np.bool_], list[str]]:
    """Which rows have every number that matters, and a note on those that have not.

    `plain`: sources of signals that are no attitudes: these are commanded, and stand still.
    """
    needed = {name: bound.sources[name] for name in bound.signals if name not in options.gaps}
    parts = {names: bound.signals[name] for name, names in needed.items()}
    if bound.clock.time is not None and bound.clock.source:
        parts[bound.clock.source] = bound.clock.time[:, None]
    for name in options.extra:
        found = find_column(table, name, "the model")
        parts[(found,)] = np.asarray(table.columns[found].values, dtype=np.float64)[:, None]
    complete = np.ones(table.n_rows, dtype=np.bool_)
    said = []
    for names, values in parts.items():
        absent = np.isnan(values).any(axis=1)
        if absent.any():
            first = int(np.flatnonzero(absent)[0])
            said.append(f"{int(absent.sum())} without {' '.join(names)}, the first row {first}")
        again = checks.stalled(values) if names in plain else np.zeros_like(absent)
        if again.any():
            first = int(np.flatnonzero(again)[0])
            said.append(
                f"{int(again.sum())} repeat {' '.join(names)} as no others do (a logger that "
                f"waits, or no reading), the first row {first}"
            )
        complete &= ~(absent | again)
    twice = _rows_again(table, bound, options)
    if twice is not None:
        first = int(np.flatnonzero(twice)[0])
        said.append(
            f"{int(twice.sum())} repeat all that is recorded of the row before: written again, "
            f"they are no readings, the first row {first}"
        )
        complete &= ~twice
    for slow in _slowest(bound, options, plain) if twice is None else []:
        said.append(str(slow))
        complete &= ~slow.again
    if not said:
        return complete, []
    left = table.n_rows - int(complete.sum())
    note = f"{left} of {table.n_rows} rows dropped: {'; '.join(said)}"
    if left == table.n_rows:
        raise DataError(
            f"{table.file}: no row has every number that is needed ({note}); choose other columns "
            f"with --columns, or repair the export"
        )
    return complete, [note]


def _slowest(
    bound: _Bound, options: Options, several: Collection[tuple[str, ...]]
) -> list[Renewed]:
    """The source that is written longest before it is new, if any.

    Without a time rows in twos and threes are repeats of a table. Outputs that may be missing are
    so where they are no readings; inputs beside them are known in every row.
    """
    if options.gaps or (bound.clock.time is None and options.rate is None):
        return []
    sources = {bound.sources[n]: v for n, v in bound.signals.items() if bound.sources[n] in several}
    return sorted(renewed(sources), key=lambda one: -one.rows)[:1]


def _rows_again(table: Table, bound: _Bound, options: Options) -> NDArray[np.bool_] | None:
    """Rows of a log that are written again as a whole; of a table they are repeats."""
    if options.gaps or (bound.clock.time is None and options.rate is None):
        return None
    columns = (c for name, c in table.columns.items() if name not in bound.clock.source)
    return whole_rows_again(
        np.asarray(c.values, float) for c in columns if not c.is_text and c.bad is None
    )


def _without_repeats(bound: _Bound, options: Options) -> list[str]:
    """Outputs that may be missing are so where the reading before is written again: says which."""
    outputs = {bound.sources[n]: n for n in sorted(options.gaps & set(bound.signals))}
    found = list(renewed({source: bound.signals[n] for source, n in outputs.items()}))
    for one in found:
        values = bound.signals[outputs[one.source]]
        bound.signals[outputs[one.source]] = np.where(one.again[:, None], np.nan, values)
    return [f"of {one.again.size} rows {one}" for one in found]


def _group(table: Table, kind: str, options: Options) -> str | None:
    """Return the column that groups rows into runs or poses."""
    if kind in options.columns:
        return find_column(table, as_names(options.columns[kind])[0], f"group {kind}")
    return find_by_name(table, kind)


def _labels(table: Table, name: str | None) -> Array | Labels | None:
    if name is None:
        return None
    column = table.columns[name]
    if column.bad is not None:
        raise DataError(f"{table.file}: column {name} {column.bad}; every row needs its {name}")
    return column.values


def _in_order(labels: Array | Labels) -> list[float | int | str]:
    _, first = np.unique(labels, return_index=True)
    found = labels[np.sort(first)].tolist()
    # a run called 1, not 1.0
    return [int(x) if isinstance(x, float) and x.is_integer() else x for x in found]


def _others(
    table: Table, used: set[str], options: Options, complete: NDArray[np.bool_]
) -> tuple[dict[str, Array | Labels], dict[str, str | None], list[str]]:
    """Return the columns that no signal takes: each may be the cause of a residual."""
    columns: dict[str, Array | Labels] = {}
    units: dict[str, str | None] = {}
    notes = []
    called = {find_column(table, name, "the model"): name for name in options.extra}
    for name, column in table.columns.items():
        if name in used:
            continue
        if column.bad is not None and np.isnan(np.asarray(column.values, float)[complete]).any():
            notes.append(f"column {name} left out: {column.bad}")
            continue
        values, unit = column.values, options.units.get(name, column.unit)
        if not column.is_text and np.abs(np.asarray(values, float)[complete]).max() > checks.MOST:
            notes.append(f"column {name} left out: it holds numbers too large to compute with")
            continue
        if name in options.scales:
            values = options.scales[name].apply(np.asarray(values, float), table.file, name)
            unit = None if unit == column.unit and unit in ("count", "raw", "LSB") else unit
        columns[called.get(name, name)] = values
        units[called.get(name, name)] = (
            unit_names.canonical(unit) if unit and unit_names.known(unit) else None
        )
    return columns, units, notes


def _checked(
    run: Run,
    signals: Sequence[Signal],
    sources: Mapping[str, tuple[str, ...]],
    met: dict[str, list[_Met]],
) -> Run:
    """Note components that are dead or clipped; and what the signals `met`, to be looked at in all
    runs."""
    notes: list[str] = []
    for signal in signals:
        if is_time(signal) or signal.kind == "rotation":
            continue
        values, columns = run.signals[signal.name], sources[signal.name]
        values = checks.without_gaps(values)
        met.setdefault(signal.name, []).append(_Met(run.file, columns, values))
        others = [
            run.signals[s.name]
            for s in signals
            if s is not signal and s.kind == "plain" and not is_time(s)
        ]
        beside = np.column_stack(others) if others and len(values) == len(run) else None
        notes += checks.constant_columns(values, columns)
        notes += checks.clipped(values, columns, beside)
        notes += checks.wild(run.signals[signal.name], columns, run.rows, beside)
    return replace(run, notes=(*run.notes, *notes))


def _named_apart(runs: Sequence[Run]) -> list[Run]:
    """Give runs of the same name (imu.csv in two folders) a number."""
    total, seen = Counter(run.name for run in runs), Counter[str]()
    named = []
    for run in runs:
        seen[run.name] += 1
        name = run.name if total[run.name] == 1 else f"{run.name}#{seen[run.name]}"
        named.append(replace(run, name=name))
    return named
