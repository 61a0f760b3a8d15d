"""The files of ROS, Kalibr, ArduPilot and PX4 read back: the sensors that they correct."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from casest.correction.affine import Affine, Kind
from casest.correction.formats import AXES, BESIDE, GAUSS, MILLIGAUSS
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError, library

#: What readings of each kind are called in commands, as in a model of a whole unit.
LETTERS: dict[Kind, str] = {"accelerometer": "a", "gyroscope": "w", "magnetometer": "m"}
YAML, PARAMETERS = (".yaml", ".yml"), (".param", ".parm", ".params")


def is_foreign(path: Path) -> bool:
    """Is this a file in another project's form, by its name?"""
    return path.suffix.lower() in (*YAML, *PARAMETERS) and not path.is_dir()


def sensors_read(path: Path) -> tuple[Affine, ...]:
    """The sensors that such a file corrects; DataError where it corrects none."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    if path.suffix.lower() in YAML:
        found = _of_yaml(_yaml(path, text), str(path))
    else:
        given = _parameters(text)
        found = [*_ardupilot(given, str(path)), *_px4(given, str(path))]
    if not found:
        raise DataError(
            f"{path}: corrects no sensor: it has neither SM and bias (ROS), accelerometers or "
            "gyroscopes (Kalibr), INS_ACCOFFS_X or COMPASS_OFS_X (ArduPilot), nor CAL_ACC0_XOFF or "
            "CAL_MAG0_XOFF (PX4)"
        )
    return tuple(found)


def chosen(sensors: tuple[Affine, ...], named: Mapping[str, Any], path: Path) -> tuple[Affine, ...]:
    """Those whose readings the command names, under that name: a, w, m, or v for the only one."""
    own = [s for s in sensors if s.signal in named]
    if own:
        return tuple(own)
    if len(sensors) == 1:
        return (replace(sensors[0], signal="v"),)
    names = ", ".join(f"{s.signal} (the {s.kind})" for s in sensors)
    raise UsageError(f"{path} corrects {names}: say whose readings the columns are, --columns a=…")


# -- autopilots ------------------------------------------------------------------------------------


def _parameters(text: str) -> dict[str, float]:
    """Names and values: `NAME,VALUE`, `NAME VALUE`, or QGroundControl's five columns."""
    found: dict[str, float] = {}
    for line in text.splitlines():
        words = re.split(r"[\s,]+", line.partition("#")[0].strip())
        name = next(
            (k for k, word in enumerate(words) if re.fullmatch("[A-Z][A-Z0-9_]+", word)), -1
        )
        if 0 <= name < len(words) - 1:
            with suppress(ValueError):
                found[words[name]] = float(words[name + 1])
    return found


def _vector(
    given: Mapping[str, float], name: str, where: str, default: float | None
) -> Array | None:
    """Three parameters; None where none is there, DataError where some are."""
    names = [name.format(a) for a in AXES]
    there = [n for n in names if n in given]
    if not there:
        return None if default is None else np.full(3, default)
    if len(there) < 3:
        missing = next(n for n in names if n not in given)
        raise DataError(f"{where}: has {there[0]} and no {missing}")
    return np.array([given[n] for n in names])


def _sensor(kind: Kind, matrix: Array, offset: Array, ampere: Array | None = None) -> Affine:
    return Affine(kind, LETTERS[kind], matrix, offset, ampere)


def _symmetric(diagonal: Array | None, beside: Array | None) -> Array:
    matrix = np.diag(np.ones(3) if diagonal is None or not diagonal.any() else diagonal)
    for k, (i, j) in enumerate(BESIDE):
        matrix[i, j] = matrix[j, i] = 0.0 if beside is None else beside[k]
    return matrix


def _ardupilot(given: Mapping[str, float], where: str) -> list[Affine]:
    found = []
    offset = _vector(given, "INS_ACCOFFS_{}", where, None)
    if offset is not None:
        scale = _vector(given, "INS_ACCSCAL_{}", where, 1.0)
        found.append(_sensor("accelerometer", _symmetric(scale, None), offset))
    offset = _vector(given, "INS_GYROFFS_{}", where, None)
    if offset is not None:
        found.append(_sensor("gyroscope", np.eye(3), offset))
    offset = _vector(given, "COMPASS_OFS_{}", where, None)
    if offset is not None:
        D = _symmetric(
            _vector(given, "COMPASS_DIA_{}", where, 1.0),
            _vector(given, "COMPASS_ODI_{}", where, 0.0),
        ) * (given.get("COMPASS_SCALE") or 1.0)
        motor = _vector(given, "COMPASS_MOT_{}", where, None)
        ampere = None
        if motor is not None and motor.any() and given.get("COMPASS_MOTCT") == 2:
            ampere = np.asarray(-np.linalg.solve(D, motor) / MILLIGAUSS)
        found.append(_sensor("magnetometer", D, -offset / MILLIGAUSS, ampere))
    return found


def _px4(given: Mapping[str, float], where: str) -> list[Affine]:
    found = []
    offset = _vector(given, "CAL_ACC0_{}OFF", where, None)
    if offset is not None:
        scale = _vector(given, "CAL_ACC0_{}SCALE", where, 1.0)
        found.append(_sensor("accelerometer", _symmetric(scale, None), offset))
    offset = _vector(given, "CAL_GYRO0_{}OFF", where, None)
    if offset is not None:
        found.append(_sensor("gyroscope", np.eye(3), offset))
    offset = _vector(given, "CAL_MAG0_{}OFF", where, None)
    if offset is not None:
        S = _symmetric(
            _vector(given, "CAL_MAG0_{}SCALE", where, 1.0),
            _vector(given, "CAL_MAG0_{}ODIAG", where, 0.0),
        )
        power = _vector(given, "CAL_MAG0_{}COMP", where, None)
        ampere = None
        if power is not None and power.any() and given.get("CAL_MAG_COMP_TYP") in (2, 3):
            ampere = -power / (1e3 * GAUSS)
        found.append(_sensor("magnetometer", S, offset / GAUSS, ampere))
    return found


# -- YAML ------------------------------------------------------------------------------------------


def _yaml(path: Path, text: str) -> Any:
    yaml = library("ruamel.yaml", "ros", f"{path}: a YAML file")
    try:
        return yaml.YAML(typ="safe", pure=True).load(text)
    except yaml.error.YAMLError as error:
        first = str(error).strip().splitlines()[0]
        raise DataError(f"{path}: is no YAML ({first})") from None


def _of_yaml(content: Any, where: str) -> list[Affine]:
    if not isinstance(content, dict):
        return []
    if "SM" in content:  # imu_calib
        matrix = _numbers(content, "SM", (3, 3), where)
        bias = _numbers(content, "bias", (3,), where)
        return [_sensor("accelerometer", matrix, np.asarray(np.linalg.solve(matrix, bias)))]
    own = content.get("imu0", content)
    if not isinstance(own, dict):
        return []
    found = []
    for key, kind in (("accelerometers", "accelerometer"), ("gyroscopes", "gyroscope")):
        part = own.get(key)
        if not isinstance(part, dict) or "M" not in part:
            continue
        M = _numbers(part, "M", (3, 3), where)
        if "C_gyro_i" in part:
            M = M @ _numbers(part, "C_gyro_i", (3, 3), where)
        if "A" in part and np.any(_numbers(part, "A", (3, 3), where)):
            raise UsageError(
                f"{where}: the gyroscope answers to acceleration (A is not zero), which needs both "
                "sensors' readings at once: no correction of the gyroscope alone"
            )
        bias = _numbers(part, "bias", (3,), where) if "bias" in part else np.zeros(3)
        found.append(_sensor(kind, np.asarray(np.linalg.inv(M)), bias))  # type: ignore[arg-type]
    return found


def _numbers(content: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> Array:
    try:
        found = np.array(content[key], dtype=float).reshape(shape)
    except (KeyError, TypeError, ValueError):
        size = "x".join(map(str, shape))
        raise DataError(f"{where}: {key} is not {size} numbers") from None
    singular = key != "A" and len(shape) == 2 and not np.linalg.det(found)
    if singular or not np.isfinite(found).all():
        raise DataError(f"{where}: {key}: {np.ravel(found).tolist()} is no correction")
    return found
