"""What a user declares to close the measured records of records.py: the physics, and no more."""

from casest import Residual, attitude, model, param, quantity, rotation_matrix, signal


@model
def compass(m=signal(3), R=attitude(), *, earth=param(3, "[m]"), hard=param(3, "[m]")):
    """A magnetometer on a body whose attitude is recorded: the earth's field and hard iron."""
    field = quantity("field", R.T @ earth, "[m]")
    return Residual(measured=m, predicted=quantity("reading", field + hard, "[m]"), corrected=field)


@model
def cell(
    load=signal("lbf"),
    counts=signal("count"),
    *,
    zero=param("count"),
    gain=param("count/lbf", start=1000.0),
):
    """A load cell against weights: a straight line."""
    force = quantity("force", load, "lbf")
    return Residual(
        measured=counts,
        predicted=quantity("reading", zero + gain * force, "count"),
        corrected=force,
    )


@model
def two_gyros(
    w=signal(3, "rad/s"),
    u=signal(3, "rad/s"),
    *,
    turn=param(rotation_matrix),
    bias=param(3, "rad/s"),
):
    """Two gyros on one body, each with axes of its own."""
    rate = quantity("rate", turn @ u, "rad/s")
    return Residual(measured=w, predicted=quantity("reading", rate + bias, "rad/s"))


@model
def thermometer(
    chamber=signal("degC"), reads=signal("degC"), *, zero=param("K"), gain=param(start=1.0)
):
    """A thermometer in a box, against the temperature of the chamber around it."""
    around = quantity("around", gain * chamber, "degC")
    return Residual(measured=reads, predicted=quantity("reading", around + zero, "degC"))


@model
def steady(a=signal(3), *, level=param(3, "[a]")):
    """An accelerometer that is said to feel the same all the time."""
    return Residual(measured=a, predicted=quantity("reading", level, "[a]"))


@model
def house(
    inside=signal("degC"),
    outside=signal("degC"),
    sun=signal("kW/m^2"),
    *,
    base=param("degC", start=20.0),
    leak=param(start=0.1),
    gain=param("K/(kW/m^2)"),
):
    """A house that follows weather and sun at once."""
    weather = quantity("weather", leak * outside + gain * sun, "degC")
    return Residual(measured=inside, predicted=quantity("reading", base + weather, "degC"))
