"""Measured rotations, body to reference frame, as nine numbers row by row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.errors import DataError

Array = NDArray[np.float64]

_NORM_TOLERANCE = 0.01  # rounding to three decimals moves a quaternion's norm by at most 0.001


def from_angles(angles: Array) -> Array:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll) from (N, 3) roll, pitch, yaw in rad, as (N, 9)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([entry for row in rows for entry in row], axis=1)


def from_quaternions(q: Array, file: str, columns: tuple[str, ...]) -> Array:
    """Return R from (N, 4) qw, qx, qy, qz, as (N, 9).

    Raises DataError naming the first row whose norm is far from 1.
    """
    norm = np.linalg.norm(q, axis=1)
    _refuse_far(np.abs(norm - 1.0), norm, file, columns, "a norm of")
    w, x, y, z = (q / norm[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([entry for row in rows for entry in row], axis=1)


def from_matrices(r: Array, file: str, columns: tuple[str, ...]) -> Array:
    """Return (N, 9) unchanged once every row is seen to be a rotation."""
    m = r.reshape(-1, 3, 3)
    off = np.abs(np.einsum("nij,nkj->nik", m, m) - np.eye(3)).max(axis=(1, 2))
    det = np.linalg.det(m)
    _refuse_far(np.maximum(off, np.abs(det - 1.0)), det, file, columns, "a determinant of")
    return r


def _refuse_far(
    distance: Array, shown: Array, file: str, columns: tuple[str, ...], what: str
) -> None:
    far = np.flatnonzero(distance > _NORM_TOLERANCE)
    if far.size:
        row = int(far[0])
        raise DataError(
            f"{file}: columns {' '.join(columns)} row {row}: {what} {shown[row]:.4g} is no "
            f"rotation ({far.size} such rows); check which columns these are and their order"
        )
