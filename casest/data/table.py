"""Reading a record, whatever its format, into named columns."""

from __future__ import annotations

import difflib
import gzip
import os
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

from casest.data.arrays import read_npy, read_npz, read_parquet
from casest.data.column import BadCell, Column
from casest.data.delimited import Contents, read_delimited
from casest.data.frames import framed
from casest.data.logs import file_and_topics, is_log, read_log
from casest.data.matlab import read_matlab
from casest.data.text import decoded
from casest.errors import CasestError, DataError

__all__ = ["BadCell", "Column", "Table", "read_table", "table_of"]


@dataclass(frozen=True)
class Table:
    """The columns of one file by name, in the file's order.

    `preamble` keeps what stood before the table ("Fs": "100"); `notes` say what was skipped.
    """

    file: str
    columns: Mapping[str, Column]
    notes: tuple[str, ...]
    preamble: Mapping[str, str]
    n_rows: int


def read_table(path: str | os.PathLike[str]) -> Table:
    """Read CSV (any delimiter, header or not), Parquet, NumPy (.npy, .npz) or MATLAB (.mat).

    ROS bags and PX4 logs hold several topics, of which one is named behind the file:
    `flight.bag:/imu/data`; several with commas between them are put on the slowest one's clock.

    Columns of one name are told apart by a number. Raises DataError where the file is missing,
    empty, of another format or has rows of unequal width. Bad cells raise nothing here: see
    `Column.bad`.
    """
    try:
        file, contents = _contents(path)
    except OSError as error:  # no permission, a name too long, a drive that has gone
        raise DataError(f"{os.fspath(path)}: cannot be read ({error.strerror or error})") from error
    return _checked(str(path), str(file), contents)


def table_of(data: Any, name: str) -> Table:
    """A table that is in memory already (see `framed`); `name` is what errors call it."""
    try:
        return _checked(name, name, framed(data, name))
    except CasestError as error:
        said = str(error)
        raise type(error)(said if said.startswith(f"{name}: ") else f"{name}: {said}") from None


def _checked(name: str, file: str, contents: Contents) -> Table:
    """The table of what a reader found; DataError where it holds nothing."""
    apart, notes = _told_apart(contents.columns)
    columns = {column.name: column for column in apart}
    if not columns:
        raise DataError(f"{file}: holds no columns of numbers; check the export")
    n_rows = len(next(iter(columns.values())).values)
    if n_rows == 0:
        raise DataError(f"{file}: holds a header but no rows below it; check the export")
    return Table(name, columns, (*contents.notes, *notes), contents.preamble, n_rows)


def _told_apart(columns: Sequence[Column]) -> tuple[list[Column], list[str]]:
    """Columns of which each has a name of its own, and what to say of those that had not: nobody
    knows which one is meant by it, so that it stands for none."""
    many = Counter(column.name for column in columns)
    taken, found, own = set(many), list[Column](), dict[str, list[str]]()
    for column in columns:
        if many[column.name] > 1:
            numbered = (f"{column.name} ({k})" for k in count(1))
            name = next(one for one in numbered if one not in taken)
            taken.add(name)
            own.setdefault(column.name, []).append(name)
            column = replace(column, name=name)
        found.append(column)
    return found, [
        f"{len(names)} columns are named '{name}': they are '{names[0]}' to '{names[-1]}' here"
        for name, names in own.items()
    ]


def _contents(path: str | os.PathLike[str]) -> tuple[Path, Contents]:
    file, topics = file_and_topics(path)
    _refuse_unreadable(file)
    if is_log(file):
        return file, read_log(file, topics)
    if topics:
        raise DataError(f"{file}: holds no topics; leave ':{','.join(topics)}' out")
    return file, _READERS.get(file.suffix.lower(), _read_text)(file)


def _refuse_unreadable(file: Path) -> None:
    if file.is_dir() and not is_log(file):
        raise DataError(f"{file}: is a folder; name the files in it, for example {file}/*.csv")
    if not file.exists():
        raise DataError(f"{file}: no such file; {_near_names(file)}")
    if file.stat().st_size == 0:
        raise DataError(f"{file}: the file is empty (0 bytes); check the export")


def _near_names(file: Path) -> str:
    if not file.parent.is_dir():
        return f"there is no folder {file.parent} either"
    names = sorted(path.name for path in file.parent.iterdir() if path.is_file())
    near = difflib.get_close_matches(file.name, names, n=3, cutoff=0.6)
    if near:
        return f"did you mean {' or '.join(near)}?"
    shown = ", ".join(names[:5]) + (", …" if names[5:] else "")
    return f"that folder holds {shown}" if names else "that folder holds no files"


def _read_text(file: Path) -> Contents:
    try:
        raw = gzip.decompress(file.read_bytes()) if file.suffix == ".gz" else file.read_bytes()
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{file}: cannot be read ({error}); copy it again") from error
    return read_delimited(str(file), decoded(file, raw))


def _refused(reason: str) -> Callable[[Path], Contents]:
    def refuse(file: Path) -> Contents:
        raise DataError(f"{file}: {reason}; export it as CSV, Parquet, .npy or .mat")

    return refuse


_READERS: dict[str, Callable[[Path], Contents]] = {
    ".npy": read_npy,
    ".npz": read_npz,
    ".mat": read_matlab,
    ".parquet": read_parquet,
    ".pq": read_parquet,
    ".xlsx": _refused("a spreadsheet is not read"),
    ".xls": _refused("a spreadsheet is not read"),
    ".h5": _refused("HDF5 is not read"),
    ".hdf5": _refused("HDF5 is not read"),
    ".json": _refused("JSON is not read"),
}
