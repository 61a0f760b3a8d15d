"""The hand-spun wheel by its equation of motion: what slows it down are constants.

The sensor is that of `wheel` (Pedersini, eqs. 1-7). In place of a cubic speed law, which air drag
and bearings leave after a minute or two, the angle follows

    angle″ = −friction·sign(angle′) − drag·angle′·|angle′| + sine·sin(angle) + cosine·cos(angle)

with dry friction, air drag and an eccentric mass, whatever the length of the record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import (
    Model,
    Residual,
    Run,
    constant,
    cos,
    fabs,
    inf,
    integrate,
    model,
    param,
    pi,
    quantity,
    rotation,
    sign,
    signal,
    sin,
    vertcat,
)

from .wheel import closed_form, wheel

Array = NDArray[np.float64]

#: Beginning of a record from which a start is found, in s: a cubic speed law holds so long.
FIRST = 40.0


@model
def wheel_motion(
    t=signal("s"),
    v=signal(3, "m/s^2"),
    *,
    offset=param(3, "m/s^2"),
    gain=param(3, start=1.0, bounds=(0, inf)),
    misalignment=param(3, "rad", per="run"),
    tilt=param("rad", start=0.8, bounds=(0, pi / 2), per="run"),
    phase=param("rad", per="run"),
    speed=param("rad/s", per="run"),
    friction=param("rad/s^2"),
    drag=param("1/rad"),
    imbalance=param(2, "rad/s^2"),
    radius=constant(0.28, "m"),
    gravity=constant(9.80665, "m/s^2"),
):
    """Accelerometer on a wheel slowed by dry friction and air drag, out of balance.

    As `wheel`, with phase and speed the angle and its rate at t = 0. imbalance: what gravity adds
    to angle'' by an eccentric mass, imbalance[0]·sin(angle) + imbalance[1]·cos(angle).
    """

    def turning(angle: Any, rate: Any) -> Any:
        slowed = friction * sign(rate) + drag * rate * fabs(rate)
        return imbalance[0] * sin(angle) + imbalance[1] * cos(angle) - slowed

    motion = integrate(lambda x: vertcat(x[1], turning(x[0], x[1])), vertcat(phase, speed), over=t)
    angle, rate = quantity("angle", motion[0], "rad"), quantity("rate", motion[1], "rad/s")
    acceleration = quantity("acceleration", turning(angle, rate), "rad/s^2")
    a = vertcat(
        radius * rate**2 + gravity * sin(tilt) * cos(angle),
        radius * acceleration + gravity * sin(tilt) * sin(angle),
        gravity * cos(tilt),
    )
    force = quantity("specific_force", rotation(misalignment) @ a, "m/s^2")
    reading = quantity("reading", offset + gain * force, "m/s^2")
    return Residual(measured=v, predicted=reading, corrected=force)


def beginning(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Start values: those of the wheel's first seconds, and how it slows down there."""
    first = [_first(run) for run in runs]
    same = {c.name: c for c in declared.constants if c.name in {s.name for s in wheel.declared}}
    alike = wheel.having(**{name: c.array for name, c in same.items() if name != "speed"})
    values = dict(closed_form(alike, first))
    speeds = np.atleast_2d(values.pop("speed"))
    friction, drag = _slowing(first, speeds)
    speed = speeds[:, 0] if len(runs) > 1 else speeds[0, 0]
    return {**values, "speed": speed, "friction": friction, "drag": drag}


def _first(run: Run) -> Run:
    time = run.signals["t"][:, 0]
    return run.take(slice(0, int(np.searchsorted(time, time[0] + FIRST))))


def _slowing(runs: Sequence[Run], speeds: Array) -> tuple[Array, Array]:
    """Friction and drag of the speed laws, by least squares; neither negative."""
    rows, left = [], []
    for run, speed in zip(runs, speeds, strict=True):
        t = np.linspace(run.signals["t"][0, 0], run.signals["t"][-1, 0], 50)
        rate = np.polynomial.polynomial.polyval(t, speed)
        slowed = -np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyder(speed))
        rows.append(np.column_stack([np.sign(rate), rate * np.abs(rate)]))
        left.append(slowed)
    found = np.linalg.lstsq(np.vstack(rows), np.concatenate(left), rcond=None)[0]
    return np.array(max(found[0], 0.0)), np.array(max(found[1], 0.0))


def convention(declared: Model, values: Mapping[str, Array]) -> dict[str, Array]:
    """Phase in (−π, π]."""
    if "phase" not in values:
        return dict(values)
    return {**values, "phase": -((-values["phase"] + np.pi) % (2 * np.pi) - np.pi)}


wheel_motion = wheel_motion.starting(beginning).canonical(convention)
