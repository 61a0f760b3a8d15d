"""Columns as a data frame of the library that is there, or of the sort that was given."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import UsageError, library

Library = Literal["pandas", "polars", "arrow", "dict"]


def as_frame(columns: Mapping[str, Any], to: Library | None = None) -> Any:
    """A frame of the columns: of pandas or else polars, where one is installed; else a dict."""
    to = to or next((name for name in ("pandas", "polars") if find_spec(name)), "dict")
    if to == "dict":
        return dict(columns)
    if to == "arrow":
        return library("pyarrow", "parquet", "a table of Arrow").table(dict(columns))
    if to not in ("pandas", "polars"):
        raise UsageError(f"to={to!r}: there are 'pandas', 'polars', 'arrow' and 'dict'")
    return library(to, "frames", f"a frame of {to}").DataFrame(dict(columns))


def like(given: Any, name: str, values: Array) -> Any:
    """Values (N, size) as what was given: an array, a mapping, or a frame with its index."""
    if isinstance(given, np.ndarray):
        return values
    if hasattr(given, "data_vars") or hasattr(given, "coords"):
        return _dataset(given, name, values)
    if isinstance(given, Mapping):
        return {name: values[:, 0] if values.shape[1] == 1 else values}
    columns = dict(zip(headers(name, values.shape[1]), values.T, strict=True))
    if hasattr(given, "index"):
        return type(given)(columns, index=given.index)
    if hasattr(given, "column_names"):
        return as_frame(columns, "arrow")
    return type(given)(columns) if hasattr(given, "columns") else as_frame(columns)


def headers(name: str, size: int) -> list[str]:
    """Names of the components: force_x force_y force_z."""
    if size == 1:
        return [name]
    return [f"{name}_{axis}" for axis in ("xyz" if size == 3 else range(size))]


def _dataset(given: Any, name: str, values: Array) -> Any:
    """A Dataset of xarray along the dimension of the readings."""
    along = next(d for d, n in given.sizes.items() if n == len(values))
    axis = next((d for d, n in given.sizes.items() if d != along and n == values.shape[1]), "axis")
    variable = (along, values[:, 0]) if values.shape[1] == 1 else ((along, axis), values)
    kept = {d: given.coords[d] for d in (along, axis) if d in given.coords}
    return sys.modules["xarray"].Dataset({name: variable}, coords=kept)
