"""One long record in partitions: a Parquet data set whose rows are the samples of one run, or
tables that a function makes one after the other.

Signals are put once, in the model's units, into files of plain numbers that are mapped into memory.
What computes runs through these piece by piece, so that a record may be larger than memory.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from casest.data import checks, stamps, timing
from casest.data.bind import load_runs
from casest.data.clock import is_time
from casest.data.run import Run
from casest.data.table import Table, table_of
from casest.dataset.files import File, files_of, opened, unreadable
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import CasestError, DataError
from casest.units import conversion

#: Samples that are read at once.
BATCH = 262_144
#: A file for samples that nobody counted grows by this factor.
GROWS = 1.5
#: Notes of batches that are kept: each may have one of its own.
NOTES = 8


def mapped_record(
    dataset: str,
    signals: Sequence[Signal],
    folder: Path,
    *,
    kept: Sequence[str] | None = (),
    parts: Callable[[], Iterable[Any]] | None = None,
    **reading: Any,
) -> Run:
    """The run that a data set (a Parquet file, folder or pattern) holds, in the files' order.

    `folder` takes one file of numbers for each signal, for the time and for the `kept` columns
    (None: all that are numbers), and must stay as long as the run; `reading` as in `load_runs`.
    `parts` makes the tables in place of files (data frames, mappings of arrays: see `table_of`),
    one after the other. Raises DataError as `load_runs` does, with rows counted in each file or
    part; where the folder has not enough room; where the data set holds several runs.
    """
    files = () if parts is not None else files_of(dataset)
    total = sum(int(opened(file).metadata.num_rows) for file in files)
    columns = None if kept is None else tuple(kept)
    made = _Mapped(dataset, tuple(signals), folder, total, columns)
    for first, table in _batches(files) if parts is None else _made_by(parts, dataset):
        try:
            made.take(_bound(table, made.signals, reading), reading.get("rate"))
        except CasestError as error:
            since = f" (rows are counted from row {first} of the file)" if first else ""
            raise type(error)(f"{error}{since}") from None
    return made.run(reading.get("time_zero", "first"))


def _made_by(parts: Callable[[], Iterable[Any]], name: str) -> Iterator[tuple[int, Table]]:
    """The tables that a function of the user's makes."""
    count = 0
    try:
        for part in parts():
            table = table_of(part, f"{name}, part {count}")
            count += 1
            yield 0, table
    except (CasestError, GeneratorExit):
        raise
    except Exception as error:  # whatever a function of the user's raises
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise DataError(f"{name}, part {count}: {type(error).__name__}: {text}") from error


def _batches(files: Sequence[File]) -> Iterator[tuple[int, Table]]:
    """Rows of every file as tables, each with the number of its first one in the file."""
    import pyarrow

    for file in files:
        first = 0
        try:
            for batch in opened(file).iter_batches(BATCH):
                if batch.num_rows:
                    table = pyarrow.Table.from_batches([batch])
                    yield first, table_of(table, file.name)
                first += batch.num_rows
        except (OSError, pyarrow.ArrowException) as error:
            raise unreadable(file, error) from error


def _bound(table: Table, signals: Sequence[Signal], reading: Mapping[str, Any]) -> Run:
    """The samples of one table, their time as it is written."""
    # What is still in one part of a record may move in another.
    steady = [s.name for s in signals]
    given = {**reading, "time_zero": "column", "at_rest": False, "steady": steady}
    runs = load_runs([table], signals, **given)
    if len(runs) != 1:
        raise DataError(
            f"{table.file}: holds {len(runs)} runs, and --partitions is for one record; leave the "
            "column run out, or give each run as a file of its own"
        )
    return runs[0]


@dataclass
class _Mapped:
    """A record on the way into mapped files: `count` of its `total` rows at most."""

    dataset: str
    signals: tuple[Signal, ...]
    folder: Path
    total: int
    columns: tuple[str, ...] | None
    count: int = 0
    files: int = 0
    values: dict[str, Any] = field(default_factory=dict)
    low: dict[str, Array] = field(default_factory=dict)
    high: dict[str, Array] = field(default_factory=dict)
    units: Mapping[str, str | None] = field(default_factory=dict)
    column_units: Mapping[str, str | None] = field(default_factory=dict)
    notes: Counter[str] = field(default_factory=Counter)
    usual: float = 0.0
    blocks: int = 0

    def take(self, run: Run, rate: float | None) -> None:
        """The samples of one batch."""
        where = slice(self.count, self.count + len(run))
        if where.stop > self.total:
            self._grow(where.stop)
        self.units, self.column_units = run.units, run.column_units
        self.notes.update(run.notes)
        for s in self.signals:
            if not is_time(s):
                self._put(s.name, run.signals[s.name], where)
        if self.columns is None:
            numbers = {n for n, v in run.columns.items() if np.issubdtype(v.dtype, np.number)}
            self.columns = tuple(n for n in run.columns if n in numbers)
        for name in self.columns:
            if name not in run.columns:
                raise DataError(f"{run.file}: no column {name!r}, which an effect reads")
            self._put(f"column {name}", np.asarray(run.columns[name], float)[:, None], where)
        time = run.time
        if rate is not None:
            time = (self.count + np.arange(len(run))) / rate
        if time is not None:
            self._follow(run, time, where)
        self.count += len(run)

    def _put(self, name: str, values: Any, where: slice) -> None:
        if name not in self.values:
            self.values[name] = self._made(name, values.shape[1], values.dtype)
        self.values[name][:, where] = values.T
        low, high = values.min(axis=0), values.max(axis=0)
        self.low[name] = np.minimum(self.low.get(name, low), low)
        self.high[name] = np.maximum(self.high.get(name, high), high)

    def _made(self, name: str, size: int, kind: Any) -> Any:
        """A file for so many numbers of every sample, (size, total)."""
        path, need = self.folder / str(self.files), 8 * size * self.total
        self.files += 1
        try:
            with path.open("wb") as file:
                file.truncate(need)
                if hasattr(os, "posix_fallocate"):  # a full disk shows here, not while computing
                    os.posix_fallocate(file.fileno(), 0, need)
        except OSError as error:
            raise DataError(
                f"{self.folder}: no room for {need / 1e9:.3g} GB of {name} ({error.strerror}); "
                "TMPDIR names another folder"
            ) from None
        return np.memmap(path, kind, "r+", shape=(size, self.total))

    def _grow(self, least: int) -> None:
        """Room for more samples than were counted, of all that is there already."""
        self.total = max(least, int(GROWS * self.total))
        for name, old in self.values.items():
            new = self._made(name, len(old), old.dtype)
            new[:, : self.count] = old[:, : self.count]
            self.values[name] = new
            Path(old.filename).unlink()

    def _follow(self, run: Run, time: Array, where: slice) -> None:
        """Put the time, which must go on, and count the gaps."""
        if self.count:
            before = float(self.values["the time"][0, self.count - 1])
            stamps.refuse_unordered(run.file, "of the time", np.array([before, time[0]]),
                                    np.array([-1, 0]))  # fmt: skip
        else:
            before = float(time[0])
            self.usual = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        starts = np.diff(time, prepend=before) > timing.GAP * self.usual
        self._put("the time", time[:, None], where)
        if starts.any() or "the block" in self.values:
            self._put("the block", (self.blocks + np.cumsum(starts))[:, None], where)
        self.blocks += int(starts.sum())

    def run(self, zero: str) -> Run:
        """All of it as one run."""
        if not self.count:
            raise DataError(f"{self.dataset}: holds no sample; check the export")
        found = {name: values[:, : self.count].T for name, values in self.values.items()}
        time, block = found.pop("the time", None), found.pop("the block", None)
        if time is not None and zero == "first":
            time -= float(time[0, 0])
        signals, units = {}, dict(self.units)
        for s in self.signals:
            if not is_time(s):
                signals[s.name] = found[s.name]
                self._refuse_still(s)
            elif time is not None:
                factor, _ = conversion("s", s.unit or "s")
                signals[s.name] = time if factor == 1.0 else time * factor
        run = Run.raw(
            Path(self.dataset).stem, signals, units=units, file=self.dataset,
            time=None if time is None else time[:, 0], notes=self._said(),
        )  # fmt: skip
        run = run if block is None else replace(run, block=block[:, 0])
        own = {name: found[f"column {name}"][:, 0] for name in self.columns or ()}
        return replace(run, columns=own, column_units={n: self.column_units.get(n) for n in own})

    def _refuse_still(self, signal: Signal) -> None:
        if signal.kind != "rotation":
            ends = np.stack([self.low[signal.name], self.high[signal.name]])
            checks.refuse_constant(self.dataset, signal.name, ends, (signal.name,))

    def _said(self) -> tuple[str, ...]:
        kept = list(self.notes)[:NOTES]
        more = len(self.notes) - len(kept)
        gaps = [f"{self.blocks} gaps in time"] if self.blocks else []
        left = [f"and {more} more notes of single partitions"] if more else []
        return (*kept, *gaps, *left)
