"""NIST's Statistical Reference Datasets for nonlinear regression: 27 problems as casest models.

Data, two starts each and values certified to eleven digits (NIST computed in 128-bit arithmetic)
are read from NIST's own files, https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml; all are
pure numbers. A model's declared start is NIST's first, mostly the harder one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casest import Model, Residual, Run, atan, cos, exp, model, param, pi, signal, sin

#: Certified values have eleven digits: more agreement than this is not evidence.
DIGITS = 11.0

# -- the 27 models, formulas as in NIST's files ----------------------------------------------------
# One line per formula: a table of starts, which the formatter would stretch to a column.
# fmt: off


@model
def bennett5(x=signal(), y=signal(), *,
             b1=param(start=-2000.0), b2=param(start=50.0), b3=param(start=0.8)):
    """Superconductivity magnetization."""
    return Residual(measured=y, predicted=b1 * (b2 + x) ** (-1 / b3))


@model
def boxbod(x=signal(), y=signal(), *, b1=param(start=1.0), b2=param(start=1.0)):
    """Biochemical oxygen demand."""
    return Residual(measured=y, predicted=b1 * (1 - exp(-b2 * x)))


@model
def chwirut1(x=signal(), y=signal(), *,
             b1=param(start=0.1), b2=param(start=0.01), b3=param(start=0.02)):
    """Ultrasonic reference block."""
    return Residual(measured=y, predicted=exp(-b1 * x) / (b2 + b3 * x))


@model
def chwirut2(x=signal(), y=signal(), *,
             b1=param(start=0.1), b2=param(start=0.01), b3=param(start=0.02)):
    """Ultrasonic reference block, fewer readings."""
    return Residual(measured=y, predicted=exp(-b1 * x) / (b2 + b3 * x))


@model
def danwood(x=signal(), y=signal(), *, b1=param(start=1.0), b2=param(start=5.0)):
    """Energy radiated by a carbon filament, over its temperature."""
    return Residual(measured=y, predicted=b1 * x**b2)


@model
def eckerle4(x=signal(), y=signal(), *,
             b1=param(start=1.0), b2=param(start=10.0), b3=param(start=500.0)):
    """Circular interference transmittance."""
    return Residual(measured=y, predicted=b1 / b2 * exp(-0.5 * ((x - b3) / b2) ** 2))


@model
def enso(x=signal(), y=signal(), *,
         b1=param(start=11.0), b2=param(start=3.0), b3=param(start=0.5),
         b4=param(start=40.0), b5=param(start=-0.7), b6=param(start=-1.3),
         b7=param(start=25.0), b8=param(start=-0.3), b9=param(start=1.4)):
    """Differences of air pressure: an annual cycle and two of unknown periods, in months."""
    year, first, second = 2 * pi * x / 12, 2 * pi * x / b4, 2 * pi * x / b7
    cycles = b5 * cos(first) + b6 * sin(first) + b8 * cos(second) + b9 * sin(second)
    return Residual(measured=y, predicted=b1 + b2 * cos(year) + b3 * sin(year) + cycles)


def two_peaks(x, b1, b2, b3, b4, b5, b6, b7, b8):
    """Two Gaussian peaks on a decaying exponential baseline."""
    peaks = b3 * exp(-((x - b4) ** 2) / b5**2) + b6 * exp(-((x - b7) ** 2) / b8**2)
    return b1 * exp(-b2 * x) + peaks


@model
def gauss1(x=signal(), y=signal(), *, b1=param(start=97.0), b2=param(start=0.009),
           b3=param(start=100.0), b4=param(start=65.0), b5=param(start=20.0),
           b6=param(start=70.0), b7=param(start=178.0), b8=param(start=16.5)):
    """Two peaks well apart."""
    return Residual(measured=y, predicted=two_peaks(x, b1, b2, b3, b4, b5, b6, b7, b8))


@model
def gauss2(x=signal(), y=signal(), *, b1=param(start=96.0), b2=param(start=0.009),
           b3=param(start=103.0), b4=param(start=106.0), b5=param(start=18.0),
           b6=param(start=72.0), b7=param(start=151.0), b8=param(start=18.0)):
    """Two peaks that touch."""
    return Residual(measured=y, predicted=two_peaks(x, b1, b2, b3, b4, b5, b6, b7, b8))


@model
def gauss3(x=signal(), y=signal(), *, b1=param(start=94.9), b2=param(start=0.009),
           b3=param(start=90.1), b4=param(start=113.0), b5=param(start=20.0),
           b6=param(start=73.8), b7=param(start=140.0), b8=param(start=20.0)):
    """Two peaks strongly blended."""
    return Residual(measured=y, predicted=two_peaks(x, b1, b2, b3, b4, b5, b6, b7, b8))


def cubic_over_cubic(x, b1, b2, b3, b4, b5, b6, b7):
    """Rational function of third degree."""
    return (b1 + b2 * x + b3 * x**2 + b4 * x**3) / (1 + b5 * x + b6 * x**2 + b7 * x**3)


@model
def hahn1(x=signal(), y=signal(), *,
          b1=param(start=10.0), b2=param(start=-1.0), b3=param(start=0.05), b4=param(start=-1e-5),
          b5=param(start=-0.05), b6=param(start=0.001), b7=param(start=-1e-6)):
    """Thermal expansion of copper."""
    return Residual(measured=y, predicted=cubic_over_cubic(x, b1, b2, b3, b4, b5, b6, b7))


@model
def kirby2(x=signal(), y=signal(), *, b1=param(start=2.0), b2=param(start=-0.1),
           b3=param(start=0.003), b4=param(start=-0.001), b5=param(start=1e-5)):
    """Line widths under a scanning electron microscope."""
    return Residual(measured=y, predicted=(b1 + b2 * x + b3 * x**2) / (1 + b4 * x + b5 * x**2))


def three_decays(x, b1, b2, b3, b4, b5, b6):
    """Sum of three exponentials."""
    return b1 * exp(-b2 * x) + b3 * exp(-b4 * x) + b5 * exp(-b6 * x)


@model
def lanczos1(x=signal(), y=signal(), *,
             b1=param(start=1.2), b2=param(start=0.3), b3=param(start=5.6),
             b4=param(start=5.5), b5=param(start=6.5), b6=param(start=7.6)):
    """Three decays, generated to 14 digits: the residual is rounding."""
    return Residual(measured=y, predicted=three_decays(x, b1, b2, b3, b4, b5, b6))


@model
def lanczos2(x=signal(), y=signal(), *,
             b1=param(start=1.2), b2=param(start=0.3), b3=param(start=5.6),
             b4=param(start=5.5), b5=param(start=6.5), b6=param(start=7.6)):
    """Three decays, generated to 6 digits."""
    return Residual(measured=y, predicted=three_decays(x, b1, b2, b3, b4, b5, b6))


@model
def lanczos3(x=signal(), y=signal(), *,
             b1=param(start=1.2), b2=param(start=0.3), b3=param(start=5.6),
             b4=param(start=5.5), b5=param(start=6.5), b6=param(start=7.6)):
    """Three decays, generated to 5 digits."""
    return Residual(measured=y, predicted=three_decays(x, b1, b2, b3, b4, b5, b6))


@model
def mgh09(x=signal(), y=signal(), *, b1=param(start=25.0), b2=param(start=39.0),
          b3=param(start=41.5), b4=param(start=39.0)):
    """Kowalik and Osborne's enzyme kinetics."""
    return Residual(measured=y, predicted=b1 * (x**2 + x * b2) / (x**2 + x * b3 + b4))


@model
def mgh10(x=signal(), y=signal(), *,
          b1=param(start=2.0), b2=param(start=400000.0), b3=param(start=25000.0)):
    """Meyer's thermistor."""
    return Residual(measured=y, predicted=b1 * exp(b2 / (x + b3)))


@model
def mgh17(x=signal(), y=signal(), *, b1=param(start=50.0), b2=param(start=150.0),
          b3=param(start=-100.0), b4=param(start=1.0), b5=param(start=2.0)):
    """Osborne's two decays."""
    return Residual(measured=y, predicted=b1 + b2 * exp(-x * b4) + b3 * exp(-x * b5))


@model
def misra1a(x=signal(), y=signal(), *, b1=param(start=500.0), b2=param(start=0.0001)):
    """Dental research, monomolecular adsorption."""
    return Residual(measured=y, predicted=b1 * (1 - exp(-b2 * x)))


@model
def misra1b(x=signal(), y=signal(), *, b1=param(start=500.0), b2=param(start=0.0001)):
    """The same data, another isotherm."""
    return Residual(measured=y, predicted=b1 * (1 - (1 + b2 * x / 2) ** (-2)))


@model
def misra1c(x=signal(), y=signal(), *, b1=param(start=500.0), b2=param(start=0.0001)):
    """The same data, another isotherm."""
    return Residual(measured=y, predicted=b1 * (1 - (1 + 2 * b2 * x) ** (-0.5)))


@model
def misra1d(x=signal(), y=signal(), *, b1=param(start=500.0), b2=param(start=0.0001)):
    """The same data, Langmuir's isotherm."""
    return Residual(measured=y, predicted=b1 * b2 * x / (1 + b2 * x))


@model
def nelson(x=signal(2), y=signal(), *,
           b1=param(start=2.0), b2=param(start=0.0001), b3=param(start=-0.01)):
    """Logarithm of a dielectric strength after some time (x[0]) at some temperature (x[1])."""
    return Residual(measured=y, predicted=b1 - b2 * x[0] * exp(-b3 * x[1]))


@model
def rat42(x=signal(), y=signal(), *,
          b1=param(start=100.0), b2=param(start=1.0), b3=param(start=0.1)):
    """Pasture yield, sigmoidal growth."""
    return Residual(measured=y, predicted=b1 / (1 + exp(b2 - b3 * x)))


@model
def rat43(x=signal(), y=signal(), *, b1=param(start=100.0), b2=param(start=10.0),
          b3=param(start=1.0), b4=param(start=1.0)):
    """Dry weight of onion bulbs, sigmoidal growth."""
    return Residual(measured=y, predicted=b1 / (1 + exp(b2 - b3 * x)) ** (1 / b4))


@model
def roszman1(x=signal(), y=signal(), *, b1=param(start=0.1), b2=param(start=-1e-5),
             b3=param(start=1000.0), b4=param(start=-100.0)):
    """Quantum defects in iodine atoms."""
    return Residual(measured=y, predicted=b1 - b2 * x - atan(b3 / (x - b4)) / pi)


@model
def thurber(x=signal(), y=signal(), *,
            b1=param(start=1000.0), b2=param(start=1000.0), b3=param(start=400.0),
            b4=param(start=40.0), b5=param(start=0.7), b6=param(start=0.3), b7=param(start=0.03)):
    """Electron mobility in semiconductors, over the logarithm of the density."""
    return Residual(measured=y, predicted=cubic_over_cubic(x, b1, b2, b3, b4, b5, b6, b7))


# fmt: on

# -- which of equivalent solutions is meant: NIST certifies one of them ----------------------------


def sorted_terms(values: Mapping[str, Any], terms: Iterable[str], by: int) -> dict[str, Any]:
    """Equal terms ("b1 b2", "b3 b4") in the order of their parameter number `by`."""
    names = [term.split() for term in terms]
    own = sorted(([values[n] for n in term] for term in names), key=lambda v: float(v[by]))
    return {n: v for term, new in zip(names, own, strict=True) for n, v in zip(term, new)}  # noqa: B905


def decays_by_rate(_model: Model, values: Mapping[str, Any]) -> dict[str, Any]:
    """The slowest decay first."""
    return sorted_terms(values, ("b1 b2", "b3 b4", "b5 b6"), by=1)


def two_decays_by_rate(_model: Model, values: Mapping[str, Any]) -> dict[str, Any]:
    """The slower decay first."""
    return sorted_terms(values, ("b2 b4", "b3 b5"), by=1)


def peaks_by_place(_model: Model, values: Mapping[str, Any]) -> dict[str, Any]:
    """Widths positive, the left peak first."""
    positive = {**values, "b5": abs(values["b5"]), "b8": abs(values["b8"])}
    return sorted_terms(positive, ("b3 b4 b5", "b6 b7 b8"), by=1)


def width_positive(_model: Model, values: Mapping[str, Any]) -> dict[str, Any]:
    """Only b1/b2 and b2² appear."""
    turn = np.sign(values["b2"])
    return {"b1": turn * values["b1"], "b2": turn * values["b2"]}


def cycles_by_period(_model: Model, values: Mapping[str, Any]) -> dict[str, Any]:
    """Periods positive (time reversed: the sine turns), the longer one first."""
    turned = dict(values)
    for period, sine in (("b4", "b6"), ("b7", "b9")):
        turn = np.sign(values[period])
        turned |= {period: turn * values[period], sine: turn * values[sine]}
    return sorted_terms(turned, ("b7 b8 b9", "b4 b5 b6"), by=0)


#: By the name of NIST's file.
MODELS: dict[str, Model] = {
    "Misra1a": misra1a, "Chwirut2": chwirut2, "Chwirut1": chwirut1,
    "Lanczos3": lanczos3.canonical(decays_by_rate),
    "Gauss1": gauss1.canonical(peaks_by_place), "Gauss2": gauss2.canonical(peaks_by_place),
    "DanWood": danwood, "Misra1b": misra1b,
    "Kirby2": kirby2, "Hahn1": hahn1, "Nelson": nelson,
    "MGH17": mgh17.canonical(two_decays_by_rate),
    "Lanczos1": lanczos1.canonical(decays_by_rate), "Lanczos2": lanczos2.canonical(decays_by_rate),
    "Gauss3": gauss3.canonical(peaks_by_place), "Misra1c": misra1c, "Misra1d": misra1d,
    "Roszman1": roszman1, "ENSO": enso.canonical(cycles_by_period),
    "MGH09": mgh09, "Thurber": thurber, "BoxBOD": boxbod, "Rat42": rat42, "MGH10": mgh10,
    "Eckerle4": eckerle4.canonical(width_positive), "Rat43": rat43, "Bennett5": bennett5,
}  # fmt: skip

# -- NIST's files ----------------------------------------------------------------------------------

ROW = re.compile(r"^\s*(b\d+)\s*=\s*(\S+)\s+(\S+)\s+(\S+)\s+(\S+)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Certified:
    """One problem: its data, both starts, and what NIST certifies.

    `values`, `std` and the two `starts` are by parameter; `squares` is the residual sum of squares.
    """

    name: str
    run: Run
    starts: tuple[Mapping[str, float], Mapping[str, float]]
    values: Mapping[str, float]
    std: Mapping[str, float]
    squares: float

    def begun_at(self, start: Mapping[str, float]) -> Model:
        """The model with another declared start, so that a solver knows of this start alone.

        (A start given by the user is compared with the declared one, which is another of NIST's.)
        """
        return MODELS[self.name].having(**{n: param(start=value) for n, value in start.items()})


def read(folder: Path, name: str) -> Certified:
    """Read NIST's file of one problem."""
    file = folder / "nist-strd" / "NIST_STRD" / f"{name}.dat"
    text = file.read_text(encoding="ascii")
    rows = ROW.findall(text)
    first, second, values, std = (
        {row[0]: float(row[column]) for row in rows} for column in (1, 2, 3, 4)
    )
    squares = re.search(r"Residual Sum of Squares:\s*(\S+)", text)
    last = text.rindex("\nData:")
    table = np.loadtxt(text[last:].splitlines()[2:], dtype=float)
    y, x = table[:, :1], table[:, 1:]
    # NIST's model of Nelson's data is one of log(y).
    signals = {"x": x, "y": np.log(y) if name == "Nelson" else y}
    run = Run.raw(name, signals, units={}, file=str(file))
    assert squares is not None
    return Certified(name, run, (first, second), values, std, float(squares[1]))


# -- how right -------------------------------------------------------------------------------------


def digits(found: float, certified: float) -> float:
    """Log relative error: how many digits agree, at most the DIGITS that are certified."""
    error = abs(float(found) - certified) / abs(certified)
    return float(min(DIGITS, -np.log10(max(error, 1e-300)))) if np.isfinite(error) else 0.0


def fewest_digits(found: Mapping[str, Any], certified: Mapping[str, float]) -> float:
    """Digits of the worst parameter."""
    return min(digits(found[name], value) for name, value in certified.items())
