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
    Residual,
    Run,
    atan2,
    before,
    carried,
    constant,
    cos,
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
    sin,
    turned,
    vertcat,
)

from .imu_remarks import refusals, refuse_few_axes, remarks
from .pair import alone, closed_form, held_values, right_handed

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


def _heading(up: Any, north: Any, foretold_up: Any, foretold_north: Any) -> Any:
    """The angle about the vertical from where the field was foretold to where it is seen, degrees.

    What is foretold is first turned the shortest way into the vertical that is seen: how far that
    was off is said by `_apart`, and a steep field would make much of it.
    """
    seen = north - dot(north, up) * up
    level = foretold_north - dot(foretold_north, foretold_up) * foretold_up
    level = level - dot(up, level) / (1 + dot(up, foretold_up)) * (up + foretold_up)
    return DEGREE * atan2(dot(up, cross(level, seen)), dot(level, seen))


def _late(delay: Any, rate: Any, force: Any, at_rest: Any) -> tuple[tuple[Any, ...], Any, Any]:
    """Rows, axes and noises that tell how late the rate is read, where that is unknown.

    The body has no velocity at either rest, so that the mean force on the way, in the frame of the
    rest before, is that at rest. What turns by R until now is turned by R·exp([δ·rate]×) where the
    rate is read δ late: to second order in that angle.
    """
    if isinstance(delay, float):
        return (), (), ()
    angle = delay * rate
    met = force + cross(angle, force) + 0.5 * cross(angle, cross(angle, force))
    axes = ("motion_x", "motion_y", "motion_z")
    return (carried(rate, met) - at_rest,), axes, 3 * ("motion_noise",)


@model
def gyro_rests(
    a=signal(3),
    w=signal(3, wanders=True),
    *,
    accelerometer_scale=param(lower(3), "[gravity]/[a]"),
    accelerometer_offset=param(3, "[a]"),
    gyroscope_scale=param((3, 3), "(rad/s)/[w]"),
    gyroscope_offset=param(3, "[w]"),
    g_sensitivity=constant(np.zeros((3, 3)), "[w]/[gravity]"),
    gravity=constant(9.80665, "m/s^2"),
    accelerometer_noise=constant(0.0, "[a]"),
    gyroscope_noise=constant(0.0, "[w]"),
    gyroscope_wander=constant(0.0, "[w]/s^0.5"),
    turn_noise=constant(0.0, "deg"),
    gyroscope_delay=constant(0.0, "s"),
    motion_noise=constant(0.0, "[gravity]"),
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
    late, late_axes, late_noise = _late(gyroscope_delay, rate, force, gravity * before(up))
    return Residual(
        implicit=vertcat(
            _length(force, accelerometer_scale, gravity),
            w - bias,
            _apart(up, turned(rate).T @ before(up)),
            *late,
        ),
        axes=("gravity", "rest_x", "rest_y", "rest_z", "turn_x", "turn_y", *late_axes),
        noise=(
            "accelerometer_noise",
            *3 * ("gyroscope_noise",),
            *2 * ("turn_noise",),
            *late_noise,
        ),
        wander=("gyroscope_wander",),
        corrected=quantity("corrected", vertcat(force, rate)),
    )


@model
def imu(
    a=signal(3),
    w=signal(3, wanders=True),
    m=signal(3),
    *,
    accelerometer_scale=param(lower(3), "[gravity]/[a]"),
    accelerometer_offset=param(3, "[a]"),
    gyroscope_scale=param((3, 3), "(rad/s)/[w]"),
    gyroscope_offset=param(3, "[w]"),
    magnetometer_scale=param((3, 3), "[field]/[m]"),
    magnetometer_offset=param(3, "[m]"),
    dip=param("rad", bounds=(-pi / 2, pi / 2)),
    g_sensitivity=constant(np.zeros((3, 3)), "[w]/[gravity]"),
    gravity=constant(9.80665, "m/s^2"),
    field=constant(1.0, "[m]"),
    accelerometer_noise=constant(0.0, "[a]"),
    magnetometer_noise=constant(0.0, "[m]"),
    dip_noise=constant(0.0, "deg"),
    gyroscope_noise=constant(0.0, "[w]"),
    gyroscope_wander=constant(0.0, "[w]/s^0.5"),
    turn_noise=constant(0.0, "deg"),
    gyroscope_delay=constant(0.0, "s"),
    motion_noise=constant(0.0, "[gravity]"),
):
    """Accelerometer, gyroscope and magnetometer of one body together: 34 unknowns.

    force = accelerometer_scale·(a − accelerometer_offset) has the length `gravity` at rest, flux =
    magnetometer_scale·(m − magnetometer_offset) the length `field`, `dip` below the horizontal;
    rate = gyroscope_scale·(w − gyroscope_offset − g_sensitivity·force) in rad/s is zero at rest,
    and turns both from one rest to the next. All are in the accelerometer's frame; corrected is
    force, rate, flux. A noise of 0 is found from the data.
    """
    force = quantity("force", accelerometer_scale @ (a - accelerometer_offset), "[gravity]")
    bias = gyroscope_offset + g_sensitivity @ force
    rate = quantity("rate", gyroscope_scale @ (w - bias), "rad/s")
    flux = quantity("flux", magnetometer_scale @ (m - magnetometer_offset), "[field]")
    up, north = force / norm_2(force), flux / norm_2(flux)
    back = turned(rate).T
    foretold = back @ before(up)
    late, late_axes, late_noise = _late(gyroscope_delay, rate, force, gravity * before(up))
    return Residual(
        implicit=vertcat(
            _length(force, accelerometer_scale, gravity),
            _length(flux, magnetometer_scale, field),
            DEGREE * (dot(up, north) + sin(dip)) / cos(dip),
            w - bias,
            _apart(up, foretold),
            _heading(up, north, foretold, back @ before(north)),
            *late,
        ),
        axes=(
            "gravity",
            "field",
            "dip",
            "rest_x",
            "rest_y",
            "rest_z",
            "turn_x",
            "turn_y",
            "heading",
            *late_axes,
        ),
        noise=(
            "accelerometer_noise",
            "magnetometer_noise",
            "dip_noise",
            *3 * ("gyroscope_noise",),
            *3 * ("turn_noise",),
            *late_noise,
        ),
        wander=("gyroscope_wander",),
        corrected=quantity("corrected", vertcat(force, rate, flux)),
    )


# -- start values ---------------------------------------------------------------------------------


def turning_scale(runs: Sequence[Run], up: Sequence[Array], bias: Array) -> Array:
    """The gyroscope's scale (3, 3) by linear least squares, from directions on the way.

    u′ = u × S(w - b) of the direction u that the accelerometer shows while it is turned: summed
    from rest to rest that is linear in S. Hands shake, so it is a start, and no more: right to some
    percent, whatever the unit and the mounting.
    """
    rows, right = [np.zeros((0, 9))], [np.zeros(0)]
    for run, u in zip(runs, up, strict=True):
        assert run.averaged is not None
        raw = run.averaged.run
        time, w = np.asarray(raw.time), raw.signals["w"] - bias
        for i, j in zip(run.averaged.last[:-1], run.averaged.first[1:], strict=True):
            angle = 0.5 * (w[i:j] + w[i + 1 : j + 1]) * np.diff(time[i : j + 1])[:, None]
            sums = (0.5 * (u[i:j] + u[i + 1 : j + 1])).T @ angle
            # u × e_r has the components ε_spr u_p.
            rows.append(np.einsum("spr,pq->srq", _CROSS, sums).reshape(3, 9))
            right.append(u[j] - u[i])
    found = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    return np.asarray(found.reshape(3, 3))


#: ε: +1 for (0, 1, 2) and what follows by turning it round, −1 for the others.
_CROSS = np.array([np.cross(np.eye(3), axis) for axis in np.eye(3)]).T


def start(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Closed forms of the accelerometer (and magnetometer) at rest, then the gyroscope's: its
    offset at rest, its scale by `turning_scale`."""
    _refuse_no_record(declared, runs)
    held = held_values(declared)
    if "m" in {s.name for s in declared.signals}:
        found = dict(closed_form(declared, runs))
    else:
        scale, offset = alone(declared, runs, "accelerometer")
        found = {"accelerometer_scale": scale, "accelerometer_offset": offset}
    counts = np.concatenate([run.count for run in runs]).astype(float)
    at_rest = np.vstack([run.signals["w"] for run in runs])
    bias = held.get("gyroscope_offset", np.average(at_rest, axis=0, weights=counts))
    found["gyroscope_offset"] = bias
    if "gyroscope_scale" not in held:
        refuse_few_axes(runs, bias)
        scale, offset = found["accelerometer_scale"], found["accelerometer_offset"]
        up = [_directions(run, scale, offset) for run in runs]
        found["gyroscope_scale"] = turning_scale(runs, up, bias)
    return found


def _refuse_no_record(declared: Model, runs: Sequence[Run]) -> None:
    for run in runs:
        if run.averaged is None:
            raise DataError(
                f"{run.file or run.name}: {declared.name} looks at what lies between rests: give "
                "the raw record with --at-rest (load_runs(…, at_rest=True))"
            )
        if run.averaged.run.time is None:
            raise DataError(
                f"{run.file or run.name}: {declared.name} needs time: give a time column or --rate "
                "(--columns t=NAME, --rate HZ)"
            )


def _directions(run: Run, scale: Array, offset: Array) -> Array:
    """Directions (N, 3) of the force in every sample of the raw record."""
    assert run.averaged is not None
    force = (run.averaged.run.signals["a"] - offset) @ scale.T
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


def limits(declared: Model, runs: Sequence[Run]) -> dict[str, tuple[Any, Any]]:
    """Offsets lie inside the balls that the readings span; the dip is a degree off the vertical."""
    found: dict[str, tuple[Any, Any]] = {}
    for name, sensor in (("a", "accelerometer"), ("m", "magnetometer")):
        if name in {s.name for s in declared.signals}:
            v = np.vstack([run.signals[name] for run in runs])
            radius = float(np.max(np.linalg.norm(v, axis=1)))
            found[f"{sensor}_offset"] = (-radius, radius)
    steepest = np.radians(89.0)
    return (
        {**found, "dip": (-steepest, steepest)}
        if "m" in {s.name for s in declared.signals}
        else found
    )


gyro_rests = gyro_rests.starting(start).bounded(limits).remarking(remarks).refusing(refusals)
imu = (
    imu.starting(start)
    .bounded(limits)
    .canonical(right_handed)
    .remarking(remarks)
    .refusing(refusals)
)
