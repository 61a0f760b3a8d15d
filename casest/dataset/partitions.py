"""How a data set is cut into partitions: by its files and their row groups, never by who works.

So the numbers of a sensor, and the bytes of every file that is written, are the same whatever the
number of workers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from casest.data.options import Options
from casest.dataset.files import File, files_of, footer_digest, opened, unreadable
from casest.dataset.layout import Layout, differing, layout_of
from casest.dataset.names import MOST, PIECE, Names, empty, numbers_of, passes, plain, runs, twice
from casest.declaration.symbols import Signal
from casest.errors import DataError

#: Numbers in the readings of a partition: a second or two of work.
NUMBERS = 8_000_000
#: Into how many parts a large row group is cut at most: each reads what lies before it.
PARTS = 4


@dataclass(frozen=True)
class Piece:
    """Rows [first, stop) of a file; `digest` of what the file says of itself.

    `name` is the sensor's, where the folder says it.
    """

    file: File
    first: int
    stop: int
    digest: str
    name: str | None = None


@dataclass(frozen=True)
class Partition:
    """What one task calibrates; `twice`: its sensors that are elsewhere too, and where."""

    number: int
    pieces: tuple[Piece, ...]
    twice: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Plan:
    """All partitions of a data set, and what cannot be read: file and reason."""

    layout: Layout
    partitions: tuple[Partition, ...]
    unreadable: tuple[tuple[str, str], ...]
    #: Sensors, as far as names tell: in wide form rows with a name.
    sensors: int


@dataclass
class _Open:
    """A file on the way into a plan: rows at which its row groups begin, numbers in each."""

    file: File
    digest: str
    groups: list[int]
    numbers: list[int]
    #: Rows at which a sensor begins, in long form: where a file may be cut.
    begins: Any = field(default_factory=lambda: np.zeros(0, np.int64))


def plan(
    dataset: str,
    signals: Sequence[Signal],
    options: Options,
    *,
    sensor: str = "sensor",
    kept: Sequence[str] = (),
) -> Plan:
    """Look through a data set: its footers, and the names of its sensors.

    Raises DataError where a column is missing, files differ in their schema, or none can be read.
    """
    layout: Layout | None = None
    first, found, bad = None, [], []
    for file in files_of(dataset):
        try:
            table = opened(file)
        except DataError as error:
            bad.append((file.name, str(error)))
            continue
        if layout is None:
            first = file
            layout = layout_of(file, table, signals, options, sensor=sensor, kept=kept)
        elif (other := differing(layout, first or file, file, table)) is not None:
            raise other
        found.append(_looked_at(file, table, layout))
    if layout is None:
        raise DataError(f"{dataset}: none of its {len(bad)} files can be read: {bad[0][1]}")
    found, damaged, sensors, places = _named(found, layout)
    if not sensors:
        why = "holds no row that names a sensor; check the export"
        if damaged and not found:
            why = f"none of its {len(bad) + len(damaged)} files can be read: {damaged[0][1]}"
        raise DataError(f"{dataset}: {why}")
    cut, way_out = _cut(found, layout), "keep one"
    if not layout.wide:
        way_out = "in long form the rows of a sensor stand together: sort them by it, or keep one"
    if places:
        cut = [replace(p, twice=tuple(_said(p, places, found, way_out))) for p in cut]
    parts = tuple(cut)
    return Plan(layout, parts, (*bad, *damaged), sensors)


def _looked_at(file: File, table: Any, layout: Layout) -> _Open:
    about = table.metadata
    field_ = layout.readings[0].field
    rows, numbers = [0], []
    for k in range(about.num_row_groups):
        group = about.row_group(k)
        columns = [group.column(i) for i in range(group.num_columns)]
        own = [c for c in columns if c.path_in_schema.partition(".")[0] == field_]
        size = max(layout.readings[0].size, 1)
        per_field = sum(c.num_values for c in own) // (size if size > 1 else 1)
        width = sum(max(r.size, 1) for r in layout.readings)
        numbers.append(per_field * width)
        rows.append(rows[-1] + group.num_rows)
    return _Open(file, footer_digest(table), rows, numbers)


# -- names -----------------------------------------------------------------------------------------


def _named(
    files: list[_Open], layout: Layout
) -> tuple[list[_Open], list[tuple[str, str]], int, Mapping[str, list[Any]]]:
    """Files whose names can be read, those that cannot, number of sensors, and who is twice."""
    good, bad, total = [], [], 0
    several = layout.named_by_folder and not layout.wide  # several files of one folder
    known: list[Any] | None = [] if not several and _few(files) else None
    for own in files:
        rows, numbers = [], []
        try:
            for names in _names(own, layout):
                there = ~empty(names.names)
                rows.append(names.rows[there])
                if known is not None:
                    numbers.append(numbers_of(names.names)[there])
        except Exception as error:  # a damaged file can fail anywhere in the library
            bad.append((own.file.name, str(unreadable(own.file, error))))
            continue
        begins = np.concatenate(rows) if rows else np.zeros(0, np.int64)
        total += len(begins)
        own.begins = begins if not layout.wide else own.begins
        good.append(own)
        if known is not None:
            known += numbers

    def read() -> Iterator[tuple[int, Names]]:
        last = None
        for k, own in enumerate(good):
            if several:
                last, before = own.file.folder_value(layout.sensor), last
                if last == before:
                    continue
            for names in _names(own, layout):
                yield k, names

    places = twice(read, total, known)
    if len(places) > MOST:
        name, found = next(iter(places.items()))
        raise DataError(
            f"{good[found[0][0]].file.name}: {len(places)} names in column {layout.sensor} are "
            f"there more than once, {name} in rows {found[0][1]} and {found[1][1]}: in long form "
            "the rows of a sensor stand together; sort them, or name another column with --sensor"
        )
    return good, bad, total, places


def _few(files: Sequence[_Open]) -> bool:
    """Can the names of all rows be held and sorted at once?"""
    return passes(sum(own.groups[-1] for own in files)) == 1


def _names(own: _Open, layout: Layout) -> Iterator[Names]:
    """Names of a file's sensors, in pieces."""
    import pyarrow

    if layout.named_by_folder:
        name = pyarrow.array([own.file.folder_value(layout.sensor)], pyarrow.large_string())
        yield Names(name, np.zeros(1, np.int64))
        return
    table = opened(own.file)
    pieces = (
        piece.column(0)
        for piece in table.iter_batches(PIECE, columns=[layout.sensor], use_threads=False)
    )
    if not layout.wide:
        yield from runs(pieces)
        return
    row = 0
    for piece in pieces:
        names = plain(piece)
        yield Names(names, row + np.arange(len(names)))
        row += len(names)


def _said(
    part: Partition, places: Mapping[str, list[Any]], files: Sequence[_Open], way_out: str
) -> Iterator[tuple[str, str]]:
    """Names in this partition that are there more than once, with a sentence each."""
    inside = {(p.file.name, p.first, p.stop) for p in part.pieces}
    for name, found in sorted(places.items()):
        where = [(files[k].file.name, row) for k, row in found]
        if any(f == file and a <= row < b for file, row in where for f, a, b in inside):
            listed = " and ".join(f"row {row} of {file}" for file, row in where[:3])
            more = f" and {len(where) - 3} more" if len(where) > 3 else ""
            yield name, f"sensor {name} is there {_times(len(where))}: {listed}{more}; {way_out}"


def _times(count: int) -> str:
    return "twice" if count == 2 else f"{count} times"


# -- cutting ---------------------------------------------------------------------------------------


def _cut(files: Sequence[_Open], layout: Layout) -> list[Partition]:
    """Small pieces together, large row groups in parts."""
    found: list[Partition] = []
    pieces: list[Piece] = []
    held = 0
    for own in files:
        for piece, numbers in _pieces(own, layout):
            goes_on = piece.name is not None and piece.name == pieces[-1].name if pieces else False
            if pieces and not goes_on and held + numbers > NUMBERS * 1.5:
                found.append(Partition(len(found), tuple(pieces)))
                pieces, held = [], 0
            pieces, held = _joined(pieces, piece), held + numbers
    if pieces:
        found.append(Partition(len(found), tuple(pieces)))
    return found


def _joined(pieces: list[Piece], piece: Piece) -> list[Piece]:
    """Pieces of one file that follow each other become one."""
    if pieces and pieces[-1].file == piece.file and pieces[-1].stop == piece.first:
        return [*pieces[:-1], replace(pieces[-1], stop=piece.stop)]
    return [*pieces, piece]


def _pieces(own: _Open, layout: Layout) -> Iterator[tuple[Piece, int]]:
    """Rows of a file with about how many numbers they hold; in long form sensors stay whole."""
    name = own.file.folder_value(layout.sensor) if layout.named_by_folder else None
    cuts = [0]
    for k, numbers in enumerate(own.numbers):
        first, stop = own.groups[k], own.groups[k + 1]
        parts = min(PARTS, max(1, round(numbers / NUMBERS)))
        cuts += [first + (stop - first) * (i + 1) // parts for i in range(parts)]
    if not layout.wide:
        at = np.searchsorted(own.begins, cuts)
        starts = np.append(own.begins, own.groups[-1])
        cuts = [0, *starts[at[1:-1]].tolist(), own.groups[-1]] if len(cuts) > 2 else cuts
    cuts = sorted(set(cuts))
    each = sum(own.numbers) / max(own.groups[-1], 1)
    for first, stop in pairwise(cuts):
        piece = Piece(own.file, int(first), int(stop), own.digest, name)
        yield piece, round(each * (stop - first))
