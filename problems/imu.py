"""An IMU from one record taken by hand: rests, and turns in between.

Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for IMU calibration without
external equipments", ICRA 2014: the accelerometer is calibrated at rest (eqs. 9-10), and what the
gyroscope integrates from one rest to the next must turn the direction of gravity before into that
after (eqs. 13-14). There in two steps with Runge-Kutta's; here at once, so that the directions' own
uncertainty is in that of the gyroscope, and with products of exact rotations.

corrected = scale·(reading − offset) for every sensor. The frame is the accelerometer's: its scale
is lower triangular, that of the others full, for the turns show how they are mounted against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import (
    DataError,
    Model,
    NotTrusted,
    Residual,
    Run,
    before,
    constant,
    cross,
    dot,
    if_else,
    lower,
    model,
    norm_2,
    param,
    pi,
    quantity,
    signal,
    turned,
    vertcat,
)

from .norm import burkhard_bias, burkhard_full

Array = NDArray[np.float64]

DEGREE = 180 / pi


def _length(corrected: Any, scale: Any, known: Any) -> Any:
    """How far a reading is from the ellipsoid of those with the known length, in its own unit."""
    length = norm_2(corrected)
    return (length - known) * (length / norm_2(scale.T @ corrected))


def _apart(seen: Any, foretold: Any) -> Any:
    """The angle between two unit vectors as two components across the first, in degrees.

    Twice the tangent of half the angle: vectors that are opposite are as far apart as can be. The
    axes across are Duff's (J. Computer Graphics Techniques 6(1), 2017).
    """
    x, y, z = seen[0], seen[1], seen[2]
    side = if_else(z >= 0, 1, -1)
    a = -1 / (side + z)
    first = vertcat(1 + side * x * x * a, side * x * y * a, -side * x)
    second = vertcat(x * y * a, side + y * y * a, -y)
    away = cross(foretold, seen) * (2 / (1 + dot(seen, foretold)))
    return DEGREE * vertcat(dot(first, away), dot(second, away))


@model
def gyro_rests(
    a=signal(3),
    w=signal(3),
    *,
    accelerometer_scale=param(lower(3), "[gravity]/[a]"),
    accelerometer_offset=param(3, "[a]"),
    gyroscope_scale=param((3, 3), "rad/s/[w]"),
    gyroscope_offset=param(3, "[w]"),
    g_sensitivity=constant(np.zeros((3, 3)), "[w]/[gravity]"),
    gravity=constant(9.80665, "m/s^2"),
    accelerometer_noise=constant(0.0, "[a]"),
    gyroscope_noise=constant(0.0, "[w]"),
    turn_noise=constant(0.0, "deg"),
):
    """A gyroscope by the accelerometer beside it, from rest to rest: 21 unknowns.

    force = accelerometer_scale·(a − accelerometer_offset) has the length `gravity` at rest; rate =
    gyroscope_scale·(w − gyroscope_offset − g_sensitivity·force) in rad/s is zero there, and turns
    the direction of force at one rest into that at the next. Both are in the accelerometer's frame.
    corrected is force, then rate. A noise of 0 is found from the data.
    """
    force = quantity("force", accelerometer_scale @ (a - accelerometer_offset), "[gravity]")
    bias = gyroscope_offset + g_sensitivity @ force
    rate = quantity("rate", gyroscope_scale @ (w - bias), "rad/s")
    up = force / norm_2(force)
    return Residual(
        implicit=vertcat(
            _length(force, accelerometer_scale, gravity),
            w - bias,
            _apart(up, turned(rate).T @ before(up)),
        ),
        axes=("gravity", "rest_x", "rest_y", "rest_z", "turn_x", "turn_y"),
        noise=("accelerometer_noise", *3 * ("gyroscope_noise",), *2 * ("turn_noise",)),
        corrected=quantity("corrected", vertcat(force, rate)),
    )


# -- start values ---------------------------------------------------------------------------------


def _held(declared: Model) -> dict[str, Array]:
    """Values of what is held: constants, and parameters that were fixed."""
    return {c.name: c.array for c in declared.constants}


def _means(runs: Sequence[Run], name: str) -> Array:
    """Mean readings at rest of all runs, (N, 3)."""
    return np.vstack([run.signals[name] for run in runs])


def ellipsoid(v: Array, length: float) -> tuple[Array, Array]:
    """(scale, offset) of one sensor: Burkhard's closed form, else a sphere through the readings."""
    try:
        return burkhard_full(v, length)
    except NotTrusted:
        b, radius = burkhard_bias(v)
        return np.eye(3) * length / radius, b


def _sensor(declared: Model, runs: Sequence[Run], name: str, sensor: str, length: str) -> Any:
    """(scale, offset) of a sensor by its lengths at rest, with what is held as it is."""
    held = _held(declared)
    scale, offset = ellipsoid(_means(runs, name), float(held[length]))
    return held.get(f"{sensor}_scale", scale), held.get(f"{sensor}_offset", offset)


def turning_scale(runs: Sequence[Run], up: Sequence[Array], bias: Sequence[Array]) -> Array:
    """The gyroscope's scale (3, 3) by linear least squares, from directions on the way.

    u′ = u × S(w - b) of the direction u that the accelerometer shows while it is turned: summed
    from rest to rest that is linear in S. Hands shake, so it is a start, and no more: right to some
    percent, whatever the unit and the mounting.
    """
    rows, right = [], []
    for run, u, b in zip(runs, up, bias, strict=True):
        assert run.averaged is not None
        raw = run.averaged.run
        time, w = np.asarray(raw.time), raw.signals["w"] - b
        for i, j in zip(run.averaged.last[:-1], run.averaged.first[1:], strict=True):
            angle = 0.5 * (w[i:j] + w[i + 1 : j + 1]) * np.diff(time[i : j + 1])[:, None]
            middle = 0.5 * (u[i:j] + u[i + 1 : j + 1])
            sums = middle.T @ angle  # Σ u_p d_q; u × e_r has the components ε_spr u_p
            block = np.einsum("spr,pq->srq", _LEVI_CIVITA, sums)
            rows.append(block.reshape(3, 9))
            right.append(u[j] - u[i])
    found = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    return np.asarray(found.reshape(3, 3))


_LEVI_CIVITA = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, _j, _k], _LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0


def linear_start(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Accelerometer in closed form, gyroscope's offset at rest, its scale by `turning_scale`."""
    held = _held(declared)
    scale, offset = _sensor(declared, runs, "a", "accelerometer", "gravity")
    found = {"accelerometer_scale": scale, "accelerometer_offset": offset}
    counts = np.concatenate([run.count for run in runs]).astype(float)
    bias = held.get("gyroscope_offset", np.average(_means(runs, "w"), axis=0, weights=counts))
    found["gyroscope_offset"] = bias
    if "gyroscope_scale" not in held:
        up = [_directions(run, scale, offset) for run in runs]
        found["gyroscope_scale"] = turning_scale(runs, up, [bias] * len(runs))
    return found


def _directions(run: Run, scale: Array, offset: Array) -> Array:
    """Directions (N, 3) of the force in every sample of the raw record."""
    if run.averaged is None:
        raise DataError(f"{run.file or run.name}: give the raw record with --at-rest")
    force = (run.averaged.run.signals["a"] - offset) @ scale.T
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


gyro_rests = gyro_rests.starting(linear_start)
