"""NTC thermistors against a thermometer: the beta equation and that of Steinhart and Hart.

J. S. Steinhart, S. R. Hart, "Calibration curves for thermistors", Deep-Sea Research 15, 1968. The
residual is in kelvin: the resistance changes a thousandfold over the range, so that equal weights
in ohm would fit the cold end alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casest import Model, Residual, Run, UsageError, constant, log, model, param, quantity, signal

Array = NDArray[np.float64]

#: Below this (K) no NTC thermistor is used: degrees Celsius that nobody stated.
COLDEST = 75.0


@model
def thermistor_beta(
    temperature=signal("K"),
    resistance=signal("ohm"),
    *,
    nominal_resistance=param("ohm", start=1e4, bounds=(0, None)),
    beta=param("K", start=3500.0),
    nominal_temperature=constant(298.15, "K", chosen=True),
):
    """Thermistor by two numbers: resistance = nominal·exp(β/T − β/T₀), T in K, T₀ = 25 °C."""
    ratio = log(resistance / nominal_resistance)
    value = 1 / (1 / nominal_temperature + ratio / beta)
    return _compared(value, temperature)


@model
def steinhart_hart(
    temperature=signal("K"),
    resistance=signal("ohm"),
    *,
    a=param("1/K", start=1e-3),
    b=param("1/K", start=2.5e-4),
    c=param("1/K", start=1e-7),
    one_ohm=constant(1.0, "ohm", chosen=True),
):
    """Thermistor by three numbers: 1/T = a + b·ln R + c·(ln R)³, T in K and R in ohm."""
    logarithm = log(resistance / one_ohm)
    value = 1 / (a + logarithm * (b + c * logarithm**2))
    return _compared(value, temperature)


def _compared(value: object, temperature: object) -> Residual:
    """The temperature that the resistance tells beside the thermometer's, in K."""
    told = quantity("corrected", value, "K")
    return Residual(implicit=told - temperature, unit="K", corrected=told, axes=("temperature",))


# -- where to begin: both are linear in 1/T ----------------------------------------------------


def _inverse_and_logarithm(runs: Sequence[Run]) -> tuple[Array, Array]:
    """1/T and ln R of all samples, (N,) each."""
    T = np.concatenate([run.signals["temperature"][:, 0] for run in runs])
    R = np.concatenate([run.signals["resistance"][:, 0] for run in runs])
    if np.min(T) < COLDEST:
        raise UsageError(
            f"temperature: {np.min(T):g} K is none of a thermistor; say the unit that it has, "
            "--unit temperature=degC"
        )
    if np.min(R) <= 0:
        raise UsageError(f"resistance: {np.min(R):g} ohm; a resistance is above 0")
    return 1 / T, np.log(R)


def beta_line(declared: Model, runs: Sequence[Run]) -> dict[str, float]:
    """ln R = (ln R₀ − β/T₀) + β/T, a straight line."""
    inverse, logarithm = _inverse_and_logarithm(runs)
    nominal = declared["nominal_temperature"]
    T0 = nominal.array if hasattr(nominal, "array") else nominal.start_value()
    beta, level = np.polyfit(inverse - 1 / T0, logarithm, 1)
    return {"beta": float(beta), "nominal_resistance": float(np.exp(level))}


def inverse_cubic(declared: Model, runs: Sequence[Run]) -> dict[str, float]:
    """1/T by least squares on 1, ln R and (ln R)³."""
    inverse, logarithm = _inverse_and_logarithm(runs)
    columns = np.column_stack([np.ones_like(logarithm), logarithm, logarithm**3])
    found = np.linalg.lstsq(columns, inverse)[0]
    return dict(zip("abc", map(float, found), strict=True))


thermistor_beta = thermistor_beta.starting(beta_line)
steinhart_hart = steinhart_hart.starting(inverse_cubic)
