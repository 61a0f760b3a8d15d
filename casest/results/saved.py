"""What is read of a saved result again, checked: a file may have been edited, or sent by others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET, Struct, UnsetType

from casest.correction.carried import Carried
from casest.correction.reading import carried_read, typed
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.results.file import digest_of_values, load_result, result_file
from casest.results.values import Entry


class SavedParameter(Struct, frozen=True):
    """Value and standard deviation, nested by the parameter's shape; unit, or one per entry."""

    value: Any
    std: Any
    unit: str | list[str]
    interval95: Any = None

    @property
    def first_unit(self) -> str:
        """The unit, of the first entry where they differ."""
        return self.unit if isinstance(self.unit, str) else next(iter(self.unit), "")


class _SavedCovariance(Struct, frozen=True):
    names: list[str]
    matrix: list[list[float | None]]


class _SavedNoise(Struct, frozen=True):
    sigma: list[float]


class _Section(Struct, frozen=True):
    parameters: dict[str, SavedParameter]
    covariance: _SavedCovariance | UnsetType = UNSET


class _Reproduced(Struct, frozen=True):
    command: str = ""


class SavedResult(Struct, frozen=True, kw_only=True):
    """A result of `calibrate` or `close` as it is used again; of an estimator in motion too."""

    model: str
    trusted: bool
    verdict: str | None = None
    data: list[str] = []
    runs: list[str] = []
    constants: dict[str, Any] = {}
    scopes: dict[str, str] = {}
    noise: _SavedNoise | None = None
    units: dict[str, str] = {}
    convention: str = ""
    estimate: _Section | UnsetType = UNSET
    after: _Section | UnsetType = UNSET
    innovations: Any = None
    correction: dict[str, Any] | None = None
    conditions: dict[str, list[float]] = {}
    reproduce: _Reproduced = _Reproduced()

    @property
    def parameters(self) -> Mapping[str, SavedParameter]:
        """After the loop was closed, if it was."""
        found = self.after or self.estimate
        return found.parameters if found else {}

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Every number of every parameter, but those that its shape holds at zero."""
        return tuple(e for n, p in self.parameters.items() for e in _entries(n, p))


def saved_result(path: Path) -> SavedResult:
    """The checked content of a saved result (a folder stands for the `result.json` in it)."""
    return typed(load_result(path), SavedResult, str(result_file(path)))


def saved_correction(path: Path, *, force: bool = False, what: str) -> tuple[SavedResult, Carried]:
    """A saved result and the correction that it carries; nothing of the model's source is run.

    `what` is to be done to a refused result only with `force`.
    """
    return correction_of(saved_result(path), str(result_file(path)), force=force, what=what)


def correction_of(
    result: SavedResult, name: str, *, force: bool = False, what: str
) -> tuple[SavedResult, Carried]:
    """The result and the correction that it carries, checked; errors call the result `name`."""
    if result.innovations is not None:
        raise UsageError(
            f"the result is of {result.model}, an estimator in motion: it has states over time "
            f"(casest filter {result.model} DATA) and no correction"
        )
    if not result.trusted and not force:
        raise UsageError(f"{name}: this estimate was refused; --force {what} it all the same")
    if result.correction is None:
        raise DataError(
            f"{name}: was made by an older casest, and carries no correction: calibrate again"
        )
    if "reason" in result.correction:
        raise UsageError(str(result.correction["reason"]))
    values = {name: p.value for name, p in result.parameters.items()}
    if result.correction.get("of") != digest_of_values(values, result.trusted):
        raise DataError(
            f"{name}: its parameters are not those that its correction was made from; "
            "a result is not edited by hand: calibrate again, with --fix what is to be held"
        )
    return result, carried_read(result.correction, f"{name}: correction", len(result.runs))


def numbers(value: Any, where: str) -> Array:
    """A saved value (any shape) as numbers; DataError where it is none."""
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{where}: {value!r:.60} are no numbers; calibrate again") from None
    if not np.isfinite(found).all():
        raise DataError(f"{where}: has no value; calibrate again")
    return found


def floats(value: Any) -> Array:
    """A saved value as it stands, of any shape; NaN where there is none."""
    return np.array(value, dtype=np.float64)


def _entries(name: str, p: SavedParameter) -> Iterator[Entry]:
    value, std = floats(p.value), floats(p.std)
    ends = np.stack([value, value]) if p.interval95 is None else floats(p.interval95)
    for k, place in enumerate(np.ndindex(value.shape)):
        if value[place] == 0 == std[place]:
            continue
        unit = p.unit if isinstance(p.unit, str) else p.unit[k % len(p.unit)]
        label = f"{name}[{','.join(map(str, place))}]" if place else name
        at, low, high = (float(x[place]) for x in (value, ends[0], ends[1]))
        shown = "" if unit == "1" else unit
        yield Entry(label, shown, at, float(std[place]), at - low, high - at)
