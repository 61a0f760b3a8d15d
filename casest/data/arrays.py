"""Records that are arrays already: NumPy, MATLAB, Parquet."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.column import Column, numeric_column, text_column
from casest.data.delimited import Contents
from casest.errors import DataError

#: Rows of a Parquet file that are read at once.
PIECE = 65_536
_TEXT = ("bool", "string", "large_string", "dictionary")
_NUMBER = ("timestamp", "int", "uint", "float", "double", "halffloat", "decimal")
_VECTOR = re.compile(r"(large_|fixed_size_)?list<\w+: (u?int\d+|float|double|halffloat)\b")


def read_npy(file: Path) -> Contents:
    """Read one array: (N, k) gives columns "0".."k-1"; a structured (N,) its fields."""
    array = _loaded(file)
    if array.dtype.names:
        return _from_arrays(file, {name: array[name] for name in array.dtype.names})
    return _from_arrays(file, {"": array})


def read_npz(file: Path) -> Contents:
    """Read named arrays: (N,) each a column, (N, 3) `v` gives v[0] v[1] v[2], scalars are kept."""
    with _loaded(file) as archive:
        try:
            arrays = {name: archive[name] for name in archive.files}
        except ValueError as error:
            raise _pickled(file) from error
    if len(arrays) == 1 and next(iter(arrays)).startswith("arr_"):
        arrays = {"": next(iter(arrays.values()))}
    return _from_arrays(file, arrays)


def read_matlab(file: Path) -> Contents:
    """Read the vectors and matrices of a .mat file, and those one level down in structs."""
    from scipy.io import loadmat

    try:
        found = loadmat(str(file), squeeze_me=True, struct_as_record=False)
    except NotImplementedError as error:
        raise DataError(
            f"{file}: is MATLAB v7.3 (HDF5), which is not read; "
            f"save it again with save('{file.name}', ..., '-v7')"
        ) from error
    except Exception as error:  # a damaged file can fail anywhere in the library
        raise DataError(f"{file}: cannot be read as MATLAB ({error})") from error
    arrays: dict[str, Any] = {}
    for name, value in found.items():
        if name.startswith("__"):
            continue
        fields = getattr(value, "_fieldnames", None)
        arrays |= {f: getattr(value, f) for f in fields} if fields else {name: value}
    if len(arrays) == 1 and np.ndim(next(iter(arrays.values()))) == 2:
        arrays = {"": next(iter(arrays.values()))}
    return _from_arrays(file, arrays)


def read_parquet(file: Path) -> Contents:
    """Read a Parquet table; a field's metadata may hold its `unit`; times become seconds.

    In pieces, so that no more than one of them is held beside the columns.
    """
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.ParquetFile(str(file), pre_buffer=False)
        columns, notes = _parquet_columns(table)
    except DataError as error:
        raise DataError(f"{file}: {error}") from error
    except (pyarrow.ArrowException, OSError) as error:
        text = str(error).splitlines()[0]
        raise DataError(f"{file}: cannot be read as Parquet ({text})") from error
    return Contents(columns, notes)


def _parquet_columns(table: Any) -> tuple[list[Column], list[str]]:
    kinds = {entry.name: str(entry.type) for entry in table.schema_arrow}
    texts: dict[str, list[str]] = {n: [] for n, kind in kinds.items() if kind.startswith(_TEXT)}
    numbers = {
        name: np.empty(table.metadata.num_rows)
        for name, kind in kinds.items()
        if kind.startswith(_NUMBER)
    }
    lists: dict[str, list[NDArray[np.float64]]] = {
        name: [] for name, kind in kinds.items() if _VECTOR.match(kind)
    }
    first, wanted = 0, [*texts, *numbers, *lists]
    for piece in table.iter_batches(batch_size=PIECE, columns=wanted) if wanted else ():
        for name, values in zip(piece.schema.names, piece.columns, strict=True):
            if name in numbers:
                numbers[name][first : first + len(values)] = _floats(values, kinds[name])
            elif name in lists:
                lists[name].append(_vectors(values, name))
            else:
                texts[name] += ["" if v is None else str(v) for v in values.to_pylist()]
        first += len(piece)
    columns, notes = [], []
    for entry in table.schema_arrow:
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


def _loaded(file: Path) -> Any:
    with file.open("rb") as start:
        if not start.read(6).startswith((b"\x93NUMPY", b"PK")):
            raise DataError(f"{file}: cannot be read as NumPy: it does not begin like one")
        start.seek(0)
        if start.read(2) == b"PK" and not zipfile.is_zipfile(start):
            raise DataError(f"{file}: cannot be read as NumPy: the archive is damaged")
    try:
        return np.load(file, allow_pickle=False)
    except ValueError as error:
        if "pickle" in str(error).lower():
            raise _pickled(file) from error
        raise DataError(f"{file}: cannot be read as NumPy ({error})") from error
    except (OSError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"{file}: cannot be read as NumPy ({error})") from error


def _pickled(file: Path) -> DataError:
    return DataError(
        f"{file}: holds Python objects, which are not read (they could run code); "
        f"save plain arrays of numbers"
    )


def _from_arrays(file: Path, arrays: Mapping[str, Any]) -> Contents:
    """Make columns from vectors and matrices of one common length; keep scalars as preamble."""
    found = {name: np.asarray(value) for name, value in arrays.items()}
    preamble = {name: str(value) for name, value in found.items() if value.size <= 1}
    series = {name: value for name, value in found.items() if value.size > 1}
    n_rows = _common_length(file, series)
    columns: list[Column] = []
    notes: list[str] = []
    for name, value in series.items():
        if value.ndim > 2 or value.dtype.kind not in "fiubU":
            notes.append(f"{name or 'array'} of shape {value.shape} ({value.dtype}) left out")
        elif value.ndim == 1:
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
