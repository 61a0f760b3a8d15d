"""The uncertainty budget of a saved result, as in the GUM: inputs, and their shares."""

from __future__ import annotations

from pathlib import Path

from msgspec import UNSET, Struct, UnsetType

from casest.correction.reading import typed
from casest.errors import UsageError
from casest.results.file import load_result, result_file
from casest.results.result import Number, Result
from casest.results.uncertainty import CorrectedBudget, Covariance, Input
from casest.results.validation import Validated

#: Correlation from which on it is told.
NOTABLE = 0.1
#: Share of a value's standard uncertainty below which an input does not move it.
LITTLE = 1e-6


class Quantity(Struct, frozen=True):
    """A value with standard uncertainty; degrees of freedom null where that is as good as known."""

    name: str
    value: Number
    std: Number
    unit: str
    degrees_of_freedom: Number


class Pair(Struct, frozen=True):
    """Correlation of two values."""

    names: tuple[str, str]
    correlation: float


class Budget(Result, frozen=True, kw_only=True, dict=True):
    """The content of `budget.json`; `correlations` are those of a tenth and more, largest first."""

    result: str
    trusted: bool
    values: list[Quantity]
    inputs: list[Input]
    correlations: list[Pair]
    corrected: CorrectedBudget | None
    validation: Validated | UnsetType = UNSET


class _Section(Struct, frozen=True):
    covariance: Covariance | UnsetType = UNSET
    inputs: list[Input] | UnsetType = UNSET
    degrees_of_freedom: dict[str, Number] | UnsetType = UNSET


class _Saved(Struct, frozen=True):
    model: str
    trusted: bool
    estimate: _Section | UnsetType = UNSET
    after: _Section | UnsetType = UNSET
    corrected_budget: CorrectedBudget | None = None


def budget_of(path: Path) -> Budget:
    """The budget of a saved result (a folder stands for the `result.json` in it).

    Raises UsageError where the result was refused, or is of a casest that kept no covariance.
    """
    raw, where = load_result(path), str(result_file(path))
    saved = typed(raw, _Saved, where)
    section = saved.after or saved.estimate
    if not saved.trusted:
        raise UsageError(f"{path}: this estimate was refused, and has no uncertainty to speak of")
    if not section or not (section.covariance and section.inputs):
        raise UsageError(f"{path}: was made by an older casest, without a budget: calibrate again")
    return Budget(
        model=saved.model,
        result=str(path),
        trusted=saved.trusted,
        values=_values(section.covariance, section.degrees_of_freedom or {}),
        inputs=section.inputs,
        correlations=_correlations(section.covariance),
        corrected=saved.corrected_budget,
    )


def sensitivities(budget: Budget) -> tuple[list[str], list[list[str]]]:
    """Names of the references, and for each value how it follows them: its unit over theirs.

    Zero where a standard uncertainty moves it by less than a millionth of its own.
    """
    moving = [i for i in budget.inputs if i.sensitivity]
    rows = []
    for value in budget.values:
        if value.std is not None:
            row = [_moved(i.sensitivity.get(value.name), i.std, value.std) for i in moving]
            rows.append([value.name, *row])
    return [i.name for i in moving], rows


def _moved(slope: Number, by: Number, std: float) -> str:
    if slope is None or by is None:
        return ""
    return f"{slope:.3g}" if abs(slope) * by >= LITTLE * std else "0"


def covariance_in(path: Path) -> Covariance:
    """Every number of a result that has a budget, with the covariance of all."""
    saved = typed(load_result(path), _Saved, str(result_file(path)))
    section = saved.after or saved.estimate
    assert section
    assert section.covariance
    return section.covariance


def _values(found: Covariance, freedom: dict[str, Number]) -> list[Quantity]:
    every = zip(found.names, found.values, found.units, strict=True)
    return [
        Quantity(name, value, _root(found.matrix[i][i]), unit, freedom.get(name))
        for i, (name, value, unit) in enumerate(every)
    ]


def _root(variance: Number) -> Number:
    return None if variance is None else max(variance, 0.0) ** 0.5


def _correlations(found: Covariance) -> list[Pair]:
    """Those that are worth a word, the strongest first."""
    std = [_root(found.matrix[i][i]) for i in range(len(found.names))]
    pairs = []
    for i, a in enumerate(found.names):
        for j, b in enumerate(found.names[:i]):
            shared, both = found.matrix[i][j], (std[i] or 0.0) * (std[j] or 0.0)
            if shared is not None and both > 0 and abs(shared) >= NOTABLE * both:
                pairs.append(Pair((b, a), shared / both))
    return sorted(pairs, key=lambda pair: -abs(pair.correlation))
