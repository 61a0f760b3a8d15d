"""One channel against a reference: lines and polynomials, load cells, pressure sensors.

The reading has the noise, the reference is known: reading = offset + gain·reference + …, the form
of NIST's certified linear problems (Norris, ozone monitors; Pontius, a load cell's deflection).
`apply` turns readings into the reference's quantity and needs no column of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casest import Model, Residual, Run, constant, model, param, quantity, signal

Array = NDArray[np.float64]


@model
def linear(
    reference=signal(),
    reading=signal(),
    *,
    offset=param("[reading]"),
    gain=param("[reading]/[reference]"),
):
    """Straight line: reading = offset + gain·reference."""
    corrected = quantity("corrected", reference, "[reference]")
    predicted = quantity("predicted", offset + gain * corrected, "[reading]")
    return Residual(measured=reading, predicted=predicted, corrected=corrected)


@model
def polynomial(
    reference=signal(),
    reading=signal(),
    *,
    offset=param("[reading]"),
    gain=param("[reading]/[reference]"),
    quadratic=param("[reading]/[reference]^2"),
    cubic=constant(0.0, "[reading]/[reference]^3"),
    quartic=constant(0.0, "[reading]/[reference]^4"),
    at=constant(0.0, "[reference]", chosen=True),
):
    """Polynomial: reading = offset + gain·x + quadratic·x² + …, x = reference − at.

    The second degree; `--free cubic` and `--free quartic` raise it, `--fix offset=0` leaves a term
    out. Of references far from zero for their range no power is told from the others: `--set
    at=MIDDLE` counts from there. Where several references give one reading, the one inside the
    calibrated range is meant.
    """
    corrected = quantity("corrected", reference, "[reference]")
    x = corrected - at
    bent = x * (gain + x * (quadratic + x * (cubic + x * quartic)))
    predicted = quantity("predicted", offset + bent, "[reading]")
    return Residual(measured=reading, predicted=predicted, corrected=corrected)


@model
def load_cell(
    load=signal(),
    reading=signal(),
    *,
    zero=param("[reading]"),
    sensitivity=param("[reading]/[load]"),
):
    """Strain-gauge cell against weights: reading = zero + sensitivity·load.

    What else a cell does are effects of the catalogue: `temperature_bias` of its zero,
    `temperature_gain` of its sensitivity, `creep`, `hysteresis`, `quadratic`.
    """
    corrected = quantity("corrected", load, "[load]")
    predicted = quantity("predicted", zero + sensitivity * corrected, "[reading]")
    return Residual(measured=reading, predicted=predicted, corrected=corrected)


@model
def pressure(
    pressure=signal(),
    temperature=signal("degC"),
    reading=signal(),
    *,
    offset=param("[reading]"),
    sensitivity=param("[reading]/[pressure]"),
    nonlinearity=param("1/[pressure]"),
    offset_drift=param("[reading]/K"),
    sensitivity_drift=param("1/K"),
    reference_temperature=constant(25.0, "degC", chosen=True),
):
    """Bridge with offset, span, bend, and their temperature coefficients.

    reading = offset + offset_drift·ΔT + sensitivity·(1 + sensitivity_drift·ΔT)·p·(1 +
    nonlinearity·p), ΔT from `reference_temperature`. Without a temperature: `polynomial`.
    """
    corrected = quantity("corrected", pressure, "[pressure]")
    warmer = temperature - reference_temperature
    span = sensitivity * (1 + sensitivity_drift * warmer)
    level = offset + offset_drift * warmer
    bent = corrected * (1 + nonlinearity * corrected)
    predicted = quantity("predicted", level + span * bent, "[reading]")
    return Residual(measured=reading, predicted=predicted, corrected=corrected)


# -- where to begin ----------------------------------------------------------------------------


def column(runs: Sequence[Run], name: str) -> Array:
    """A signal of one number in all runs, (N,)."""
    return np.concatenate([run.signals[name][:, 0] for run in runs])


#: Coefficients in the order of their powers.
POWERS = ("offset", "gain", "quadratic", "cubic", "quartic")


def coefficients(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Least squares for those that are unknown, in references from −1 to 1."""
    unknown = [p.name for p in declared.parameters if p.name in POWERS]
    x, y = column(runs, "reference"), column(runs, "reading")
    held = {constant.name: constant.array for constant in declared.constants}
    x = x - held.pop("at", 0.0)
    size = float(np.max(np.abs(x))) or 1.0
    for name, value in held.items():
        y = y - value * x ** POWERS.index(name)
    powers = [POWERS.index(name) for name in unknown]
    found = np.linalg.lstsq((x / size)[:, None] ** powers, y)[0] / size ** np.array(powers, float)
    return dict(zip(unknown, found, strict=True))


def straight_line(runs: Sequence[Run], reference: str) -> tuple[float, float]:
    """Where sensors that are nearly straight begin: level and slope of `reading` over that."""
    x, y = column(runs, reference), column(runs, "reading")
    slope = float((x - x.mean()) @ y) / (float(np.sum((x - x.mean()) ** 2)) or 1.0)
    return float(y.mean() - slope * x.mean()), slope


def line(declared: Model, runs: Sequence[Run]) -> dict[str, float]:
    """A straight line through all readings: zero and sensitivity of a load cell."""
    return dict(zip(("zero", "sensitivity"), straight_line(runs, "load"), strict=True))


def middle_line(declared: Model, runs: Sequence[Run]) -> dict[str, float]:
    """The same of a pressure sensor, as if none were warmer."""
    return dict(zip(("offset", "sensitivity"), straight_line(runs, "pressure"), strict=True))


linear = linear.starting(coefficients)
polynomial = polynomial.starting(coefficients)
load_cell = load_cell.starting(line)
pressure = pressure.starting(middle_line)
