"""Readings of a partition, some sensors at a time: columns as they stand, then signals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data import timing
from casest.data.converting import columns_of, rotation
from casest.data.options import Options
from casest.data.table import Table
from casest.dataset.files import opened, unreadable
from casest.dataset.layout import Layout, Readings, is_time, table_of
from casest.dataset.names import empty, numbers_of, plain, text
from casest.dataset.partitions import Piece
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import CasestError, DataError

#: Numbers of readings that are held at once, as they come from a file.
HELD = 1_000_000
#: Sensors that are held at once at least, however long their records.
FEWEST = 32


@dataclass
class Block:
    """S sensors: names (Arrow), how many readings each has (S,), and their columns one after the
    other by header; `kept` columns (Arrow, S each); `rows` in the file; `bad`: why a sensor cannot
    be used, by place."""

    file: str
    names: Any
    counts: NDArray[np.int64]
    columns: dict[str, Array]
    kept: dict[str, Any]
    rows: NDArray[np.int64]
    bad: dict[int, str]


def blocks(layout: Layout, pieces: Sequence[Piece]) -> Iterator[Block]:
    """The sensors of pieces that belong `together`, in their order, some at a time.

    Raises DataError where a file cannot be read any more, or ends too early.
    """
    try:
        yield from _wide(layout, pieces[0]) if layout.wide else _long(layout, pieces)
    except CasestError:
        raise
    except Exception as error:  # a damaged file can fail anywhere in the library
        raise unreadable(pieces[0].file, error) from error


def bound(
    block: Block, layout: Layout, signals: Sequence[Signal], options: Options
) -> dict[str, Array]:
    """Every signal of the block in the model's units, (readings, size), one sensor after the other.

    A sensor whose readings cannot be converted is put among the bad ones; its numbers are NaN.
    """
    places = np.arange(len(block.counts))
    # In memory each column lies by itself, as in the file.
    found = {s.name: np.empty((s.size, int(block.counts.sum()))).T for s in signals}
    ends = np.concatenate([[0], np.cumsum(block.counts)])
    _fill(found, block, places, ends, _Binding(layout, tuple(signals), options))
    return found


# -- from a file -----------------------------------------------------------------------------------


def together(pieces: Sequence[Piece], layout: Layout) -> Iterator[list[Piece]]:
    """Pieces one by one; in long form those of one sensor, which its folder names, together."""
    held: list[Piece] = []
    for piece in pieces:
        if held and (layout.wide or piece.name is None or piece.name != held[-1].name):
            yield held
            held = []
        held.append(piece)
    if held:
        yield held


def _batches(layout: Layout, piece: Piece, rows: int) -> Iterator[tuple[int, Any]]:
    """Row in the file and record batches of at most `rows` rows of a piece."""
    table = opened(piece.file)
    about, first = table.metadata, 0
    groups = []
    for k in range(about.num_row_groups):
        stop = first + about.row_group(k).num_rows
        if first < piece.stop and stop > piece.first:
            groups.append((k, first))
        first = stop
    if not groups:
        return
    row = groups[0][1]
    for batch in table.iter_batches(
        rows, row_groups=[k for k, _ in groups], columns=layout.columns, use_threads=False
    ):
        a, b = max(piece.first - row, 0), min(piece.stop - row, len(batch))
        if b > a:
            yield row + a, batch.slice(a, b - a)
        row += len(batch)
        if row >= piece.stop:
            return
    raise DataError(f"{piece.file.name}: ends at row {row}, and announced more; copy it again")


def _wide(layout: Layout, piece: Piece) -> Iterator[Block]:
    """One row for each sensor."""
    rows = max(FEWEST, round(HELD / _numbers_each(layout, piece)) // FEWEST * FEWEST)
    for row, batch in _batches(layout, piece, min(rows, 1 << 16)):
        yield wide_block(layout, piece, row, batch)


def _numbers_each(layout: Layout, piece: Piece) -> float:
    """Numbers of readings that a row of the file has, mean, by what the file says of itself."""
    about, fields = opened(piece.file).metadata, {r.field for r in layout.readings}
    numbers = 0
    for k in range(about.num_row_groups):
        group = about.row_group(k)
        columns = (group.column(j) for j in range(group.num_columns))
        numbers += sum(c.num_values for c in columns if c.path_in_schema.split(".")[0] in fields)
    return float(max(numbers / max(about.num_rows, 1), 1.0))


def wide_block(layout: Layout, piece: Piece, row: int, batch: Any) -> Block:
    """The sensors of a record batch with one row for each, which begins at a row of its file."""
    import pyarrow

    if piece.name is None:
        names = plain(batch.column(layout.sensor))
    else:
        names = pyarrow.array([piece.name] * len(batch), pyarrow.large_string())
    lengths = np.stack([_lengths(batch.column(r.field)) for r in layout.readings])
    bad: dict[int, str] = {}
    for k in np.flatnonzero((lengths != lengths[0]).any(axis=0) | (lengths[0] < 1)):
        bad[int(k)] = _ragged(layout, lengths[:, k])
    vectors = [r for r in layout.readings if r.size]
    for r in vectors:
        _refuse_ragged_vectors(batch.column(r.field), r, bad)
    counts = lengths[0].copy()
    if bad:
        good = np.ones(len(batch), bool)
        good[[*bad]] = False
        counts[~good] = 0
        whole, batch = batch, batch.filter(pyarrow.array(good))
    else:
        whole = batch
    columns: dict[str, Array] = {}
    for r in layout.readings:
        values = _flat(batch.column(r.field), r)
        columns.update(zip(r.headers, values.reshape(-1, max(r.size, 1)).T, strict=True))
    kept = {name: whole.column(name) for name in layout.kept}
    return Block(piece.file.name, names, counts, columns, kept, row + np.arange(len(whole)), bad)


def _ragged(layout: Layout, lengths: NDArray[np.int64]) -> str:
    if (lengths < 1).all():
        return "it has no readings"
    said = ", ".join(f"{r.field} {n}" for r, n in zip(layout.readings, lengths, strict=True))
    return f"its lists are of unequal length ({said}): every reading has all its numbers"


def _refuse_ragged_vectors(column: Any, readings: Readings, bad: dict[int, str]) -> None:
    """Vectors within the lists of sensors that are not as long as the first one."""
    import pyarrow.compute

    if pyarrow.types.is_fixed_size_list(column.type.value_type):
        return
    inner = pyarrow.compute.list_value_length(column.flatten()).fill_null(0)
    wrong = np.asarray(inner.to_numpy(zero_copy_only=False)) != readings.size
    if not wrong.any():
        return
    owner = pyarrow.compute.list_parent_indices(column).to_numpy(zero_copy_only=False)
    for k in np.unique(owner[wrong]):
        first = int(np.flatnonzero(wrong & (owner == k))[0] - np.flatnonzero(owner == k)[0])
        bad.setdefault(int(k), f"reading {first} of its {readings.field} has not the "
                               f"{readings.size} numbers of a vector")  # fmt: skip


def _lengths(column: Any) -> NDArray[np.int64]:
    """How many readings each row has; 0 where there is no list."""
    import pyarrow.compute

    found = pyarrow.compute.list_value_length(column).fill_null(0)
    return np.asarray(found.to_numpy(zero_copy_only=False), dtype=np.int64)


def _flat(column: Any, readings: Readings) -> Array:
    """All numbers of a column one after the other; NaN where one is missing."""
    import pyarrow

    while pyarrow.types.is_nested(column.type):
        column = column.flatten()
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)


def _long(layout: Layout, pieces: Sequence[Piece]) -> Iterator[Block]:
    """One row for each reading; a sensor's rows may go on in the next batch."""
    width = sum(max(r.size, 1) for r in layout.readings)
    held, last = [], pieces[-1]
    for piece in pieces:
        for row, batch in _batches(layout, piece, max(FEWEST, HELD // width)):
            held.append((row, batch))
            names = _row_names(layout, piece, batch)
            code = numbers_of(names)
            begins = np.flatnonzero(code[1:] != code[:-1]) + 1
            before = _row_names(layout, piece, held[-2][1]) if len(held) > 1 else None
            if before is not None and numbers_of(before.slice(len(before) - 1))[0] != code[0]:
                begins = np.concatenate([[0], begins])
            if not len(begins):
                continue
            cut = int(begins[-1])
            done = [*held[:-1], (row, batch.slice(0, cut))]
            yield _long_block(layout, piece, [h for h in done if len(h[1])])
            held = [(row + cut, batch.slice(cut))]
    if held:
        yield _long_block(layout, last, held)


def _row_names(layout: Layout, piece: Piece, batch: Any) -> Any:
    import pyarrow

    if piece.name is None:
        return plain(batch.column(layout.sensor))
    return pyarrow.array([piece.name] * len(batch), pyarrow.large_string())


def _long_block(layout: Layout, piece: Piece, parts: Sequence[tuple[int, Any]]) -> Block:
    import pyarrow

    batch = pyarrow.Table.from_batches([p for _, p in parts]).combine_chunks().to_batches()[0]
    names = _row_names(layout, piece, batch)
    code = numbers_of(names)
    code[empty(names)] = 0
    begins = np.concatenate([[0], np.flatnonzero(code[1:] != code[:-1]) + 1])
    counts = np.diff(np.append(begins, len(batch)))
    rows = np.concatenate([row + np.arange(len(p)) for row, p in parts])[begins]
    columns: dict[str, Array] = {}
    for r in layout.readings:
        values = _flat(batch.column(r.field), r)
        if len(values) != len(batch) * max(r.size, 1):
            raise DataError(
                f"{piece.file.name}: column {r.field} holds vectors of unequal length: a vector "
                "has as many numbers in each row"
            )
        columns.update(zip(r.headers, values.reshape(-1, max(r.size, 1)).T, strict=True))
    kept = {name: batch.column(name).take(pyarrow.array(begins)) for name in layout.kept}
    return Block(piece.file.name, names.take(begins), counts, columns, kept, rows, {})


# -- to signals ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Binding:
    layout: Layout
    signals: tuple[Signal, ...]
    options: Options

    def __call__(self, table: Table, counts: NDArray[np.int64]) -> dict[str, Any]:
        """Columns of each signal, from those of some sensors; DataError where one is unusable."""
        bound_to = dict(self.layout.signals)
        found: dict[str, Any] = {}
        for signal in self.signals:
            if is_time(signal):
                found[signal.name] = (self._time(table, counts, signal),)
                continue
            names = bound_to[signal.name]
            if signal.kind == "rotation":
                found[signal.name] = rotation(table, signal, names, self.options)[0].T
            else:
                found[signal.name] = columns_of(table, signal, names, self.options)
        return found

    def _time(self, table: Table, counts: NDArray[np.int64], signal: Signal) -> Array:
        """The time of each reading in s, from the first of its sensor on."""
        from casest import units

        starts = np.repeat(np.cumsum(counts) - counts, counts)
        if self.layout.time is None:
            assert self.options.rate is not None
            time = (np.arange(len(starts)) - starts) / self.options.rate
        else:
            name = self.layout.time
            stated = timing.time_units_declared(self.options.units, name)
            scale = self.options.scales.get(name) or self.options.scales.get("t")
            time, _ = timing.seconds(table, table.columns[name], stated, scale)
            if self.options.time_zero == "first" and len(time):
                time = time - time[starts]
        return time * units.conversion("s", signal.unit or "s")[0]


def _fill(
    found: dict[str, Array],
    block: Block,
    places: NDArray[np.int_],
    ends: NDArray[np.int64],
    binding: _Binding,
) -> None:
    """Signals of the sensors at these places, which follow each other; halved where some fail."""
    first, stop = int(ends[places[0]]), int(ends[places[-1] + 1])
    if first == stop:
        return
    columns = {header: values[first:stop] for header, values in block.columns.items()}
    try:
        with np.errstate(all="ignore"):
            own = binding(table_of(block.file, columns), block.counts[places])
    except CasestError as error:
        if len(places) == 1:
            block.bad[int(places[0])] = _without_file(str(error), block.file)
            for values in found.values():
                values[first:stop] = np.nan
            return
        for half in np.array_split(places, 2):
            _fill(found, block, half, ends, binding)
        return
    for name, parts in own.items():
        for k, values in enumerate(parts):
            found[name][first:stop, k] = values


def _without_file(words: str, file: str) -> str:
    return words.removeprefix(f"{file}: ")


def name_of(block: Block, k: int) -> str | None:
    """What a sensor is called; None where its row has no name."""
    name = block.names[k].as_py()
    return None if name is None or not text(name).strip() else text(name)
