"""The files of ROS, Kalibr, ArduPilot and PX4: how each corrects a reading, written and read.

Each has a correction of its own:

ROS (imu_calib): SM·reading − bias, an accelerometer in m/s².
Kalibr (scale-misalignment): reading = M·force + b, reading = M·C_gyro_i·rate + b. Its own file has
no b; here that is a key more, `bias`, which Kalibr does not read.
ArduPilot: accelerometer (reading − INS_ACCOFFS)·INS_ACCSCAL by axis; gyroscope reading −
INS_GYROFFS; compass D·(reading + COMPASS_OFS) + COMPASS_MOT·current, D symmetric of COMPASS_DIA and
COMPASS_ODI, in milligauss.
PX4: accelerometer (reading − CAL_ACC0_OFF)·CAL_ACC0_SCALE by axis; gyroscope reading −
CAL_GYRO0_OFF; magnetometer S·(reading + current·CAL_MAG0_COMP − CAL_MAG0_OFF), S symmetric, in
gauss and gauss per kiloampere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, get_args

import numpy as np

from casest import __version__
from casest.correction.affine import Affine
from casest.declaration.shapes import Array
from casest.errors import UsageError

Format = Literal["ros", "kalibr", "ardupilot", "px4"]
FORMATS: tuple[Format, ...] = get_args(Format)

#: Gauss and milligauss in a tesla.
GAUSS, MILLIGAUSS = 1e4, 1e7
#: Share of the diagonal below which what lies beside it is none.
NONE = 1e-9
AXES = "XYZ"
#: Entries of a symmetric matrix beside its diagonal, in the order of both autopilots' names.
BESIDE = ((0, 1), (0, 2), (1, 2))


def written(sensors: Sequence[Affine], to: Format, origin: str) -> tuple[str, list[str]]:
    """Text of the file, and what a reader should know; `origin` says where it comes from."""
    head = f"casest {__version__}: {origin}"
    if to == "ros":
        return _ros(sensors, head), []
    if to == "kalibr":
        return _kalibr(sensors, head), []
    rows, remarks = [], []
    for s in sensors:
        own, said = (_ardupilot if to == "ardupilot" else _px4)(s)
        rows += own
        remarks += said
    if to == "ardupilot":
        return "".join([f"# {head}\n", *(f"{n},{v:.9g}\n" for n, v in rows)]), remarks
    lines = [f"1\t1\t{n}\t{v:.9g}\t{_type(v)}\n" for n, v in rows]
    first = "# Onboard parameters for Vehicle 1\n#\n"
    title = "#\n# Vehicle-Id Component-Id Name Value Type\n"
    return "".join([first, f"# {head}\n", title, *lines]), remarks


def refuse_corrected(sensors: Sequence[Affine], columns: Mapping[str, Sequence[float]]) -> None:
    """UsageError where a magnetometer's readings had the autopilot's own offsets in them.

    `columns`: least and greatest of what was recorded beside the readings; a log of ArduPilot has
    the offsets that were added there. A file for the autopilot corrects what the sensor reads.
    """
    if all(s.kind != "magnetometer" for s in sensors):
        return
    for name, ends in columns.items():
        if re.fullmatch(r"(.*\.)?Ofs[XYZ]", name) and any(ends):
            raise UsageError(
                f"the readings are as the autopilot corrected them, with {name} {ends[0]:g}; its "
                "parameters are for what the sensor reads: take that, as in log.bin:MAG.raw"
            )


def _type(value: float | int) -> int:
    """MAVLink's type of a parameter: 6 a whole number, 9 a float."""
    return 6 if isinstance(value, int) else 9


# -- ROS and Kalibr --------------------------------------------------------------------------------


def _ros(sensors: Sequence[Affine], head: str) -> str:
    own = [s for s in sensors if s.kind == "accelerometer"]
    if len(own) != 1:
        raise UsageError(
            "--to ros: imu_calib corrects one accelerometer, and the result has "
            f"{len(own) or 'none'}; --sensor accelerometer chooses"
        )
    (s,) = own
    bias = _flat(s.matrix @ s.offset)
    said = "corrected = SM reading - bias, m/s^2"
    return f"# {head}\n# {said}\nSM: {_flat(s.matrix)}\nbias: {bias}\n"


def _flat(values: Array) -> str:
    return "[" + ", ".join(f"{v:.12g}" for v in np.ravel(values)) + "]"


def _kalibr(sensors: Sequence[Affine], head: str) -> str:
    lines = [f"# {head}\n", "# reading = M force + bias; reading = M C_gyro_i rate + bias\n"]
    lines += ["imu0:\n", "  model: scale-misalignment\n"]
    for s in sensors:
        inverse = np.asarray(np.linalg.inv(s.matrix))
        if s.kind == "accelerometer":
            lines += ["  accelerometers:\n", *_rows("M", inverse)]
        elif s.kind == "gyroscope":
            M, C = lower_times_rotation(inverse)
            lines += ["  gyroscopes:\n", *_rows("M", M), *_rows("C_gyro_i", C)]
            lines += _rows("A", np.zeros((3, 3)))
        else:
            raise UsageError(
                "--to kalibr: it has no magnetometer; --sensor accelerometer or gyroscope chooses"
            )
        lines.append(f"    bias: {_flat(s.offset)}\n")
    return "".join(lines)


def _rows(name: str, matrix: Array) -> Iterator[str]:
    yield f"    {name}:\n"
    for row in matrix:
        yield f"    - {_flat(row)}\n"


def lower_times_rotation(matrix: Array) -> tuple[Array, Array]:
    """L lower triangular with positive diagonal and C a rotation with L·C = matrix (det > 0)."""
    Q, R = np.linalg.qr(matrix.T)
    sign = np.where(np.diag(R) < 0, -1.0, 1.0)
    return (R.T * sign), (Q * sign).T


# -- the autopilots --------------------------------------------------------------------------------

Rows = tuple[list[tuple[str, float]], list[str]]


def _ardupilot(s: Affine) -> Rows:
    if s.kind == "accelerometer":
        scale = _by_axis(s, "ArduPilot")
        return _vector("INS_ACCOFFS_{}", s.offset) + _vector("INS_ACCSCAL_{}", scale), []
    if s.kind == "gyroscope":
        _refuse_scale(s, "ArduPilot")
        return _vector("INS_GYROFFS_{}", s.offset), []
    D, remarks = _symmetric(s, "ArduPilot")
    rows = _vector("COMPASS_OFS_{}", -MILLIGAUSS * s.offset)
    rows += _vector("COMPASS_DIA_{}", np.diag(D))
    rows += _vector("COMPASS_ODI_{}", np.array([D[k] for k in BESIDE]))
    if s.per_ampere is not None:
        rows += _vector("COMPASS_MOT_{}", -MILLIGAUSS * (D @ s.per_ampere))
        rows.append(("COMPASS_MOTCT", 2))
    return rows, remarks


def _px4(s: Affine) -> Rows:
    if s.kind == "accelerometer":
        scale = _by_axis(s, "PX4")
        return _vector("CAL_ACC0_{}OFF", s.offset) + _vector("CAL_ACC0_{}SCALE", scale), []
    if s.kind == "gyroscope":
        _refuse_scale(s, "PX4")
        return _vector("CAL_GYRO0_{}OFF", s.offset), []
    D, remarks = _symmetric(s, "PX4")
    rows = _vector("CAL_MAG0_{}OFF", GAUSS * s.offset)
    rows += _vector("CAL_MAG0_{}SCALE", np.diag(D))
    rows += _vector("CAL_MAG0_{}ODIAG", np.array([D[k] for k in BESIDE]))
    if s.per_ampere is not None:
        rows += _vector("CAL_MAG0_{}COMP", -1e3 * GAUSS * s.per_ampere)
        rows.append(("CAL_MAG_COMP_TYP", 2))
    return rows, remarks


def _vector(name: str, values: Array) -> list[tuple[str, float]]:
    return [(name.format(a), float(v)) for a, v in zip(AXES, values, strict=True)]


def _by_axis(s: Affine, who: str) -> Array:
    """The diagonal of a matrix that has nothing else."""
    diagonal = np.diag(s.matrix)
    beside = np.abs(s.matrix - np.diag(diagonal)).max()
    if beside > NONE * np.abs(diagonal).max():
        raise UsageError(
            f"{who} corrects the {s.kind} axis by axis, and {s.signal} has up to {beside:.2g} "
            "between its axes: calibrate with norm-diagonal, or leave it out with --sensor"
        )
    return np.asarray(diagonal)


def _refuse_scale(s: Affine, who: str) -> None:
    """A gyroscope of an autopilot has an offset and no more."""
    away = np.abs(s.matrix - np.eye(3)).max()
    if away > NONE:
        raise UsageError(
            f"{who} corrects the offset of a gyroscope alone, and {s.signal} has scales and axes "
            f"up to {away:.2g} away from 1: hold them with --fix, or leave it out with --sensor"
        )


def _symmetric(s: Affine, who: str) -> tuple[Array, list[str]]:
    """The symmetric matrix that corrects as well, and by how much that turns the axes.

    A lower triangular one is the convention of a fit that sees no rotation: its symmetric part by
    polar decomposition is as good. Another frame would be lost.
    """
    U, singular, Vt = np.linalg.svd(s.matrix)
    D = (Vt.T * singular) @ Vt
    turn = U @ Vt
    angle = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    size = np.abs(s.matrix).max()
    if np.abs(s.matrix - s.matrix.T).max() <= NONE * size:
        return s.matrix, []
    if np.abs(np.triu(s.matrix, 1)).max() > NONE * size:
        raise UsageError(
            f"{s.signal} has a frame of its own, turned by {angle:.2g} degrees, and the matrix of "
            f"{who}'s {s.kind} turns nothing: calibrate it alone (norm-triangular), or leave it "
            "out with --sensor"
        )
    return D, [
        f"{who}'s matrix is symmetric: its axes are turned by {angle:.2g} degrees against those of "
        "casest apply; the fit saw no rotation"
    ]
