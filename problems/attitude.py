"""Attitude from a calibrated accelerometer and magnetometer, and the scalar pre-filter.

Ren & Liu, eqs. (1)-(3) and (7)-(8), with the signs that their frames need: x forward, y right, z
down, gravity (not specific force) as A. With those the yaw of (8) must be atan2(−h_y, h_x): as
printed, a true +30° comes out as −30°.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Attitude:
    """Roll φ, pitch θ, yaw ψ (N,), rad, of a body (x forward, y right, z down) to north-east-down,
    with standard deviations; yaw from true north where a declination was given."""

    roll: Array
    pitch: Array
    yaw: Array
    roll_std: Array
    pitch_std: Array
    yaw_std: Array


def tilt_compensated(
    gravity: Array,
    field: Array,
    *,
    declination: float = 0.0,
    gravity_std: float = 0.0,
    field_std: float = 0.0,
) -> Attitude:
    """Eqs. (7)-(8). `gravity` and `field` are calibrated, (N, 3), in any unit.

    `declination` β_m (rad, east positive) is added to the yaw. The standard deviations of one
    component of each, in its own unit, are carried through to the angles to first order.
    """
    angles = _angles(gravity, field)
    variance = np.zeros_like(angles)
    for which, (values, std) in enumerate(((gravity, gravity_std), (field, field_std))):
        step = 1e-6 * float(np.median(np.linalg.norm(values, axis=1)))
        for k in range(3):
            moved = [gravity.copy(), field.copy()]
            moved[which][:, k] += step
            slope = (_angles(*moved) - angles + np.pi) % (2 * np.pi) - np.pi
            variance += (slope / step * std) ** 2
    roll, pitch, yaw = angles.T
    yaw = (yaw + declination + np.pi) % (2 * np.pi) - np.pi
    roll_std, pitch_std, yaw_std = np.sqrt(variance).T
    return Attitude(roll, pitch, yaw, roll_std, pitch_std, yaw_std)


def _angles(gravity: Array, field: Array) -> Array:
    ax, ay, az = gravity.T
    pitch = -np.arctan2(ax, np.hypot(ay, az))
    roll = np.arctan2(ay, az)
    hx, hy, hz = field.T
    level_x = (
        hx * np.cos(pitch) + hy * np.sin(roll) * np.sin(pitch) + hz * np.cos(roll) * np.sin(pitch)
    )
    level_y = hy * np.cos(roll) - hz * np.sin(roll)
    return np.column_stack([roll, pitch, np.arctan2(-level_y, level_x)])


def scalar_kalman(
    z: Array, *, Q: float = 1e-4, R: float = 1.0, start: float = 9.8, P: float = 1.0
) -> tuple[Array, Array]:
    """(filtered signal, gain) of eq. (3): a random walk of variance Q per sample seen in noise R.

    Defaults are the paper's. The gain tends to `steady_gain(Q, R)`.
    """
    filtered, gains = np.empty(len(z)), np.empty(len(z))
    x = start
    for k, reading in enumerate(z):
        P = P + Q
        gain = P / (P + R)
        x = x + gain * (reading - x)
        P = gain * R  # = (1 − K)P, without the cancellation
        filtered[k], gains[k] = x, gain
    return filtered, gains


def steady_gain(Q: float, R: float) -> float:
    """Gain of (3) after many samples: the positive root of the scalar Riccati equation."""
    predicted = 0.5 * (Q + np.sqrt(Q * Q + 4 * Q * R))
    return float(predicted / (predicted + R))
