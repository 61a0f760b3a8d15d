"""What a plan goes on from: a saved result's model, values, noise and information."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET, Struct, UnsetType

from casest.correction.reading import typed
from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.plan.candidates.candidates import marginal, of_last_run
from casest.results.file import load_result, result_file
from casest.results.saved import numbers
from casest.results.units import unit_table
from casest.saved.model import saved_model


class _Correlation(Struct, frozen=True):
    names: list[str]
    information: Any = None


class _Noise(Struct, frozen=True):
    sigma: Any
    unit: str = ""
    correlated_over_samples: float | None = 1.0


class _Section(Struct, frozen=True):
    correlation: _Correlation | UnsetType = UNSET


class _Result(Struct, frozen=True):
    noise: _Noise | None = None
    estimate: _Section | UnsetType = UNSET
    after: _Section | UnsetType = UNSET
    units: dict[str, str] = {}
    innovations: Any = None


@dataclass(frozen=True)
class Start:
    """Model and values (of the last run, where runs differ), `table` of all units.

    information: by the unknowns' names, (n, n), of those that new runs share, the others' being
    marginal. sigma (m,) of one residual, correlated over `over` samples. content: the whole result.
    """

    model: Model
    values: Mapping[str, Any]
    table: Mapping[str, str]
    names: tuple[str, ...]
    information: Array
    sigma: Array
    over: float
    content: Mapping[str, Any]


def started(path: Path) -> Start:
    """What is known from a saved result (a folder stands for the `result.json` in it)."""
    content, where = load_result(path), str(result_file(path))
    result = typed(content, _Result, where)
    if result.innovations is not None:
        raise UsageError(
            f"{where}: is of an estimator in motion: plan its motion with casest plan MODEL"
        )
    model, values = saved_model(content)
    section = result.after or result.estimate
    correlation = section.correlation if section else UNSET
    if result.noise is None or not correlation or correlation.information is None:
        raise DataError(f"{where}: was made by an older casest: calibrate again to plan from it")
    information = numbers(correlation.information, f"{where}: its information")
    n = len(correlation.names)
    if information.shape != (n, n):
        raise DataError(f"{where}: its information is not {n} by {n}; calibrate again")
    shared = sum(p.shape.coordinates for p in model.parameters if p.scope == "all")
    last = {name: of_last_run(model, name, value) for name, value in values.items()}
    sigma = numbers(result.noise.sigma, f"{where}: its noise")
    if not (sigma > 0).all():
        raise DataError(f"{where}: its noise is 0: say what it is, --sensor-noise SIGNAL=STD")
    return Start(
        model,
        last,
        _units(model, result.units),
        tuple(correlation.names[:shared]),
        marginal(information, shared),
        sigma,
        result.noise.correlated_over_samples or 1.0,
        content,
    )


def _units(model: Model, known: Mapping[str, str]) -> dict[str, str]:
    """Units of signals as the data had them, and of everything that follows from these."""
    signals = {s.name: np.zeros((0, s.size)) for s in model.signals}
    stated = {name: _readable(known.get(name)) for name in signals}
    return unit_table(model, [Run.raw("fitted", signals, units=stated)])


def _readable(unit: str | None) -> str | None:
    return unit if unit and "[" not in unit else None
