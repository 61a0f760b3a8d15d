"""Tables that are in memory already: data frames of any library, mappings of arrays, arrays.

No library of frames is imported. What a frame has is what it is asked for: columns by name (pandas,
polars), `data_vars` (xarray), an Arrow stream (PyArrow, DuckDB …) or the dataframe interchange.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.arrays import from_arrays, from_batches
from casest.data.column import BLANK, Column, name_and_unit, numeric_column, text_column
from casest.data.delimited import Contents
from casest.errors import DataError, UsageError, library

_EXCHANGED = ("__arrow_c_stream__", "__dataframe__")


def is_frame(data: Any) -> bool:
    """Whether this is one table in memory: a frame, a mapping of columns or an array."""
    if isinstance(data, Mapping | np.ndarray):
        return True
    named = hasattr(data, "columns") and hasattr(data, "__getitem__")
    return named or _labelled(data) or any(hasattr(data, name) for name in _EXCHANGED)


def framed(data: Any, name: str) -> Contents:
    """The columns of one table in memory; `name` is what errors call it.

    Vectors (N, 3) become columns v[0] v[1] v[2]; a unit is read from the column's name, from its
    metadata (PyArrow, xarray) or from `attrs["units"]` of the frame.
    """
    if isinstance(data, np.ndarray):
        fields = data.dtype.names
        return from_arrays(Path(name), {n: data[n] for n in fields} if fields else {"": data})
    if _labelled(data):
        return _of_dataset(data, name)
    if isinstance(data, Mapping):
        return _of_mapping(data, name)
    if hasattr(data, "column_names") or not hasattr(data, "columns"):
        return _of_arrow(data, name)
    if hasattr(data, "collect") and not hasattr(data, "to_numpy"):
        raise UsageError(f"{name}: its rows are not computed yet; give {name}.collect()")
    return _of_columns(_index_and_columns(data), _units_of(data))


def _units_of(data: Any) -> Mapping[str, str]:
    """Units by column, as `frame.attrs["units"]` may hold them."""
    found = getattr(data, "attrs", {}).get("units", {})
    return found if isinstance(found, Mapping) else {}


def _index_and_columns(data: Any) -> Iterator[tuple[str, Any]]:
    """The index, where it says something, then the columns with their names as text."""
    named = list(data.columns)
    texts = ["_".join(map(str, n)) if isinstance(n, tuple) else str(n) for n in named]
    index = getattr(data, "index", None)
    for level, label in enumerate(getattr(index, "names", ())):
        values = index.get_level_values(level)  # type: ignore[union-attr]
        moments = "date" in str(values.dtype) or "timedelta" in str(values.dtype)
        if (label is not None or moments) and (text := str(label or "time")) not in texts:
            yield text, values
    for n, text in zip(named, texts, strict=True):
        values = data[n]
        if hasattr(values, "columns"):
            raise DataError(f"two columns are named '{text}'; rename one of them")
        yield text, values


def _of_columns(columns: Iterable[tuple[str, Any]], units: Mapping[str, str]) -> Contents:
    found, notes = list[Column](), list[str]()
    for name, values in columns:
        made, left_out = _column(name, values, units.get(name))
        found += made
        notes += left_out
    return Contents(found, notes)


def _of_mapping(data: Mapping[Any, Any], name: str) -> Contents:
    """Columns by name, a matrix under one name among them; scalars are kept beside."""
    if not data:
        raise DataError(f"{name}: is empty; give columns by name, as in {{'v': readings}}")
    arrays = {str(n): _array(values) for n, values in data.items()}
    lengths = {n: len(x) for n, x in arrays.items() if x.ndim}
    first = next(iter(lengths), "")
    for n, length in lengths.items():
        if length != lengths[first]:
            raise DataError(
                f"{name}: {n} has {length} rows and {first} has {lengths[first]}; all columns of a "
                "record need one length"
            )
    beside = {n: str(x) for n, x in arrays.items() if not x.ndim}
    found = _of_columns(((n, x) for n, x in arrays.items() if x.ndim), {})
    return Contents(found.columns, found.notes, beside)


def _array(values: Any) -> NDArray[Any]:
    """A column as an array, whatever holds it."""
    try:
        found = values.to_numpy() if hasattr(values, "to_numpy") else np.asarray(values)
    except ValueError:  # lists of unequal length
        found = np.asarray(values, dtype=object)
    return np.asarray(found)


def _column(name: str, values: Any, unit: str | None) -> tuple[list[Column], list[str]]:
    """Columns of one name: several where each row holds a vector."""
    cells = _array(values)
    if cells.dtype.kind == "O":
        cells = _numbers_or_text(cells)
    if cells.dtype.kind == "M":
        cells, unit = _count(cells, "datetime64[ns]"), "ns"
    elif cells.dtype.kind == "m":
        cells, unit = _count(cells, "timedelta64[ns]") / 1e9, "s"
    bare, own = name_and_unit(name)
    unit = own or unit
    behind = f" [{unit}]" if unit else ""
    if cells.dtype.kind in "UTb":
        return [text_column(name, [str(cell) for cell in cells])], []
    if cells.dtype.kind not in "fiu" or cells.ndim > 2:
        return [], [f"column {name} of type {cells.dtype} left out"]
    if cells.ndim == 1:
        return [numeric_column(bare + behind, cells.astype(np.float64), None)], []
    parts = enumerate(cells.T.astype(np.float64))
    return [numeric_column(f"{bare}[{k}]{behind}", x, None) for k, x in parts], []


def _count(moments: NDArray[Any], kind: str) -> NDArray[np.float64]:
    """Nanoseconds; NaN where there is no moment."""
    counted = moments.astype(kind).astype(np.int64).astype(np.float64)
    return np.where(np.isnat(moments), np.nan, counted)


def _numbers_or_text(cells: NDArray[Any]) -> NDArray[Any]:
    """Python objects as an array of numbers, of vectors or, where they are neither, of text."""
    there = np.array([cell is not None and str(cell).lower() not in _ABSENT for cell in cells])
    known = list(cells[there])
    if known and all(isinstance(cell, list | tuple | np.ndarray) for cell in known):
        return _vectors(cells, there)
    if known and all(hasattr(cell, "timestamp") for cell in known):
        there_of = np.array([cell.timestamp() for cell in known]) * 1e9
        return _filled(there, there_of).astype("datetime64[ns]")
    number = [isinstance(cell, Real) or hasattr(cell, "as_tuple") for cell in known]
    if all(number) and not any(isinstance(cell, bool) for cell in known):
        return _filled(there, np.array([float(cell) for cell in known]))
    return np.array([str(c) if t else "" for c, t in zip(cells, there, strict=True)], dtype=np.str_)


#: What stands where there is no value: also pandas' NA and NaT.
_ABSENT = BLANK | {"<na>", "nat"}


def _filled(there: NDArray[np.bool_], values: NDArray[np.float64]) -> NDArray[np.float64]:
    whole = np.full(there.shape, np.nan)
    whole[there] = values
    return whole


def _vectors(cells: NDArray[Any], there: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Rows of numbers, (N, size); NaN where a row is missing."""
    sizes = {len(cell) for cell in cells[there]}
    if len(sizes) != 1:
        raise DataError(
            f"a column holds lists of {min(sizes)} to {max(sizes)} numbers: a vector has as many "
            "in each row"
        )
    whole = np.full((len(cells), sizes.pop()), np.nan)
    whole[there] = np.array([np.asarray(cell, dtype=np.float64) for cell in cells[there]])
    return whole


def _of_arrow(data: Any, name: str) -> Contents:
    """A PyArrow table, or what can be made one by the Arrow stream or the interchange."""
    pyarrow = library("pyarrow", "parquet", f"a {name}")
    if hasattr(data, "__arrow_c_stream__"):
        table = pyarrow.table(data)
    else:
        table = library("pyarrow.interchange", "parquet").from_dataframe(data)
    columns, notes = from_batches(table.schema, table.num_rows, table.to_batches())
    return Contents(columns, notes)


def _labelled(data: Any) -> bool:
    """Is this a Dataset or DataArray of xarray?"""
    return hasattr(data, "coords") and hasattr(data, "dims") and hasattr(data, "attrs")


def _of_dataset(data: Any, name: str) -> Contents:
    """The variables along the one dimension of an xarray Dataset that all share."""
    if not hasattr(data, "data_vars"):
        data = data.to_dataset(name=data.name or "value")
    parts = [set(v.dims) for v in data.data_vars.values() if v.dims]
    shared = [d for d in data.sizes if parts and all(d in dims for dims in parts)]
    if not shared:
        raise DataError(f"{name}: its variables share no dimension; a record has one, such as time")
    along = max(shared, key=lambda d: int(data.sizes[d]))
    found, notes = list[Column](), list[str]()
    for label, values in data.variables.items():
        if along not in values.dims:
            continue
        unit = values.attrs.get("units")
        cells = values.transpose(along, ...).values
        other = [d for d in values.dims if d != along]
        names = [str(x) for x in data[other[0]].values] if len(other) == 1 else []
        made, left_out = _column(str(label), cells, unit if isinstance(unit, str) else None)
        if names and other[0] in data.coords and len(made) == len(names):
            texts = (f"{label}_{x}" for x in names)
            made = [Column(t, c.unit, c.values, c.bad) for t, c in zip(texts, made, strict=True)]
        found += made
        notes += left_out
    return Contents(found, notes)
