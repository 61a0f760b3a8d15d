"""MATLAB files: up to version 7 with SciPy, 7.3 (HDF5) with h5py; text that is only called .mat."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casest.data.arrays import from_arrays, pickled
from casest.data.delimited import Contents, read_delimited
from casest.data.matlab_tags import check_tags
from casest.data.text import decoded, is_text
from casest.errors import DataError, last_line, library

_HDF5 = b"\x89HDF\r\n\x1a\n"
_PICKLE = b"\x80"  # protocol 2 and later; no MATLAB file begins so
_HEADER = 512  # bytes before the HDF5 part of a v7.3 file


def read_matlab(file: Path) -> Contents:
    """Read the vectors and matrices of a .mat file, and those one level down in structs.

    A matrix `acc` (N, 3) gives acc[0], acc[1], acc[2]; scalars and text are kept as the preamble.
    """
    with file.open("rb") as stream:
        start = stream.read(4096)
    if start.startswith(_PICKLE):
        raise pickled(file)
    if start.startswith(_HDF5) or start[_HEADER:].startswith(_HDF5) or b"MATLAB 7.3" in start[:20]:
        return from_arrays(file, dict(_flat(_version_73(file))))
    if not start.startswith(b"MATLAB") and is_text(start):
        return read_delimited(str(file), decoded(file, file.read_bytes()))
    return from_arrays(file, dict(_flat(_version_7(file, version_5=b"\x00" not in start[:4]))))


def _version_7(file: Path, version_5: bool) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        with warnings.catch_warnings():
            if version_5:
                check_tags(file)
            warnings.simplefilter("ignore")  # such as two variables of one name: the last counts
            found = loadmat(str(file), squeeze_me=True, struct_as_record=False)
    except Exception as error:  # a damaged file can fail anywhere in the library
        raise DataError(
            f"{file}: cannot be read as MATLAB ({last_line(error)}); save it again, or as CSV"
        ) from error
    return {
        name: {f: getattr(value, f) for f in value._fieldnames}
        if hasattr(value, "_fieldnames")
        else value
        for name, value in found.items()
        if not name.startswith("__")
    }


def _version_73(file: Path) -> dict[str, Any]:
    h5py = library("h5py", "matlab", f"{file}: a MATLAB v7.3 file (HDF5; else save it with -v7)")
    try:
        with h5py.File(file, "r") as store:
            return {
                name: {f: _array(one) for f, one in item.items() if isinstance(one, h5py.Dataset)}
                if isinstance(item, h5py.Group)
                else _array(item)
                for name, item in store.items()
                if not name.startswith("#")  # what cells and structs refer to
            }
    except Exception as error:  # a damaged file can fail anywhere in the library
        raise DataError(
            f"{file}: cannot be read as MATLAB v7.3 ({last_line(error)}); save it again with "
            f"save('{file.name}', ..., '-v7')"
        ) from error


def _array(dataset: Any) -> Any:
    """A variable as MATLAB shows it: HDF5 holds it transposed, text as numbers of its signs."""
    kind = dataset.attrs.get("MATLAB_class", b"")
    if "MATLAB_empty" in dataset.attrs:
        return np.zeros(0)
    values = dataset[()]
    if kind == b"char":
        return "".join(map(chr, np.asarray(values).ravel()))
    return np.squeeze(np.asarray(values).T)


def _flat(found: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in found.items():
        if isinstance(value, dict):
            yield from value.items()
        else:
            yield name, value
