"""Records that are arrays already: NumPy and Parquet, and what MATLAB's have in common."""

from __future__ import annotations

import re
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.column import Column, numeric_column, text_column
from casest.data.delimited import Contents
from casest.errors import DataError, last_line, library

#: Rows of a Parquet file that are read at once.
PIECE = 65_536
_PICKLE = b"\x80"  # protocol 2 and later; no array begins so
_TEXT = ("bool", "string", "large_string", "dictionary")
_NUMBER = ("timestamp", "int", "uint", "float", "double", "halffloat", "decimal")
_VECTOR = re.compile(r"(large_|fixed_size_)?list<\w+: (u?int\d+|float|double|halffloat)\b")


def read_npy(file: Path) -> Contents:
    """Read one array: (N, k) gives columns "0".."k-1"; a structured (N,) its fields."""
    array = _loaded(file)
    if isinstance(array, dict):
        raise DataError(f"{file}: is an archive of arrays; call it .npz")
    if array.dtype.names:
        return from_arrays(file, {name: array[name] for name in array.dtype.names})
    return from_arrays(file, {"": array})


def read_npz(file: Path) -> Contents:
    """Read named arrays: (N,) each a column, (N, 3) `v` gives v[0] v[1] v[2], scalars are kept."""
    arrays = _loaded(file)
    if not isinstance(arrays, dict):
        raise DataError(f"{file}: is one array, not an archive of them; call it .npy")
    if len(arrays) == 1 and next(iter(arrays)).startswith("arr_"):
        arrays = {"": next(iter(arrays.values()))}
    return from_arrays(file, arrays)


def read_parquet(file: Path) -> Contents:
    """Read a Parquet table; a field's metadata may hold its `unit`; times become seconds.

    In pieces, so that no more than one of them is held beside the columns.
    """
    parquet = library("pyarrow.parquet", "parquet", f"{file}: a Parquet file")
    try:
        table = parquet.ParquetFile(str(file), pre_buffer=False)
        wanted = _wanted(table.schema_arrow)
        pieces = table.iter_batches(batch_size=PIECE, columns=wanted) if wanted else ()
        columns, notes = from_batches(table.schema_arrow, table.metadata.num_rows, pieces)
    except DataError as error:
        raise DataError(f"{file}: {error}") from error
    except Exception as error:  # a damaged file can fail anywhere in the library
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise DataError(f"{file}: cannot be read as Parquet ({text}); export it again") from error
    return Contents(columns, notes)


def from_batches(
    schema: Any, num_rows: int, batches: Iterable[Any]
) -> tuple[list[Column], list[str]]:
    """Columns of an Arrow schema, filled from its record batches, and notes on those left out."""
    kinds = {entry.name: str(entry.type) for entry in schema}
    texts: dict[str, list[str]] = {n: [] for n, kind in kinds.items() if kind.startswith(_TEXT)}
    numbers = {name: np.empty(num_rows) for name, kind in kinds.items() if kind.startswith(_NUMBER)}
    lists: dict[str, list[NDArray[np.float64]]] = {
        name: [] for name, kind in kinds.items() if _VECTOR.match(kind)
    }
    first = 0
    for piece in batches:
        for name, values in zip(piece.schema.names, piece.columns, strict=True):
            if name in numbers:
                numbers[name][first : first + len(values)] = _floats(values, kinds[name])
            elif name in lists:
                lists[name].append(_vectors(values, name))
            elif name in texts:
                texts[name] += ["" if v is None else str(v) for v in values.to_pylist()]
        first += len(piece)
    if numbers and first != num_rows:
        raise DataError(f"announces {num_rows} rows, holds {first}; copy it again")
    columns, notes = [], []
    for entry in schema:
        unit = (entry.metadata or {}).get(b"unit", b"").decode()
        if kinds[entry.name].startswith("timestamp"):
            unit = "ns"
        header = f"{entry.name} [{unit}]" if unit else entry.name
        if entry.name in numbers:
            columns.append(numeric_column(header, numbers[entry.name], None))
        elif entry.name in texts:
            columns.append(text_column(header, texts[entry.name]))
        elif lists.get(entry.name):
            whole = np.vstack(lists[entry.name])
            columns += [
                numeric_column(header.replace(entry.name, f"{entry.name}[{k}]", 1), x, None)
                for k, x in enumerate(whole.T)
            ]
        else:
            notes.append(f"column {entry.name} of type {kinds[entry.name]} left out")
    return columns, notes


def _wanted(schema: Any) -> list[str]:
    """Names of the columns that can be read."""
    kinds = {entry.name: str(entry.type) for entry in schema}
    return [n for n, k in kinds.items() if k.startswith((*_TEXT, *_NUMBER)) or _VECTOR.match(k)]


def _vectors(values: Any, name: str) -> NDArray[np.float64]:
    """Rows (N, size) of a column of lists that all have one length."""
    flat = np.asarray(values.flatten().to_numpy(zero_copy_only=False), dtype=np.float64)
    sizes = {len(row) if row is not None else 0 for row in values.to_pylist()}
    if len(sizes) != 1:
        raise DataError(
            f"column {name} holds lists of {min(sizes)} to {max(sizes)} numbers: a vector has "
            "as many in each row"
        )
    return flat.reshape(len(values), -1)


def _floats(values: Any, kind: str) -> NDArray[np.float64]:
    """Numbers of one piece; times in ns."""
    import pyarrow

    if kind.startswith("timestamp"):
        values = values.cast(pyarrow.timestamp("ns")).cast(pyarrow.int64())
    return np.asarray(values.to_numpy(zero_copy_only=False), dtype=np.float64)


def _loaded(file: Path) -> NDArray[Any] | dict[str, NDArray[Any]]:
    """The array in a file, or those of an archive by name."""
    with file.open("rb") as stream:
        start = stream.read(6)
        if start.startswith(_PICKLE):
            raise pickled(file)
        if not start.startswith((b"\x93NUMPY", b"PK")):
            raise DataError(f"{file}: cannot be read as NumPy: it does not begin like one")
        if start.startswith(b"PK") and not zipfile.is_zipfile(stream):
            raise DataError(f"{file}: cannot be read as NumPy: the archive is damaged")
        stream.seek(0)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = np.load(stream, allow_pickle=False)
                if isinstance(found, np.ndarray):
                    return found
                return {name: found[name] for name in found.files}
        except Exception as error:  # a damaged file can fail anywhere in the library
            raise _unreadable(file, error) from error


def _unreadable(file: Path, error: Exception) -> DataError:
    """What NumPy's error says of the file."""
    text = last_line(error)
    if "pickle" in text.lower() or "allow_pickle" in str(error):
        return pickled(file)
    if "reshape" in text or "EOF" in text or "Failed to read all data" in text:
        return DataError(
            f"{file}: cannot be read as NumPy: it holds less than its header announces, so it was "
            f"cut off; copy it again"
        )
    return DataError(f"{file}: cannot be read as NumPy ({text}); save it again")


def pickled(file: Path) -> DataError:
    """The refusal of a file of Python objects."""
    return DataError(
        f"{file}: holds Python objects, which are not read (they could run code); "
        f"save plain arrays of numbers"
    )


def from_arrays(file: Path, arrays: Mapping[str, Any]) -> Contents:
    """Make columns from vectors and matrices of one common length; keep scalars as preamble."""
    found = {name: np.asarray(value) for name, value in arrays.items()}
    odd = {
        name: value
        for name, value in found.items()
        if value.size and (value.ndim > 2 or value.dtype.kind not in "fiubU")
    }
    notes = [
        f"{name or 'array'} of shape {v.shape} ({v.dtype}) left out" for name, v in odd.items()
    ]
    found = {name: value for name, value in found.items() if name not in odd}
    preamble = {name: str(value) for name, value in found.items() if value.size == 1}
    series = {name: value for name, value in found.items() if value.size > 1}
    n_rows = _common_length(file, series)
    columns: list[Column] = []
    for name, value in series.items():
        if value.ndim == 1:
            columns.append(_column(name or "0", value))
        else:
            rows = value if value.shape[0] == n_rows else value.T
            columns += [
                _column(f"{name}[{i}]" if name else str(i), rows[:, i])
                for i in range(rows.shape[1])
            ]
    return Contents(columns, notes, preamble)


def _common_length(file: Path, series: Mapping[str, NDArray[Any]]) -> int:
    if not series:
        raise DataError(f"{file}: holds no array with more than one number")
    if len(series) == 1:
        value = next(iter(series.values()))
        # a lone matrix is samples by channels, unless it is far wider than long (MATLAB rows)
        wide = value.ndim == 2 and value.shape[0] <= 16 < value.shape[1]
        return int(value.shape[1] if wide else value.shape[0])
    longest = {name: int(max(value.shape)) for name, value in series.items()}
    n_rows = next(iter(longest.values()))
    for name, length in longest.items():
        if length != n_rows:
            raise DataError(
                f"{file}: {name} has {length} samples and {next(iter(longest))} has {n_rows}; "
                f"all arrays of a record need one length"
            )
    return n_rows


def _column(name: str, values: NDArray[Any]) -> Column:
    if values.dtype.kind == "U":
        return text_column(name, [str(value) for value in values])
    return numeric_column(name, values.astype(np.float64), None)
