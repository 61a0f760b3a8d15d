"""Units of declarations: converted when a declaration changes, refused where they do not fit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from casest import units
from casest.declaration.symbols import Constant, Parameter, Symbol, constant
from casest.declaration.uncertainty import Uncertainty
from casest.errors import UnitError, UsageError


def converted_constant(name: str, new: Constant, unit: str) -> Constant:
    """The constant in the declared unit; left alone where that depends on the data."""
    fitting_unit(name, unit, new.unit)
    if not new.unit or new.unit == unit or "[" in unit + new.unit or "," in unit:
        return new
    factor, offset = units.conversion(new.unit, unit or "1")
    converted: Constant = constant(factor * new.array + offset, unit)
    if new.uncertainty is not None:
        converted = replace(converted, uncertainty=new.uncertainty.scaled(factor))
    return converted


def uncertainty_of_coordinates(name: str, new: Constant, old: Parameter) -> Uncertainty | None:
    """What is known of the coordinates of a parameter that is fixed at a constant."""
    known, shape = new.uncertainty, old.shape
    if known is None or len(known) == shape.coordinates:
        return known
    if shape.curved or new.array.shape != shape.dims:
        raise UsageError(
            f"{name} has {shape.coordinates} coordinates, and {len(known)} standard deviations do "
            "not fit: give a value with all its entries, or take it from a result"
        )
    return known.only([int(np.ravel_multi_index(i, new.array.shape)) for i in shape.entries])


def converted_parameter(name: str, new: Parameter, old: Symbol) -> Parameter:
    """The parameter in the declared unit: the body computes in that one."""
    unit = old.unit or ""
    fitting_unit(name, unit, new.unit)
    if isinstance(old, Parameter) and len(set(old.units)) > 1:
        return replace(new, units=old.units) if not new.unit else new
    if not new.unit:
        return replace(new, units=(unit,) * new.shape.size)
    if new.unit == unit or "[" in unit + new.unit or "," in new.unit:
        return new
    factor, offset = units.conversion(new.unit, unit or "1")

    def converted(values: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(factor * v + offset for v in values)

    return replace(
        new,
        units=(unit,) * new.shape.size,
        start=None if new.start is None else converted(new.start),
        lower=converted(new.lower),
        upper=converted(new.upper),
    )


def fitting_unit(name: str, old: str, new: str) -> None:
    """Refuse a unit of another dimension than the declared one."""
    if not new or new == old or "[" in old or "[" in new or "," in old:
        return
    try:
        units.conversion(new, old or "1")
    except UnitError:
        raise UnitError(
            f"{name} is declared in {old or 'no unit'!r}: {new!r} does not fit"
        ) from None


def check_units_known(model_name: str, declared: Iterable[Symbol]) -> None:
    """Raise UnitError naming the symbol whose unit nobody knows."""
    for symbol in declared:
        every = symbol.units if isinstance(symbol, Parameter) else (symbol.unit,)
        for unit in every:
            if unit and "[" not in unit and not units.known(unit):
                units_error = f"model {model_name}: {symbol.name} has unknown unit {unit!r}"
                raise UnitError(f"{units_error}; write it as in 'm/s^2', 'rad', 'degC', '1/count'")
