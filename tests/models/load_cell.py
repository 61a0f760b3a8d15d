"""A user's own sensors: a load cell loaded with known weights; two models in one file."""

from casest import Residual, constant, effect, model, param, quantity, signal


@model
def load_cell(
    output=signal("mV"),
    mass=signal("kg"),
    *,
    zero=param("mV"),
    sensitivity=param("mV/N", start=0.1),
    gravity=constant(9.80665, "m/s^2"),
):
    """Output of a strain-gauge bridge under a weight."""
    force = quantity("force", mass * gravity, "N")
    reading = quantity("reading", zero + sensitivity * force, "mV")
    return Residual(measured=output, predicted=reading, corrected=force)


@model
def zero_only(output=signal("mV"), mass=signal("kg"), *, zero=param("mV"), slope=1.0):
    """The same cell with a slope that is known."""
    return Residual(measured=output, predicted=zero + slope * mass)


@effect(on="reading")
def warming(reading, temperature=signal("degC"), *, drift=param("mV/K")):
    """Zero drift with temperature, from another column of the record."""
    return reading + drift * (temperature - 20.0)


@effect(on="force")
def curvature(force, *, k=param("1/N")):
    """Second-order response."""
    return force + k * force**2
