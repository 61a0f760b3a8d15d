"""Sensors of users' own, a few lines each, as they would declare them: nothing here is shipped."""

from __future__ import annotations

from casest import (
    Residual,
    attitude,
    constant,
    exp,
    inf,
    model,
    norm_2,
    param,
    quantity,
    signal,
)


@model
def load_cell(
    force=signal("N"), reading=signal("mV"), *, zero=param("mV"), sensitivity=param("mV/N")
):
    """A strain-gauge bridge under a recorded load."""
    applied = quantity("applied", force, "N")
    predicted = quantity("predicted", zero + sensitivity * applied, "mV")
    return Residual(measured=reading, predicted=predicted, corrected=applied)


@model
def thermistor(
    reference=signal("K"),
    resistance=signal("ohm"),
    *,
    r25=param("ohm", start=9000.0, bounds=(1.0, inf)),
    beta=param("K", start=3000.0, bounds=(100.0, 10000.0)),
):
    """Beta equation beside a recorded reference: R = R25 exp(B (1/T - 1/T25))."""
    temperature = quantity("temperature", reference, "K")
    predicted = quantity("predicted", r25 * exp(beta * (1 / temperature - 1 / 298.15)), "ohm")
    return Residual(measured=resistance, predicted=predicted, corrected=temperature)


@model
def platinum(
    reference=signal("K"), resistance=signal("ohm"), *, zero=param("ohm"), slope=param("ohm/K")
):
    """A platinum thermometer over a narrow range, beside a recorded reference."""
    temperature = quantity("temperature", reference, "K")
    predicted = quantity("predicted", zero + slope * (temperature - 300), "ohm")
    return Residual(measured=resistance, predicted=predicted, corrected=temperature)


@model
def torque_meter(
    torque=signal("N*m"), reading=signal("mV"), *, zero=param("mV"), gain=param("mV/(N*m)")
):
    """A torque meter on a turning shaft; the brake's torque is recorded."""
    applied = quantity("applied", torque, "N*m")
    predicted = quantity("predicted", zero + gain * applied, "mV")
    return Residual(measured=reading, predicted=predicted, corrected=applied)


@model
def one_gain(
    v=signal(3, "uT"),
    *,
    gain=param(start=1.0, bounds=(0, inf)),
    offset=param(3, "uT"),
    field=constant(48.0, "uT"),
):
    """A magnetometer in a field of known strength whose axes are all alike."""
    corrected = quantity("corrected", gain * (v - offset), "uT")
    length = norm_2(corrected)
    return Residual(
        implicit=(length - field) / gain, unit="uT", corrected=corrected, axes=("norm",)
    )


@model
def triad(
    force=signal(3, "m/s^2"),
    v=signal(3, "m/s^2"),
    *,
    gain=param(start=1.0),
    offset=param(3, "m/s^2"),
):
    """Three accelerometers beside a recorded reference, of one gain."""
    felt = quantity("felt", force, "m/s^2")
    predicted = quantity("predicted", offset + gain * felt, "m/s^2")
    return Residual(measured=v, predicted=predicted, corrected=felt)


@model
def compass(attitude=attitude(), m=signal(3, "uT"), *, earth=param(3, "uT"), hard=param(3, "uT")):
    """A magnetometer on a body whose attitude is recorded: m = Rᵀ earth + hard."""
    field = quantity("field", attitude.T @ earth, "uT")
    predicted = quantity("predicted", field + hard, "uT")
    return Residual(measured=m, predicted=predicted, corrected=field)


@model
def gyro_at_rest(v=signal(3, "rad/s"), *, bias=param(3, "rad/s")):
    """At rest a gyroscope reads its bias."""
    return Residual(measured=v, predicted=quantity("predicted", bias, "rad/s"))
