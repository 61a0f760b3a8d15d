"""Files of a result: written whole or not at all, read back, and what a file is instead."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from casest.data.logs import file_and_topics
from casest.data.write import make_folder, write_atomically
from casest.errors import DataError

RESULT, RESIDUALS = "result.json", "residuals.csv"
#: The key of a result under which it carries its correction.
CORRECTION = "correction"


def versions() -> dict[str, str]:
    """Versions of Python and of what computes."""
    return {"python": platform.python_version(), **_versions()}


@cache
def _versions() -> dict[str, str]:
    """Looked up once, for it takes as long as a small fit."""
    return {name: version(name) for name in ("casadi", "numpy", "scipy")}


def is_file(name: str) -> bool:
    """Whether data that are called so lie in a file, or a folder of one."""
    return file_and_topics(name)[0].exists()


def digest(name: str) -> str:
    """SHA-256 of a data file; of a folder (a ROS 2 bag), of its files' in order of their names."""
    path = file_and_topics(name)[0]
    whole = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as stream:
                part = hashlib.file_digest(stream, "sha256")
            if not path.is_dir():
                return part.hexdigest()
            whole.update(part.digest())
    return whole.hexdigest()


def digest_of_values(values: Mapping[str, Any], trusted: bool) -> str:
    """What a correction was made from: the parameters' values, and whether they are trusted."""
    text = json.dumps([trusted, sorted(values.items())], allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def plain(value: Any) -> Any:
    """Numbers, and what holds them, for JSON; what is not finite becomes null."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, dict):
        return {name: plain(v) for name, v in value.items()}
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim):
        return [plain(v) for v in value]
    number = float(value)
    return number if np.isfinite(number) else None


def save(folder: Path, result: Mapping[str, Any], residuals: str | None) -> None:
    """Write both files into a folder (made if missing), each whole or not at all."""
    make_folder(folder)
    if residuals is not None:
        write_atomically(folder / RESIDUALS, residuals)
    write_atomically(folder / RESULT, as_json(result))


def as_json(result: Mapping[str, Any]) -> str:
    """The result as text: strict JSON, two blanks of indentation; the correction on one line."""
    rest = {name: value for name, value in result.items() if name != CORRECTION}
    text = json.dumps(rest, indent=2, ensure_ascii=False, allow_nan=False)
    if CORRECTION in result:
        program = json.dumps(result[CORRECTION], ensure_ascii=False, allow_nan=False)
        text = f'{text.removesuffix("}").rstrip()},\n  "{CORRECTION}": {program}\n}}'
    return text + "\n"


def result_file(path: Path) -> Path:
    """A folder stands for the `result.json` in it."""
    return path / RESULT if path.is_dir() else path


def load_json(path: Path) -> Any:
    """The content of a JSON file; ValueError where it is none, OSError where it cannot be read."""
    try:
        return msgspec.json.decode(path.read_bytes())
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(str(error)) from None


def load_result(path: Path) -> dict[str, Any]:
    """A saved result (a folder stands for the `result.json` in it)."""
    path = result_file(path)
    try:
        result = load_json(path)
    except (FileNotFoundError, NotADirectoryError):
        raise DataError(f"{path}: no such result; {_instead(path.parent)}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        near = path.with_name(RESULT)
        hint = f"; did you mean {near}?" if near.exists() and near != path else ""
        raise DataError(f"{path}: not a result.json ({error}){hint}") from None
    if not isinstance(result, dict) or "model" not in result:
        raise DataError(f"{path}: not a casest result: it names no model")
    if "format" in result:
        raise DataError(
            f"{path}: is a correction exported already, which `casest apply` reads; here the "
            "result.json is needed that it was exported from"
        )
    if not result.keys() & {"estimate", "before", "after"}:
        writer = _WRITERS.get(path.name)
        by = f", but what `casest {writer}` writes" if writer else ": it holds no estimate"
        raise DataError(f"{path}: not a result of calibrate or close{by}")
    return result


#: What other commands leave in their folders.
_WRITERS = {
    "check.json": "check",
    "observe.json": "observe",
    "filter.json": "filter",
    "compare.json": "compare",
    "truth.json": "simulate",
}


def _instead(folder: Path) -> str:
    """What a folder without a result holds, and how one is made."""
    make = f"casest calibrate (or close) MODEL DATA -o {folder} makes one"
    found = next((name for name in _WRITERS if (folder / name).exists()), None)
    if found:
        return f"the folder holds {found} of `casest {_WRITERS[found]}`; {make}"
    return make
