"""The wheel of design section 3, letter by letter, with the second-order effect beside it."""

from casest import (
    Residual,
    constant,
    cos,
    der,
    effect,
    inf,
    integral,
    model,
    param,
    pi,
    polynomial,
    quantity,
    rotation,
    signal,
    sin,
    vertcat,
)


@model
def wheel(
    t=signal("s"),
    v=signal(3, "m/s^2"),
    *,
    offset=param(3, "m/s^2"),
    gain=param(3, start=1.0, bounds=(0, inf)),
    misalignment=param(3, "rad", per="run"),
    tilt=param("rad", start=0.8, bounds=(0, pi / 2), per="run"),
    phase=param("rad", per="run"),
    speed=param(4, ("rad/s", "rad/s^2", "rad/s^3", "rad/s^4"), per="run"),
    radius=constant(0.28, "m"),
    gravity=constant(9.80665, "m/s^2"),
):
    """Accelerometer on a tilted, freely rotating wheel (Pedersini, eqs. 1-7)."""
    angle = quantity("angle", phase + integral(polynomial(speed, t), t), "rad")
    rate, acceleration = der(angle, t), der(der(angle, t), t)
    a = vertcat(
        radius * rate**2 + gravity * sin(tilt) * cos(angle),
        radius * acceleration + gravity * sin(tilt) * sin(angle),
        gravity * cos(tilt),
    )
    force = quantity("specific_force", rotation(misalignment) @ a, "m/s^2")
    reading = quantity("reading", offset + gain * force, "m/s^2")
    return Residual(measured=v, predicted=reading, corrected=force)


@effect(on="specific_force")
def quadratic(force, *, k=param(3, "1/(m/s^2)")):
    """Second-order response of each axis (Batista, eq. 2)."""
    return force + k * force**2
