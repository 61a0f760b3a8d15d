"""Values typed on the command line: numbers, vectors, matrices, units, and saved results."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from casest import units
from casest.declaration.model import Model
from casest.declaration.shapes import in_words
from casest.declaration.symbols import Constant, Parameter, constant
from casest.errors import CasestError, UsageError
from casest.results.earlier import earlier_result

#: Between a value and its standard uncertainty.
_PLUS_MINUS = re.compile(r"\s*(?:±|\+/-|\+-)\s*")
#: What stands behind the last number; an exponent is part of the number.
_UNIT_BEHIND = re.compile(r"(?![eE][-+]?\d)[A-Za-z°µ%][^,;]*$")


def parse_value(name: str, text: str, option: str, model: Model) -> Constant:
    """`0.28`, `28 cm`, `1,2,3`, `1,0;0.1,1`, `@result.json`, `gravity(45.5, 120)`: a constant.

    With its standard uncertainty: `9.80665±0.0005 m/s^2`, `28 cm ± 1 mm`, `0.28 m +- 0.5%`.
    """
    old: Any = model[name]  # raises, with a suggestion, where there is no such name
    if text.startswith("@"):
        return _of_result(name, text, option, model)
    if _PLUS_MINUS.search(text):
        return _uncertain(name, text, option, model)
    place = re.fullmatch(r"(gravity|field)\(([^()]*)\)", text.replace(" ", ""))
    if place:
        return _of_place(place[1], place[2], f"{option} {name}={text}")
    if "," not in text and ";" not in text:
        try:
            number, unit = units.parse_quantity(text)
        except CasestError as error:
            raise type(error)(f"{option} {name}={text}: {error}") from None
        return _constant(number, unit or _declared_unit(old))
    behind = _UNIT_BEHIND.search(text)
    numbers = text[: behind.start()] if behind else text
    try:
        rows = [[float(cell) for cell in row.split(",")] for row in numbers.split(";")]
        array = np.array(rows if len(rows) > 1 else rows[0])
        stated = units.canonical(behind[0]) if behind else _declared_unit(old)
    except ValueError:
        raise UsageError(
            f"{option} {name}={text}: not a number, a list 1,2,3 or rows 1,0;0,1, with a unit "
            "behind it or none"
        ) from None
    except CasestError as error:
        raise type(error)(f"{option} {name}={text}: {error}") from None
    dims = old.shape.dims if isinstance(old, Parameter) else getattr(old, "dims", ())
    if array.shape == (2,) and not dims:
        raise UsageError(
            f"{option} {name}={text}: {name} is one number, and these are two; decimals stand "
            f"behind a point: {name}={text.replace(',', '.', 1)}"
        )
    return _constant(array, stated)


def _of_result(name: str, text: str, option: str, model: Model) -> Constant:
    """A value of an earlier result, of the form that the model's has."""
    earlier = earlier_result(text[1:], model, f"its {name}")
    value, old = earlier.constant(name), model[name]
    own = old.shape.dims if isinstance(old, Parameter) else value.array.shape
    if value.array.ndim and value.array.shape != own:
        raise UsageError(
            f"{option} {name}={text}: {name} of {earlier.result.model} is "
            f"{in_words(value.array.shape)}, that of {model.name} {in_words(own)}: calibrate with "
            f"{earlier.result.model}, or type the numbers that you mean"
        )
    return value


def _uncertain(name: str, text: str, option: str, model: Model) -> Constant:
    """`VALUE ± STD UNIT`: of each its own unit, else the other's; STD may be a percentage."""
    where = f"{option} {name}={text}"
    parts = _PLUS_MINUS.split(text)
    if len(parts) != 2 or not all(parts):
        raise UsageError(f"{where}: write VALUE±STD, as in 9.80665±0.0005 m/s^2")
    try:
        std, unit = _numbers(parts[1])
    except (ValueError, CasestError):
        raise UsageError(
            f"{where}: behind ± is {parts[1]!r}, and not a number with a unit"
        ) from None
    bare = not _UNIT_BEHIND.search(parts[0]) and "(" not in parts[0]
    shared = f" {unit}" if bare and unit not in (None, "%") else ""
    value = parse_value(name, parts[0] + shared, option, model)
    if unit == "%" and value.unit != "%":
        std = np.abs(value.array) * std / 100
    elif unit and unit != value.unit:
        std = std * units.conversion(unit, value.unit or "1")[0]
    try:
        made: Constant = constant(value.array, value.unit, std=std)
    except CasestError as error:
        raise UsageError(f"{where}: {error}") from None
    return made


def _numbers(text: str) -> tuple[Any, str | None]:
    """`0.0005 m/s^2` or `0.1,0.1,0.2`: numbers, and their unit if it is said."""
    behind = _UNIT_BEHIND.search(text)
    cells = (text[: behind.start()] if behind else text).split(",")
    numbers = np.array([float(cell) for cell in cells])
    return (numbers if len(cells) > 1 else numbers[0]), units.canonical(
        behind[0]
    ) if behind else None


def _of_place(what: str, arguments: str, where: str) -> Constant:
    """`gravity(latitude, height)` in m/s² or `field(latitude, longitude, height, year)` in uT."""
    from casest.cli.earth import magnetic_field, normal_gravity

    try:
        numbers = [float(x) for x in arguments.split(",")]
        if what == "gravity":
            latitude, height = numbers
            return _constant(normal_gravity(latitude, height), "m/s^2")
        return _constant(magnetic_field(*numbers).strength, "uT")
    except (ValueError, TypeError):
        raise UsageError(
            f"{where}: write gravity(latitude, height) or "
            "field(latitude, longitude, height, year), in degrees and metres"
        ) from None


def _declared_unit(symbol: Any) -> str:
    unit: str = symbol.units[0] if hasattr(symbol, "units") else symbol.unit
    return unit


def _constant(value: Any, unit: str) -> Constant:
    made: Constant = constant(value, unit)
    return made
