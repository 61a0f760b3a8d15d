"""What an earlier result knows of its parameters: values with their whole covariance."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from casest.declaration.model import Model
from casest.declaration.prior import Prior
from casest.declaration.shapes import Array, Shape
from casest.declaration.symbols import Constant, Parameter, constant
from casest.declaration.uncertainty import Uncertainty, found_together
from casest.errors import DataError, DeclarationError, UnitError, UsageError
from casest.results.file import result_file
from casest.results.saved import SavedResult, numbers, saved_result


@dataclass(frozen=True)
class Earlier:
    """Parameters of a saved result by name, and how wrong they may be together.

    `places` says which numbers of `known` are a parameter's: its entries, or the coordinates of a
    direction or rotation. Missing are those without a standard deviation (on a bound).
    """

    path: str
    result: SavedResult
    values: Mapping[str, Array]
    known: Uncertainty
    places: Mapping[str, tuple[int, ...]]

    def constant(self, name: str) -> Constant:
        """One parameter as a constant, as uncertain as it was found to be."""
        if name not in self.values:
            there = ", ".join(self.values) or "none"
            raise UsageError(f"{self.path} has no parameter {name!r} (it has {there})")
        made: Constant = constant(self.values[name], self.result.parameters[name].first_unit)
        if name not in self.places:
            return made
        return replace(made, uncertainty=self.known.only(self.places[name]))

    def prior(self, model: Model, units: Mapping[str, str]) -> Prior:
        """What it knows of the parameters that all runs of a model share.

        `units` are those that the model's parameters have with the new data. Raises UsageError
        where the result is of another model, UnitError where a parameter had another unit.
        """
        if self.result.model != model.name and not _same_file(self.result.model, model):
            raise UsageError(
                f"{self.path} is a result of {self.result.model}, and no prior for {model.name}"
            )
        names = [p.name for p in model.parameters if p.scope == "all" and p.name in self.places]
        if not names:
            raise UsageError(f"{self.path} knows none of the parameters of {model.name}")
        for name in names:
            _check_unit(self.path, name, self.result.parameters[name].first_unit, units)
        known = self.known.only([i for name in names for i in self.places[name]]).covariance
        if self.result.noise is None or not self.result.noise.sigma[0]:
            raise UsageError(
                f"{self.path} has no noise: calibrate again before using it as --prior"
            )
        return Prior(
            tuple(names),
            tuple(tuple(map(float, self.values[name].ravel())) for name in names),
            tuple(self.values[name].shape for name in names),
            tuple(tuple(map(float, row)) for row in known),
            self.result.noise.sigma[0],
            self.path,
        )


def _same_file(name: str, model: Model) -> bool:
    """Is a result's model `path.py:name` declared in a file of the same name as this one?"""
    path, _, own = name.partition(":")
    file = Path(inspect.unwrap(model.function).__code__.co_filename).name
    return Path(path).name == file and own.replace("_", "-") in ("", model.name)


def _check_unit(path: str, name: str, before: str, units: Mapping[str, str]) -> None:
    """Refuse a prior in another unit than the data lead to."""
    now = units.get(name) or units.get(f"{name}[0]") or units.get(f"{name}[0,0]") or before
    if now != before:
        raise UnitError(
            f"{path}: its {name} is in {before}, and with these data it is in {now}; give the data "
            "in the unit of the earlier calibration (--unit)"
        )


def earlier_result(path: str, model: Model, what: str = "it") -> Earlier:
    """A trusted result, read again for a model that has parameters of the same names.

    `what` of it is wanted.
    """
    saved = saved_result(Path(path))
    if not saved.trusted:
        raise UsageError(f"{path}: its estimate was refused; calibrate again before using {what}")
    where = str(result_file(Path(path)))
    values = {n: numbers(p.value, f"{path}: its {n}") for n, p in saved.parameters.items()}
    owners, matrix = _covariance(saved, where)
    maps, places, kept, at = [np.zeros((0, 0))], dict[str, tuple[int, ...]](), list[int](), 0
    for name, value in values.items():
        own = [i for i, owner in enumerate(owners) if owner == name]
        if not own or np.isnan(matrix[own][:, own]).any() or value.ndim > 2:
            continue
        step = _to_coordinates(_shape(model, name), value, len(own))
        maps.append(step)
        places[name] = tuple(range(at, at + len(step)))
        kept += own
        at += len(step)
    slope = block_diag(*maps)
    try:
        known = found_together(slope @ matrix[np.ix_(kept, kept)] @ slope.T, where)
    except DeclarationError as error:
        raise DataError(f"{where}: {error}; a result is not edited by hand") from None
    return Earlier(path, saved, values, known, places)


def _covariance(saved: SavedResult, where: str) -> tuple[list[str], Array]:
    """Whose each entry is, and the covariance of all, NaN where there is none.

    A result of an older casest has standard deviations alone.
    """
    section = saved.after or saved.estimate
    if section and section.covariance:
        found = section.covariance
        owners = [name.partition("[")[0].partition(" (")[0] for name in found.names]
        matrix = np.array(found.matrix, dtype=float).reshape(-1, len(owners))
        if len(matrix) != len(owners):
            raise DataError(f"{where}: its covariance is no square; calibrate again")
        return owners, matrix
    owners, stds = [], list[float]()
    for name, p in saved.parameters.items():
        own = np.ravel(np.array(p.std, dtype=float))
        owners += [name] * own.size
        stds += own.tolist()
    return owners, np.diag(np.square(stds))


def _shape(model: Model, name: str) -> Shape | None:
    """The shape of a parameter, or of a constant that was one; None of others."""
    symbol = model.symbols.get(name)
    if isinstance(symbol, Constant):
        symbol = symbol.frozen
    return symbol.shape if isinstance(symbol, Parameter) else None


def _to_coordinates(shape: Shape | None, value: Array, entries: int) -> Array:
    """Slope (coordinates, entries) of a parameter's coordinates at a value."""
    if shape is None or not shape.curved or value.shape != shape.dims:
        return np.eye(entries)
    reference = shape.reference(value)
    steps = np.eye(entries).reshape(entries, *shape.dims)
    return np.stack([shape.tangent(step, reference) for step in steps], axis=1)
