"""An accelerometer and a magnetometer of one body, calibrated together from common poses.

Ren & Liu, "Calibration of MEMS Accelerometers and Magnetometers for Rotor UAV Attitude
Estimation", eqs. (4)-(6), calibrate each sensor to its own norm. A norm sees no rotation: sensors
calibrated apart have two frames, and the heading computed from both is wrong by the angle between
them. What ties the frames together is the dip: in one place, gravity and field enclose the same
angle in every pose.

Each pose gives three equations in its six readings: two lengths and that angle. A residual is how
far the readings are from satisfying its equation, to first order and in standard deviations of the
readings: a length over what the noise of its sensor does to it, as in `norm`; the angle taken where
the readings satisfy the lengths, over what is left of both noises there. So the three depend
neither on each other nor on the size of the scales. They are multiplied by the accelerometer's
noise, which gives them its unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import (
    DataError,
    Model,
    NotTrusted,
    Residual,
    Run,
    UsageError,
    constant,
    dot,
    lower,
    model,
    norm_2,
    param,
    pi,
    quantity,
    signal,
    sin,
    sqrt,
    vertcat,
)

from .norm import burkhard_bias, burkhard_full

Array = NDArray[np.float64]

#: Of each sensor: its signal and the constant that is its known length.
SENSORS = {"accelerometer": ("a", "gravity"), "magnetometer": ("m", "field")}
#: Poses from which the start is safe.
FEWEST = 10
#: Poses beyond its nine unknowns from which the misfit of one sensor shows its noise.
ENOUGH = 6
#: A ratio of the noises that is wrong by more than this factor is named.
UNEQUAL = 1.5
#: Noise of an angle (rad) below which there is none.
ROUNDING = 1e-9


# -- the model ------------------------------------------------------------------------------------


def _seen(corrected: Any, scale: Any, known: float) -> tuple[Any, Any, Any, Any]:
    """Direction and length of the corrected vector, and where the reading lies in its own space:
    distance from the ellipsoid (to first order, in the reading's unit) and normal of that."""
    length = norm_2(corrected)
    slope = scale.T @ (corrected / length)
    return corrected / length, length, (length - known) / norm_2(slope), slope / norm_2(slope)


def _on_the_ellipsoid(slope: Any, distance: Any, normal: Any) -> tuple[Any, Any]:
    """Change on the way to the ellipsoid of what has this slope, and its slope along it."""
    return -dot(slope, normal) * distance, slope - dot(slope, normal) * normal


@model
def norm_pair(
    a=signal(3, "m/s^2"),
    m=signal(3, "uT"),
    *,
    accelerometer_scale=param(lower(3)),
    accelerometer_offset=param(3, "m/s^2"),
    magnetometer_scale=param((3, 3)),
    magnetometer_offset=param(3, "uT"),
    dip=param("rad", bounds=(-pi / 2, pi / 2)),
    gravity=constant(9.80665, "m/s^2"),
    field=constant(50.0, "uT"),
    accelerometer_noise=constant(0.02, "m/s^2"),
    magnetometer_noise=constant(0.3, "uT"),
):
    """Accelerometer and magnetometer together, at rest in common poses: 22 unknowns.

    force = accelerometer_scale·(a − accelerometer_offset) has the length `gravity`, flux =
    magnetometer_scale·(m − magnetometer_offset) the length `field`, both in the accelerometer's
    frame, and flux points `dip` below the horizontal everywhere (force points up). corrected is
    force, then flux. The noises are those of one component of a reading; their ratio matters.
    """
    force = quantity("force", accelerometer_scale @ (a - accelerometer_offset), "m/s^2")
    flux = quantity("flux", magnetometer_scale @ (m - magnetometer_offset), "uT")
    up, g, a_distance, a_normal = _seen(force, accelerometer_scale, gravity)
    north, b, m_distance, m_normal = _seen(flux, magnetometer_scale, field)
    cosine = dot(up, north)
    a_slope = accelerometer_scale.T @ (north - cosine * up) / g
    m_slope = magnetometer_scale.T @ (up - cosine * north) / b
    a_change, a_slope = _on_the_ellipsoid(a_slope, a_distance, a_normal)
    m_change, m_slope = _on_the_ellipsoid(m_slope, m_distance, m_normal)
    noise = sqrt(
        accelerometer_noise**2 * dot(a_slope, a_slope)
        + magnetometer_noise**2 * dot(m_slope, m_slope)
    )
    angle = cosine + a_change + m_change + sin(dip)
    return Residual(
        implicit=vertcat(
            a_distance,
            m_distance * accelerometer_noise / magnetometer_noise,
            angle * accelerometer_noise / noise,
        ),
        unit="m/s^2",
        corrected=quantity("corrected", vertcat(force, flux)),
        axes=("gravity", "field", "dip"),
    )


# -- start values ---------------------------------------------------------------------------------


def ellipsoid(v: Array, length: float) -> tuple[Array, Array]:
    """(scale, offset) of one sensor: Burkhard's closed form, else a sphere through the readings."""
    try:
        return burkhard_full(v, length)
    except NotTrusted:
        b, radius = burkhard_bias(v)
        return np.eye(3) * length / radius, b


def alignment(up: Array, north: Array) -> tuple[Array, float]:
    """(Q, c): the rotation with up·(Q north) = c in every pose. Unit vectors (N, 3), N ≥ 9.

    Linear least squares for a matrix and c together (homogeneous: c may be zero), then the nearest
    rotation. (−Q, −c) fits as well; it is no rotation.
    """
    products = np.einsum("ni,nj->nij", up, north).reshape(-1, 9)
    system = np.column_stack([products, -np.ones(len(up))])
    matrix = np.linalg.svd(system, full_matrices=len(up) < 10)[2][-1][:9].reshape(3, 3)
    u, _, vt = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    Q = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return Q, float(np.mean(np.sum(up * (north @ Q.T), axis=1)))


def _readings(runs: Sequence[Run], sensor: str) -> Array:
    """All readings of one sensor, (N, 3)."""
    return np.vstack([run.signals[SENSORS[sensor][0]] for run in runs])


def _number(declared: Model, name: str) -> float:
    """A constant, or where the search for it starts."""
    symbol = declared[name]
    value = float(symbol.start_value()[0] if hasattr(symbol, "start_value") else symbol.array)
    if not value > 0:
        raise UsageError(f"{name} = {value:g}: it must be positive; --set {name}=…")
    return value


def held_values(declared: Model) -> dict[str, Array]:
    """Values of what is held: constants, and parameters that were fixed."""
    return {c.name: c.array for c in declared.constants}


def alone(declared: Model, runs: Sequence[Run], sensor: str) -> tuple[Array, Array]:
    """(scale, offset) of one sensor by itself, with what is held as it is."""
    v, length = _readings(runs, sensor), _number(declared, SENSORS[sensor][1])
    scale, offset = (held_values(declared).get(f"{sensor}_{part}") for part in ("scale", "offset"))
    if scale is None:
        own_scale, own_offset = ellipsoid(v, length)
        return own_scale, own_offset if offset is None else offset
    if offset is None:  # in the corrected frame the ellipsoid is a sphere
        return scale, np.asarray(np.linalg.solve(scale, burkhard_bias(v @ scale.T)[0]))
    return scale, offset


def _gain(scale: Array) -> float:
    """The one number that stands for a scale."""
    return float(abs(np.linalg.det(scale)) ** (1 / 3))


def _directions(v: Array, scale: Array, offset: Array) -> Array:
    """Corrected readings, made unit vectors, (N, 3)."""
    corrected = (v - offset) @ scale.T
    return np.asarray(corrected / np.linalg.norm(corrected, axis=1, keepdims=True))


def closed_form(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Each sensor by itself in closed form, then the rotation between them and the dip."""
    held = held_values(declared)
    found: dict[str, Array] = {}
    directions = []
    for sensor in SENSORS:
        scale, offset = alone(declared, runs, sensor)
        directions.append(_directions(_readings(runs, sensor), scale, offset))
        found |= {f"{sensor}_scale": scale, f"{sensor}_offset": offset}
    if "magnetometer_scale" in held:
        cosine = float(np.mean(np.sum(directions[0] * directions[1], axis=1)))
        return {**found, "dip": np.array(-np.arcsin(cosine))}
    _enough_poses(declared, runs)
    Q, cosine = alignment(*directions)
    # A dip that is held with the other sign asks for a mirrored magnetometer; remarks say so.
    sign = -1.0 if held.get("dip", 0.0) * cosine > 0 else 1.0
    found["magnetometer_scale"] = sign * Q @ found["magnetometer_scale"]
    return {**found, "dip": np.array(-sign * np.arcsin(cosine))}


def _enough_poses(declared: Model, runs: Sequence[Run]) -> None:
    """Eight poses determine all unknowns, but from fewer than ten the start may be a wrong one."""
    poses = sum(map(len, runs))
    if poses < FEWEST:
        raise DataError(
            f"{runs[0].file or runs[0].name}: {poses} poses are too few for {declared.name}, which "
            f"starts from {FEWEST} or more: record more, or hold both scales (--fix)"
        )


def limits(declared: Model, runs: Sequence[Run]) -> dict[str, tuple[Any, Any]]:
    """Each offset lies inside the ball that its readings span: the collapsed solution does not.

    The dip stays five standard deviations of one pose away from the vertical, where the field has
    no direction to speak of and the cosine no slope.
    """
    found: dict[str, tuple[Any, Any]] = {}
    variance = 0.0
    for sensor, (_, length) in SENSORS.items():
        v = _readings(runs, sensor)
        radius = float(np.max(np.linalg.norm(v, axis=1)))
        found[f"{sensor}_offset"] = (-radius, radius)
        scale = alone(declared, runs, sensor)[0]
        noise = _gain(scale) * _number(declared, f"{sensor}_noise")
        variance += (noise / _number(declared, length)) ** 2
    steepest = np.pi / 2 - min(5 * np.sqrt(variance), 1.0)
    return {**found, "dip": (-steepest, steepest)}


def right_handed(declared: Model, values: Mapping[str, Any]) -> dict[str, Any]:
    """Of (scale, dip) and (−scale, −dip), which fit alike, the one that mirrors nothing."""
    if "dip" not in values or "magnetometer_scale" not in values:
        return {}
    scale = np.asarray(values["magnetometer_scale"])
    sign = np.where(np.linalg.det(scale) < 0, -1.0, 1.0)
    return {"magnetometer_scale": scale * sign[..., None, None], "dip": values["dip"] * sign}


# -- noise ----------------------------------------------------------------------------------------


def _misfit(v: Array, scale: Array, offset: Array, length: float) -> float:
    """Root of the mean square distance of readings from their ellipsoid, in their unit."""
    corrected = (v - offset) @ scale.T
    size = np.linalg.norm(corrected, axis=1)
    slope = np.linalg.norm((corrected / size[:, None]) @ scale, axis=1)
    return float(np.sqrt(np.mean(((size - length) / slope) ** 2)))


def noise_levels(declared: Model, runs: Sequence[Run]) -> tuple[float, float]:
    """(accelerometer_noise, magnetometer_noise), m/s² and µT, that each sensor shows by itself.

    That is what its own closed form leaves over, from 15 poses on, else the scatter within rest
    intervals. Raises NotTrusted where neither says anything.
    """
    accelerometer, magnetometer = (_noise_alone(declared, runs, sensor) for sensor in SENSORS)
    return accelerometer, magnetometer


def _noise_alone(declared: Model, runs: Sequence[Run], sensor: str) -> float:
    name, length = SENSORS[sensor]
    v, spread = _readings(runs, sensor), [r.spread[name] for r in runs if name in r.spread]
    if len(v) >= 9 + ENOUGH:
        misfit = _misfit(v, *alone(declared, runs, sensor), _number(declared, length))
        return misfit * float(np.sqrt(len(v) / (len(v) - 9)))
    if spread:
        return float(np.sqrt(np.mean(np.vstack(spread) ** 2)))
    raise NotTrusted(f"{len(v)} poses do not show the noise of the {sensor}: set {sensor}_noise")


def weighed(declared: Model, runs: Sequence[Run]) -> Model:
    """The model with the noise of each sensor as these data show it."""
    accelerometer, magnetometer = noise_levels(declared, runs)
    return declared.having(accelerometer_noise=accelerometer, magnetometer_noise=magnetometer)


# -- remarks --------------------------------------------------------------------------------------


def remarks(declared: Model, runs: Sequence[Run], values: Mapping[str, Any]) -> Iterator[str]:
    """What an engineer would notice: wrong units, wrong noises, poses in a plane, a mirror."""
    yield from _coverage(declared, runs)
    known = {**held_values(declared), **{name: np.asarray(value) for name, value in values.items()}}
    if any(known[f"{s}_{p}"].ndim != n for s in SENSORS for p, n in (("scale", 2), ("offset", 1))):
        return  # values differ from run to run: what follows is about one sensor
    if np.linalg.det(known["magnetometer_scale"]) < 0:
        yield (
            f"with a dip of {float(known['dip']):.3g} rad the magnetometer is mirrored against the "
            "accelerometer: check the sign of every axis, and that a reads +g on an axis that "
            "points up"
        )
    yield from _noise(declared, runs, known)


def _coverage(declared: Model, runs: Sequence[Run]) -> Iterator[str]:
    for sensor, (name, length) in SENSORS.items():
        v, known = _readings(runs, sensor), _number(declared, length)
        away = v - v.mean(axis=0)
        sizes = [float(np.median(np.linalg.norm(x, axis=1))) / known for x in (v, away)]
        if not any(1 / 3 < size < 3 for size in sizes):
            yield (
                f"the readings {name} are {sizes[1]:.3g} times the {length} ({known:g}): is one of "
                f"the two in another unit? (--unit {name}=…, --set '{length}=…')"
            )
        yield from flat(away, known, sensor)


def flat(away: Array, known: float, sensor: str) -> Iterator[str]:
    """That readings (N, 3), from which their mean is taken, lie close to a plane or a line.

    `known` is the length of what they measure in their own unit.
    """
    spread = np.linalg.svd(away, compute_uv=False) / np.sqrt(len(away))
    # Noise alone is as thick as it is wide: the extent is at least that of a whole sphere.
    thickness = spread[2] / max(spread[0], known / np.sqrt(3))
    if thickness < 0.15:
        yield (
            f"the readings of the {sensor} lie close to a plane, a line or a point (thickness "
            f"{thickness:.1%} of their extent): turning about one axis, such as the vertical, "
            "is not enough; tilt the sensors about others too"
        )


def _noise(declared: Model, runs: Sequence[Run], known: Mapping[str, Array]) -> Iterator[str]:
    """The ratio of the two noises decides what counts: compare it with what is left over."""
    poses = sum(map(len, runs))
    if poses < 9 + ENOUGH:
        return
    freedom = poses / (poses - 22 / 3)
    left, change, angle, directions = [], [], 0.0, []
    for sensor, (_, length) in SENSORS.items():
        v, scale, offset = _of(sensor, runs, known)
        misfit = _misfit(v, scale, offset, float(known[length])) * np.sqrt(freedom)
        left.append(f"--set {sensor}_noise={misfit:.2g}")
        change.append(misfit / float(known[f"{sensor}_noise"]))
        angle += (misfit * _gain(scale) / float(known[length])) ** 2
        directions.append(_directions(v, scale, offset))
    if angle < ROUNDING**2:
        return
    if not 1 / UNEQUAL < change[0] / change[1] < UNEQUAL:
        yield (
            "the two noises do not have the ratio of what is left over, so one sensor counts too "
            f"much and standard deviations are off: {' '.join(left)}"
        )
    scatter = float(np.std(np.arcsin(np.sum(directions[0] * directions[1], axis=1))))
    if scatter > 2 * np.sqrt(angle):
        yield (
            f"the angle between gravity and field scatters by {np.degrees(scatter):.2g}°, of which "
            f"the noise in the lengths explains {np.degrees(np.sqrt(angle)):.2g}°: the field "
            "differs from place to place (iron nearby), or the sensors were turning while read"
        )


def _of(sensor: str, runs: Sequence[Run], known: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    return _readings(runs, sensor), known[f"{sensor}_scale"], known[f"{sensor}_offset"]


norm_pair = (
    norm_pair.starting(closed_form)
    .bounded(limits)
    .canonical(right_handed)
    .remarking(remarks)
    .with_estimator("closed-form", closed_form)
)
