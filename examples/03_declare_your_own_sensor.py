"""A thermistor, declared, fitted, and given an effect that its maker forgot."""

import numpy as np

from casest import (
    Correction,
    Residual,
    Run,
    calibrate,
    constant,
    effect,
    exp,
    model,
    param,
    quantity,
    signal,
)


@model
def thermistor(
    reference=signal("K"),
    resistance=signal("ohm"),
    *,
    at_25=param("ohm", start=10_000.0, bounds=(0, np.inf)),
    beta=param("K", start=3500.0),
    t_25=constant(298.15, "K"),
):
    """Two-parameter (beta) equation of an NTC thermistor."""
    temperature = quantity("temperature", reference, "K")
    reading = quantity("reading", at_25 * exp(beta * (1 / temperature - 1 / t_25)), "ohm")
    return Residual(measured=resistance, predicted=reading, corrected=temperature)


@effect(on="temperature")
def self_heating(temperature, *, rise=param("K")):
    """The measuring current warms the bead above its surroundings."""
    return temperature + rise


# A bead with Steinhart-Hart coefficients, warmed by half a kelvin: not the model's own formula.
reference = np.linspace(273.15, 343.15, 36)
bead = reference + 0.5
a, b = 1.1255e-3, 2.3468e-4
true = np.exp((1 / bead - a) / b)  # 1/T = a + b ln R
noisy = true * (1 + 2e-4 * np.random.default_rng(0).standard_normal(36))
run = Run.raw(
    "bath",
    {"reference": reference[:, None], "resistance": noisy[:, None]},
    units={"reference": "K", "resistance": "ohm"},
)

found = calibrate(thermistor, [run])
warm = calibrate(thermistor.with_effect(self_heating), [run])
print(found.model, *found.certificate.reasons, sep="\n")
rise, spread = warm.values["self_heating.rise"], warm.std["self_heating.rise"]
print(f"self-heating {rise:.2f} ± {spread:.2f} K, truth 0.5 K")

back = Correction(warm.model)(run, warm.values)[:, 0]
worst = float(np.abs(back - reference).max())
print(f"temperature from resistance alone: within {worst * 1e3:.0f} mK")
assert worst < 0.05
assert abs(rise - 0.5) < 4 * spread
