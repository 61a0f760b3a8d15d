"""`casest check` of a correction in a file of ROS, Kalibr, ArduPilot or PX4."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from casest import units
from casest.correction.affine import SI, Affine
from casest.correction.formats import refuse_corrected
from casest.correction.formats_read import chosen, sensors_read
from casest.data import load_runs
from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant, constant
from casest.errors import UsageError
from casest.results.fitted import ranges
from casest.validity.old import Old

#: What such a file leaves open.
EXACT = (
    "the file does not say how uncertain its numbers are, nor the noise: they are taken as exact, "
    "and the noise is that of the new record"
)


def foreign_sensor(path: Path, columns: Mapping[str, Any]) -> Affine:
    """The one sensor in such a file that a known length checks, under the name of its columns."""
    sensors = chosen(sensors_read(path), columns, path)
    if len(sensors) > 1:
        names = " and ".join(s.signal for s in sensors)
        raise UsageError(f"{path}: check {names} one by one: --columns of one of them at a time")
    if sensors[0].kind == "gyroscope":
        raise UsageError(
            f"{path} corrects a gyroscope, which has no known length to be checked by; "
            "accelerometers and magnetometers have"
        )
    return sensors[0]


def foreign_estimate(sensor: Affine, model: Model, norm: Constant) -> Old:
    """The sensor as `model` (`norm-triangular`) has it, in SI units, with the known length `norm`:
    exact, and of unknown noise."""
    unit = SI[sensor.kind]
    factor = 1.0 if "[" in norm.unit else units.conversion(norm.unit, unit)[0]
    model = model.having(norm=constant(factor * float(norm.array), unit))
    values = {"scale": _lower(sensor.matrix), "offset": sensor.offset}
    names = tuple(name for p in model.parameters for name in p.entry_names)
    return Old(model, values, names, np.zeros((len(names),) * 2), np.nan, 0.0, None)


def foreign_records(
    sensor: Affine, model: Model, data: Sequence[str], arguments: Mapping[str, Any]
) -> list[tuple[Run, ...]]:
    """The runs of each file in SI units, where the sensor's columns are the model's reading."""
    (reading,) = model.signals
    own = dict(arguments)
    for key in ("columns", "units", "scales"):
        given = own.get(key) or {}
        own[key] = {reading.name if n == sensor.signal else n: v for n, v in given.items()}
    known = [replace(reading, unit=SI[sensor.kind])]
    found = [load_runs([name], known, **own) for name in data]
    for runs in found:
        refuse_corrected([sensor], ranges(runs))
    return found


def renamed(command: str, sensor: Affine, model: Model) -> str:
    """The command with the columns of the sensor as those of the model's reading."""
    (reading,) = model.signals
    own, new = f"{sensor.signal}=", f"{reading.name}="
    words = shlex.split(command)
    return shlex.join([new + w.removeprefix(own) if w.startswith(own) else w for w in words])


def in_words(old: Old, name: str) -> str:
    """A value as `--fix` takes it."""
    rows = np.atleast_2d(old.values[name]).tolist()
    return ";".join(",".join(map(repr, row)) for row in rows)


def _lower(matrix: Array) -> Array:
    """The lower triangular L with ‖Lx‖ = ‖Mx‖ for every x: no length shows a rotation."""
    turned = np.linalg.cholesky((matrix.T @ matrix)[::-1, ::-1])
    return np.asarray(turned.T[::-1, ::-1])
