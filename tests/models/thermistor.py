"""A user's own sensor: a thermistor beside a reference thermometer."""

from casest import Residual, constant, exp, inf, model, param, quantity, signal


@model
def thermistor(
    resistance=signal("ohm"),
    reference=signal("K"),
    *,
    r25=param("ohm", start=9000.0, bounds=(1.0, inf)),
    beta=param("K", start=3000.0, bounds=(100.0, 10000.0)),
    t25=constant(298.15, "K"),
):
    """Beta equation: R = R25 exp(B (1/T - 1/T25))."""
    temperature = quantity("temperature", reference, "K")
    reading = quantity("reading", r25 * exp(beta * (1 / temperature - 1 / t25)), "ohm")
    return Residual(measured=resistance, predicted=reading, corrected=temperature)
