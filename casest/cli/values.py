"""Values typed on the command line: numbers, vectors, matrices, units, and saved results."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from casest import units
from casest.declaration.model import Model
from casest.declaration.symbols import Constant, constant
from casest.errors import CasestError, UsageError
from casest.results.saved import numbers, saved_result

#: What stands behind the last number; an exponent is part of the number.
_UNIT_BEHIND = re.compile(r"(?![eE][-+]?\d)[A-Za-z°µ%][^,;]*$")


def parse_value(name: str, text: str, option: str, model: Model) -> Constant:
    """`0.28`, `28 cm`, `1,2,3`, `1,0;0.1,1`, `@result.json`, `gravity(45.5, 120)`: a constant."""
    old: Any = model[name]  # raises, with a suggestion, where there is no such name
    if text.startswith("@"):
        return _from_result(name, text[1:])
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
    return _constant(array, stated)


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


def _from_result(name: str, path: str) -> Constant:
    result = saved_result(Path(path))
    parameters = result.parameters
    if name not in parameters:
        raise UsageError(
            f"{path} has no parameter {name!r} (it has {', '.join(parameters) or 'none'})"
        )
    if not result.trusted:
        raise UsageError(
            f"{path}: its estimate was refused; calibrate again before using its {name}"
        )
    found = parameters[name]
    return _constant(numbers(found.value, f"{path}: its {name}"), found.first_unit)


def _constant(value: Any, unit: str) -> Constant:
    made: Constant = constant(value, unit)
    return made
