"""`casest check`: a saved result as new records are judged by it, and those records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET, Struct, UnsetType

from casest.correction.reading import typed
from casest.data import load_runs
from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.results.file import load_result, result_file
from casest.results.fitted import ranges
from casest.results.saved import SavedResult
from casest.saved.apply import MARGIN, fitted_unit
from casest.saved.model import of_other_records
from casest.validity.colour import Colour, autoregressive
from casest.validity.old import STATED, Old


class _Correlation(Struct, frozen=True):
    names: list[str]
    matrix: list[list[float | None]]
    std: list[float | None] | UnsetType = UNSET


class _Section(Struct, frozen=True):
    correlation: _Correlation | UnsetType = UNSET


class _Noise(Struct, frozen=True):
    sigma: list[float | None]
    stated: float | None = None
    degrees_of_freedom: int = 0
    correlated_over_samples: float | None = None


class _Spectrum(Struct, frozen=True):
    frequency: list[float]
    power: list[list[float]]
    samples_per_second: float | None = None


class _Judging(Struct, frozen=True, kw_only=True):
    """What is read of a result besides what `SavedResult` has."""

    noise: _Noise
    spectrum: _Spectrum | None = None
    conditions: dict[str, list[float]] = {}
    estimate: _Section | UnsetType = UNSET
    after: _Section | UnsetType = UNSET


def old_estimate(path: Path) -> tuple[Old, SavedResult]:
    """A saved result as new records are judged by it. Runs the model's file, if it has one."""
    content, where = load_result(path), str(result_file(path))
    result, more = typed(content, SavedResult, where), typed(content, _Judging, where)
    if result.innovations is not None:
        raise UsageError(
            f"{path}: the result is of {result.model}, an estimator in motion: `casest filter` "
            "says of a new record whether its innovations are as large as they should be"
        )
    if not result.trusted:
        raise UsageError(f"{path}: this estimate was refused: nothing can be judged by it")
    section = more.after or more.estimate
    correlation = section.correlation if section else UNSET
    if not correlation or not correlation.std:
        raise DataError(
            f"{where}: was made by an older casest, and does not say how uncertain its unknowns "
            "are together: calibrate again"
        )
    model, values = of_other_records(content)
    sigma = np.array([s for s in more.noise.sigma if s is not None], float)
    over = max(more.noise.correlated_over_samples or 1.0, 1.0)
    known = is_stated(more.noise)
    old = Old(
        model,
        values,
        tuple(correlation.names),
        _covariance(correlation, where),
        float(np.sqrt(np.mean(sigma**2))) if sigma.size else 0.0,
        STATED if known else more.noise.degrees_of_freedom / over,
        _colour(more, over, len(model.axes)),
    )
    return old, result


def is_stated(noise: _Noise) -> bool:
    """Is the noise of a result the one that was stated of it? A residual that was larger is not."""
    sigma = np.array([s for s in noise.sigma if s is not None], float)
    own = np.sqrt(np.mean(sigma**2)) if sigma.size else np.nan
    return noise.stated is not None and bool(np.isclose(own, noise.stated))


def noise_stated(path: Path) -> bool:
    """Was the noise of a saved result stated, and the residual no larger?"""
    return is_stated(typed(load_result(path), _Judging, str(result_file(path))).noise)


def _covariance(correlation: _Correlation, where: str) -> Array:
    assert correlation.std
    n = len(correlation.names)
    matrix = np.array(correlation.matrix, dtype=float).reshape(-1, n) if n else np.zeros((0, 0))
    std = np.array(correlation.std, dtype=float)
    if matrix.shape != (n, n) or std.shape != (n,):
        raise DataError(f"{where}: correlation: not that of {n} unknowns; calibrate again")
    return np.asarray(matrix * np.outer(std, std))


def _colour(more: _Judging, over: float, axes: int) -> Colour | None:
    found = more.spectrum
    if found is None:
        return autoregressive(over, axes)
    power = np.array(found.power, float)
    return Colour(np.array(found.frequency), power, found.samples_per_second or float("nan"))


def new_records(
    old: Old, result: SavedResult, data: Sequence[str], arguments: Mapping[str, Any]
) -> list[tuple[Run, ...]]:
    """The runs of each file, in the units of the fit."""
    signals = [s if s.unit else replace(s, unit=fitted_unit(result, s)) for s in old.model.signals]
    given = {**arguments, "at_rest": arguments.get("at_rest") or old.model.resting}
    return [load_runs([name], signals, **given) for name in data]


def remarks(
    result: SavedResult, data: Sequence[str], records: Sequence[tuple[Run, ...]]
) -> Iterator[str]:
    """What a reader should know of the records beside the verdict."""
    fitted = {Path(name).resolve() for name in result.data}
    for name in data:
        if Path(name).resolve() in fitted:
            yield f"{name} was calibrated with: it says nothing of the calibration's validity"
    yield from dict.fromkeys(note for runs in records for run in runs for note in run.notes)


def elsewhere(path: Path, runs: Sequence[Run]) -> dict[str, tuple[list[float], list[float]]]:
    """Columns of a record that lie outside what the calibration saw: range then, and now."""
    before = typed(load_result(path), _Judging, str(result_file(path))).conditions
    found = {}
    for name, (low, high) in ranges(runs).items():
        if name not in before or len(before[name]) != 2:
            continue
        was = before[name]
        margin = MARGIN * (was[1] - was[0]) + 1e-9 * max(abs(was[0]), abs(was[1]))
        if low > was[1] + margin or high < was[0] - margin:
            found[name] = (was, [low, high])
    return found
