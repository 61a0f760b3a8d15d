"""What an ArduPilot log says that the autopilot has done to a compass's readings, and undoing it.

MagX, MagY, MagZ hold corrected readings: D·(reading + COMPASS_OFS) and behind that what motors add,
D symmetric, of COMPASS_DIA and COMPASS_ODI, times COMPASS_SCALE (correct_field of
AP_Compass_Backend.cpp; old firmware has motors inside D). Offsets and what motors add are logged
beside the readings, D as parameters alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.errors import DataError

#: How a topic is called whose readings are to be as the sensor made them.
RAW = ".raw"
READING, OFFSET = ("MagX", "MagY", "MagZ"), ("OfsX", "OfsY", "OfsZ")
MOTOR = (("MOX", "MOY", "MOZ"), ("MOfsX", "MOfsY", "MOfsZ"))
#: What is not there any more once it is taken off.
ADDED = frozenset((*OFFSET, *(name for names in MOTOR for name in names)))
MILLIGAUSS = "mgauss"
#: By which an offset that is logged as a whole number may differ from the parameter, milligauss.
WHOLE = 1.0

Array = NDArray[np.float64]
Parameters = Mapping[str, Sequence[float]]


def compass_parameters(records: NDArray[Any] | None) -> dict[str, list[float]]:
    """The values that each parameter of the compasses had, in their order, of messages PARM."""
    found: dict[str, list[float]] = {}
    for record in records if records is not None else ():
        name, value = record["Name"].decode("latin-1"), float(record["Value"])
        if name.startswith("COMPASS_") and value not in found.setdefault(name, []):
            found[name].append(value)
    return found


def is_compass(fields: Mapping[str, Array]) -> bool:
    """Does a topic hold readings beside what was added to them?"""
    return all(name in fields for name in (*READING, *OFFSET))


def as_logged(topic: str, fields: Mapping[str, Array], given: Parameters) -> list[str]:
    """A note where the readings of a topic (in milligauss) are not those of its sensor."""
    offset, motor = _together(fields, OFFSET), _together(fields, _motor(fields))
    D = None
    with suppress(DataError):
        D = _done(topic, offset, given)[0]
    if not offset.any() and not motor.any() and D is not None and _nothing(D):
        return []
    return [
        "MagX, MagY, MagZ are as the autopilot corrected them (OfsX, OfsY, OfsZ "
        f"{_listed(offset[0])}): the topic {topic}{RAW} is what the sensor read, for which "
        "parameters of an autopilot are made"
    ]


def as_read(topic: str, fields: Mapping[str, Array], given: Parameters) -> tuple[Array, str]:
    """What the sensor read, (N, 3) in milligauss, and a note.

    DataError where the log does not tell it.
    """
    offset, motor = _together(fields, OFFSET), _together(fields, _motor(fields))
    D, exact = _done(topic, offset, given)
    reading = np.linalg.solve(D, (_together(fields, READING) - motor).T).T - exact
    parts = [f"their offsets ({_listed(offset[0])})"]
    parts += ["what motors add"] if motor.any() else []
    parts += [] if _nothing(D) else ["the matrix COMPASS_DIA and ODI"]
    return reading, f"MagX, MagY, MagZ as the sensor read them: {', '.join(parts)} taken off"


def _nothing(D: Array) -> bool:
    return bool(np.array_equal(D, np.eye(3)))


def _done(topic: str, offset: Array, given: Parameters) -> tuple[Array, Array]:
    """D and the offsets of a compass, as its parameters have them where the logged ones, (N, 3),
    which may be whole numbers, say which they are.

    DataError where parameters changed, or D is not known.
    """
    numbers = [n for n in ("", "2", "3") if f"COMPASS_OFS{n}_X" in given]
    own = [n for n in numbers if np.abs(_three(given, "OFS", n, 0.0) - offset).max() < WHOLE]
    if len(own) == 1:
        return _symmetric(given, own[0]), _three(given, "OFS", own[0], 0.0)
    if all(_nothing(_symmetric(given, n)) for n in numbers):
        return np.eye(3), offset
    raise DataError(
        f"{topic}{RAW}: its offsets {_listed(offset[0])} are not those of one compass among the "
        "log's parameters, so that the matrix COMPASS_DIA of its readings is not known"
    )


def _symmetric(given: Parameters, number: str) -> Array:
    diagonal = _three(given, "DIA", number, 1.0)
    D = np.diag(diagonal if diagonal.any() else np.ones(3))
    beside = _three(given, "ODI", number, 0.0)
    D[[0, 0, 1], [1, 2, 2]] = D[[1, 2, 2], [0, 0, 1]] = beside
    return np.asarray(D * (_one(given, f"COMPASS_SCALE{number}", 1.0) or 1.0))


def _three(given: Parameters, what: str, number: str, default: float) -> Array:
    return np.array([_one(given, f"COMPASS_{what}{number}_{a}", default) for a in "XYZ"])


def _one(given: Parameters, name: str, default: float) -> float:
    values = given.get(name, [default])
    if len(values) > 1:
        raise DataError(
            f"{name} was set anew within the log, from {values[0]:g} to {values[1]:g}: what the "
            "sensor read is not known throughout; take a log without that"
        )
    return values[0]


def _motor(fields: Mapping[str, Array]) -> Sequence[str]:
    return next((names for names in MOTOR if all(n in fields for n in names)), ())


def _together(fields: Mapping[str, Array], names: Sequence[str]) -> Array:
    """Fields side by side, (N, 3); zeros where none are named."""
    if not names:
        return np.zeros((len(fields["MagX"]), 3))
    return np.stack([fields[name] for name in names], axis=1)


def _listed(values: Array) -> str:
    return ", ".join(f"{v:g}" for v in values)
