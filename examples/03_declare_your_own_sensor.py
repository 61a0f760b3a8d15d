"""A thermistor, declared, fitted, and given an effect that its maker forgot."""

import numpy as np

import casest as c


@c.model
def thermistor(
    reference=c.signal("K"),
    resistance=c.signal("ohm"),
    *,
    at_25=c.param("ohm", start=10_000.0, bounds=(0, np.inf)),
    beta=c.param("K", start=3500.0),
    t_25=c.constant(298.15, "K"),
):
    """Two-parameter (beta) equation of an NTC thermistor."""
    temperature = c.quantity("temperature", reference, "K")
    reading = c.quantity("reading", at_25 * c.exp(beta * (1 / temperature - 1 / t_25)), "ohm")
    return c.Residual(measured=resistance, predicted=reading, corrected=temperature)


@c.effect(on="temperature")
def self_heating(temperature, *, rise=c.param("K")):
    """The measuring current warms the bead above its surroundings."""
    return temperature + rise


# A bead with Steinhart-Hart coefficients, warmed by half a kelvin: not the model's own formula.
reference = np.linspace(273.15, 343.15, 36)[:, None]
true = np.exp((1 / (reference + 0.5) - 1.1255e-3) / 2.3468e-4)  # 1/T = a + b ln R
noisy = true * (1 + 2e-4 * np.random.default_rng(0).standard_normal((36, 1)))
signals = {"reference": reference, "resistance": noisy}
run = c.Run.raw("bath", signals, units={"reference": "K", "resistance": "ohm"})

warm = c.calibrate(thermistor.with_effect(self_heating), [run])
rise, spread = warm.values["self_heating.rise"], warm.std["self_heating.rise"]
print(f"self-heating {rise:.2f} ± {spread:.2f} K, truth 0.5 K")
assert np.abs(c.Correction(warm.model)(run, warm.values) - reference).max() < 0.05
assert abs(rise - 0.5) < 4 * spread
