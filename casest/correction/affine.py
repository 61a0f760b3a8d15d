"""A correction as offsets and matrices, one for each sensor of three axes, in SI units.

What autopilots and robots read are such numbers: corrected = matrix·(reading − offset), with what a
current adds to the reading where a model has one. They are taken from the correction itself, which
is asked at the readings of the fit and must be linear there; nothing depends on a model's names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from casest import units
from casest.correction import runtime
from casest.correction.numpy_module import as_data
from casest.correction.program import Input, Program
from casest.declaration.shapes import Array
from casest.errors import UnitError, UsageError

Kind = Literal["accelerometer", "gyroscope", "magnetometer"]

#: SI unit of each kind of sensor.
SI: dict[Kind, str] = {"accelerometer": "m/s^2", "gyroscope": "rad/s", "magnetometer": "T"}
#: Share of the corrected values' size by which a linear correction may miss them: rounding.
LINEAR = 1e-9


@dataclass(frozen=True)
class Affine:
    """corrected = matrix (3, 3)·(reading − offset (3,) − per_ampere (3,)·current), in SI units.

    `signal` is the reading's name in the model.
    """

    kind: Kind
    signal: str
    matrix: Array
    offset: Array
    per_ampere: Array | None = None


def sensors_of(
    built: Program, readings: Array, constant_units: Mapping[str, str], to: str
) -> tuple[Affine, ...]:
    """The sensors that are corrected; UsageError where that takes more than offsets and matrices.

    `readings` (n, width) of the fit; `constant_units` of the model's constants: a known gravity or
    field says the unit of what comes out where the output has none of its own.
    """
    vectors = [i for i in built.inputs if i.size == 3 and i.kind == "plain"]
    currents = [i for i in built.inputs if i.size == 1 and _is(i.unit, "A")]
    rest = [i.name for i in built.inputs if i not in (*vectors, *currents)]
    if not vectors or built.output.size != 3 * len(vectors):
        raise UsageError(
            f"the correction gives {built.output.name} of {built.output.size} numbers from "
            f"{', '.join(i.name for i in built.inputs)}; a file of {to} is for sensors of three "
            "axes"
        )
    if rest:
        raise UsageError(
            f"the correction follows {', '.join(rest)}, for which a file of {to} has no place: "
            "--to c, python or json has it"
        )
    A, b = _linear(built, readings, to)
    return tuple(_sensors(built, A, b, vectors, currents, constant_units, to))


def _is(unit: str, other: str) -> bool:
    """Does a unit measure the same as another?"""
    try:
        units.conversion(unit, other)
    except (UnitError, UsageError):
        return False
    return True


def _linear(built: Program, readings: Array, to: str) -> tuple[Array, Array]:
    """A (size, width) and b (size,) of the correction; UsageError where it bends."""
    steps = as_data(built)
    middle, reach = readings.mean(axis=0), np.ptp(readings, axis=0)
    reach = np.where(reach > 0, reach, np.maximum(np.abs(middle), 1.0))
    trial = np.vstack([middle, middle + 0.5 * np.diag(reach)])
    found = runtime.attempted(steps, trial)
    A = (found[1:] - found[0]).T / (0.5 * reach)
    b = found[0] - A @ middle
    expected = runtime.attempted(steps, readings)
    size = np.abs(expected).max(initial=1e-300)
    if not np.abs(readings @ A.T + b - expected).max(initial=0.0) <= LINEAR * size:
        raise UsageError(
            f"the correction is no straight line in the readings, and a file of {to} holds offsets "
            "and matrices alone: --to c, python or json has all of it"
        )
    return A, b


def _sensors(
    built: Program,
    A: Array,
    b: Array,
    vectors: Sequence[Input],
    currents: Sequence[Input],
    constant_units: Mapping[str, str],
    to: str,
) -> Iterator[Affine]:
    place = {i.name: sum(k.size for k in built.inputs[:n]) for n, i in enumerate(built.inputs)}
    for i in vectors:
        own = A[:, place[i.name] : place[i.name] + 3]
        rows = np.flatnonzero(np.abs(own).max(axis=1) > LINEAR * np.abs(own).max())
        first = 3 * (int(rows[0]) // 3) if rows.size else 0
        block = slice(first, first + 3)
        others = [A[block, place[o.name] : place[o.name] + 3] for o in vectors if o is not i]
        mixed = any(np.abs(o).max(initial=0.0) > LINEAR * np.abs(own).max() for o in others)
        if mixed or rows[-1] >= first + 3:
            raise UsageError(
                f"what is corrected of {i.name} depends on other sensors too, for which a file of "
                f"{to} has no place: --to c, python or json has it"
            )
        matrix = own[block]
        shift = np.linalg.solve(matrix, b[block])
        ampere = [_per_ampere(matrix, A[block, place[c.name]], c.unit) for c in currents]
        per_ampere = ampere[0] if ampere and np.any(ampere[0]) else None
        yield _in_si(
            i, built.output.unit, matrix, np.asarray(-shift), per_ampere, constant_units, to
        )


def _per_ampere(matrix: Array, column: Array, unit: str) -> Array:
    """What an ampere adds to the reading."""
    return np.asarray(-np.linalg.solve(matrix, column) / units.conversion(unit, "A")[0])


def _in_si(
    reading: Input,
    corrected: str,
    matrix: Array,
    offset: Array,
    per_ampere: Array | None,
    constant_units: Mapping[str, str],
    to: str,
) -> Affine:
    kind = next((k for k, unit in SI.items() if _is(reading.unit, unit)), None)
    if kind is None:
        raise UsageError(
            f"{reading.name} is in {reading.unit or 'a unit that nobody stated'}: a file of {to} "
            "corrects readings in m/s^2, rad/s or gauss; calibrate again with "
            f"--unit {reading.name}=… (g, dps, uT), and --scale if the record holds raw counts"
        )
    known = [corrected, *constant_units.values(), *([reading.unit] if not corrected else [])]
    out = next((unit for unit in known if unit and _is(unit, SI[kind])), None)
    if out is None:
        raise UsageError(
            f"{reading.name} is corrected to {corrected or 'a pure number'}: a file of {to} needs "
            f"{SI[kind]}; calibrate again with the known length in its unit, as --set 'norm=0.48 "
            "gauss'"
        )
    own, into = units.conversion(reading.unit, SI[kind])[0], units.conversion(out, SI[kind])[0]
    current = None if per_ampere is None else own * per_ampere
    return Affine(kind, reading.name, matrix * into / own, own * offset, current)


def program_of(sensors: Sequence[Affine]) -> Program:
    """The correction of one or several sensors as a program, readings and corrections in SI."""
    steps: list[tuple[object, ...]] = []
    inputs = [Input(s.signal, 3, SI[s.kind]) for s in sensors]
    registers = 0

    def put(operation: str, *operands: object) -> int:
        nonlocal registers
        steps.append((operation, registers, *operands))
        registers += 1
        return registers - 1

    for k, s in enumerate(sensors):
        away = []
        for axis in range(3):
            given = put("input", 3 * k + axis)
            away.append(put("sub", given, put("constant", float(s.offset[axis]))))
        for row in range(3):
            total = put("mul", put("constant", float(s.matrix[row, 0])), away[0])
            for axis in (1, 2):
                part = put("mul", put("constant", float(s.matrix[row, axis])), away[axis])
                total = put("add", total, part)
            steps.append(("output", 3 * k + row, total))
    unit = SI[sensors[0].kind] if len(sensors) == 1 else ""
    out = Input("corrected", 3 * len(sensors), unit)
    return Program("", "direct", tuple(inputs), out, registers, tuple(steps))
