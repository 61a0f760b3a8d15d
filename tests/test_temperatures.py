"""From where a temperature counts: degC is refused where absolute zero is asked for."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest import (
    Residual,
    UnitError,
    check_units,
    constant,
    effect,
    exp,
    fmax,
    if_else,
    log,
    model,
    param,
    polynomial,
    quantity,
    signal,
    sqrt,
)
from casest.cli import run


def checked(body, unit: str = "degC", reading: str = "V", result: str = "V") -> None:
    """A model whose prediction is a coefficient times what `body` makes of a temperature."""

    @model
    def sensor(
        temperature=signal(unit),
        other=signal(unit),
        current=signal("A"),
        y=signal(reading),
        *,
        one=param(result),
        zero=param("K"),
        slope=param("V/K"),
        gain=param(start=1.0),
        rise=param("K/A^2"),
        warm=constant(298.15, "K"),
        near=constant(25.0, "degC"),
        ice=constant(273.15, "K"),
    ):
        """Whatever the body makes of it."""
        symbols = {
            "T": temperature, "T2": other, "i": current, "one": one, "zero": zero, "slope": slope,
            "gain": gain, "rise": rise, "warm": warm, "near": near, "ice": ice,
        }  # fmt: skip
        return Residual(measured=y, predicted=body(symbols))

    check_units(sensor)


def kelvin(s, value):
    return s["one"] * quantity("hot", value, "K") / s["zero"]


FINE = {
    "a coefficient per kelvin": lambda s: s["one"] + s["slope"] * s["T"],
    "a difference of two": lambda s: s["slope"] * quantity("d", s["T"] - s["T2"], "K"),
    "a difference from a number": lambda s: s["slope"] * quantity("d", s["T"] - 20.0, "K"),
    "a number minus it": lambda s: s["slope"] * quantity("d", 20.0 - s["T"], "K"),
    "a difference from a constant": lambda s: s["slope"] * quantity("d", s["T"] - s["near"], "K"),
    "the mean of two in degC": lambda s: s["slope"] * quantity("m", (s["T"] + s["T2"]) / 2, "degC"),
    "a difference of means": lambda s: kelvin(s, 0.5 * s["T"] - 0.5 * s["T2"]),
    "converted by a number": lambda s: kelvin(s, s["T"] + 273.15),
    "converted by a constant": lambda s: kelvin(s, s["T"] + s["ice"]),
    "an unknown zero": lambda s: kelvin(s, s["T"] + s["zero"]),
    "one over the converted": lambda s: s["one"] * exp(s["zero"] / (s["T"] + 273.15)),
    "the ratio to a converted constant": lambda s: s["one"] * log(s["warm"] / (s["T"] + 273.15)),
    "copper's own zero": lambda s: s["one"] * (1 / (234.5 + s["T"])) * s["zero"],
    "Magnus' formula": lambda s: s["one"] * exp(17.62 * s["T"] / (243.12 + s["T"])),
    "an exponential": lambda s: s["one"] * exp(-s["T"] / s["zero"]),
    "IEC 60751": lambda s: s["one"] * (1 + s["T"] / s["zero"] + s["T"] ** 2 / s["zero"] ** 2),
    "a cube": lambda s: s["one"] * s["T"] ** 3 / s["zero"] ** 3,
    "an if": lambda s: s["one"] + s["slope"] * if_else(s["T"] > 30, s["T"], 30.0),
    "a limit in degC": lambda s: s["slope"] * fmax(s["T"], s["near"]),
    "a difference over a span": lambda s: s["one"] * ((s["T"] - s["near"]) / s["near"]),
    "a rise": lambda s: s["slope"] * quantity("r", s["T"] + s["rise"] * s["i"] ** 2, "degC"),
    "a gain in degC": lambda s: s["slope"] * quantity("g", s["gain"] * s["T"], "degC"),
}  # fmt: skip

WRONG = {
    "declared in K": (lambda s: kelvin(s, 1 * s["T"]), "quantity hot is declared in K"),
    "with a correction": (lambda s: kelvin(s, s["T"] + 0.5), "quantity hot is declared in K"),
    "a mean in K": (lambda s: kelvin(s, (s["T"] + s["T2"]) / 2), "quantity hot is declared in K"),
    "a gain in K": (lambda s: kelvin(s, s["gain"] * s["T"]), "quantity hot is declared in K"),
    "a rise in K": (lambda s: kelvin(s, s["T"] + s["rise"] * s["i"] ** 2), "declared in K"),
    "one over it": (lambda s: s["one"] * exp(s["zero"] / s["T"]), "a division by"),
    "1/T": (lambda s: s["one"] * s["zero"] * (1 / s["T"]), "a division by"),
    "a ratio of two": (lambda s: s["one"] * s["T"] / s["T2"], "a division by"),
    "log of a ratio": (lambda s: s["one"] * log(s["T"] / s["zero"]), "the logarithm of"),
    "a root": (lambda s: s["one"] * sqrt(s["T"] / s["zero"]), "the root of"),
    "Stefan-Boltzmann": (lambda s: s["one"] * s["T"] ** 4 / s["zero"] ** 4, "higher power of"),
    "a half power": (lambda s: s["one"] * (s["T"] / s["zero"]) ** 1.5, "a root or higher power"),
    "minus one in K": (lambda s: s["slope"] * (s["T"] - s["warm"]), "a constant of 298.15 K"),
    "compared with K": (lambda s: s["slope"] * fmax(s["T"], s["warm"]), "is compared with"),
    "asked against K": (lambda s: s["one"] * if_else(s["T"] > s["warm"], 1, 2), "compared with"),
}  # fmt: skip


@pytest.mark.parametrize("name", FINE)
def test_what_a_temperature_in_degc_may_stand_in(name):
    checked(FINE[name])


@pytest.mark.parametrize("name", WRONG)
def test_what_asks_for_absolute_zero_is_refused_with_the_way_out(name):
    body, words = WRONG[name]
    with pytest.raises(UnitError, match=words) as caught:
        checked(body)
    said = str(caught.value)
    assert "\n" not in said
    assert "model sensor" in said
    assert "temperature [degC]" in said or "other [degC]" in said
    assert "signal in K" in said or "declare both in one of them" in said


TWO_ZEROS = ("minus one in K", "compared with K", "asked against K")  # right if both are in K


@pytest.mark.parametrize("name", [name for name in WRONG if name not in TWO_ZEROS])
def test_the_same_of_a_signal_in_kelvin_is_right(name):
    body, _ = WRONG[name]
    checked(lambda s: body(s | {"near": s["warm"]}), unit="K")


def test_fahrenheit_counts_from_its_own_zero():
    with pytest.raises(UnitError, match=r"a temperature in degF.*add constant\(459.67"):
        checked(lambda s: s["one"] * (1 / s["T"]) * s["zero"], unit="degF")


# -- predictions ---------------------------------------------------------------------------------


def predicted(body, reading: str) -> None:
    @model
    def thermometer(
        u=signal("V"),
        r=signal("ohm"),
        kelvin_beside=signal("K"),
        y=signal(reading),
        *,
        level=param("K"),
        celsius=param("degC"),
        slope=param("K/V"),
        a=param("1/K", start=1e-3),
        b=param("1/K", start=1e-4),
        r0=constant(1.0, "ohm"),
    ):
        """A reading that is a temperature."""
        symbols = {
            "u": u, "r": r, "K": kelvin_beside, "level": level, "celsius": celsius,
            "slope": slope, "a": a, "b": b, "r0": r0,
        }  # fmt: skip
        return Residual(measured=y, predicted=body(symbols))

    check_units(thermometer)


def steinhart_hart(s):
    return 1 / (s["a"] + s["b"] * log(s["r"] / s["r0"]))


@pytest.mark.parametrize(
    ("body", "right", "wrong"),
    [
        (steinhart_hart, "K", "degC"),
        (lambda s: quantity("hot", steinhart_hart(s), "K"), "K", "degC"),
        (lambda s: steinhart_hart(s) - 273.15, "degC", "K"),
        (lambda s: 1 * s["level"], "K", "degC"),
        (lambda s: 1 * s["celsius"], "degC", "K"),
        (lambda s: 1 * s["K"], "K", "degC"),
        (lambda s: s["K"] - 273.15, "degC", "K"),
        (lambda s: s["slope"] * s["u"], "K", "degC"),
        (lambda s: s["celsius"] + s["slope"] * s["u"], "degC", "K"),
    ],
)
def test_a_prediction_counts_from_the_zero_of_its_reading(body, right, wrong):
    predicted(body, right)
    with pytest.raises(UnitError, match=r"the prediction of y \[(K|degC)\], and what it holds"):
        predicted(body, wrong)


@pytest.mark.parametrize("reading", ["K", "degC"])
def test_a_number_or_an_unknown_in_kelvin_may_take_up_the_zero(reading):
    predicted(lambda s: s["level"] + s["slope"] * s["u"], reading)
    predicted(lambda s: 20.0 + s["slope"] * s["u"], reading)


def test_a_residual_that_compares_degc_with_kelvin_is_refused():
    @model
    def thermometer(r=signal("ohm"), y=signal("degC"), *, a=param("1/K"), b=param("1/(K*ohm)")):
        """A relation instead of a prediction."""
        return Residual(implicit=y - 1 / (a + b * r), unit="K")

    with pytest.raises(UnitError, match="the residual, and what it holds counts from 0 degC"):
        check_units(thermometer)


def test_the_quadratic_of_an_effect_on_a_temperature_is_no_error():
    @effect(on="felt")
    def bend(felt, *, k=param("1/[felt]")):
        """Second order in a temperature in degC."""
        return felt + k * felt**2

    @model
    def thermometer(true=signal("degC"), y=signal("degC"), *, gain=param(start=1.0), b=param("K")):
        """A thermometer beside a better one."""
        felt = quantity("felt", 1 * true, "degC")
        return Residual(measured=y, predicted=b + gain * felt)

    check_units(thermometer.with_effect(bend))


def test_a_polynomial_in_degc_is_what_a_data_sheet_means():
    @model
    def bridge(temperature=signal("degC"), y=signal("mV"), *, c=param(3, ("mV", "mV/K", "mV/K^2"))):
        """A drift of second order."""
        return Residual(measured=y, predicted=polynomial(c, temperature))

    check_units(bridge)


# -- fits ----------------------------------------------------------------------------------------

THERMISTOR = '''
from casest import Residual, constant, exp, inf, model, param, quantity, signal


@model
def thermistor(
    resistance=signal("ohm"),
    reference=signal("{unit}"),
    *,
    r25=param("ohm", start=9000.0, bounds=(1.0, inf)),
    beta=param("K", start=3000.0, bounds=(100.0, 10000.0)),
    t25=constant(298.15, "K"),
):
    """Beta equation: R = R25 exp(B (1/T - 1/T25))."""
    temperature = quantity("temperature", {value}, "K")
    reading = quantity("reading", r25 * exp(beta * (1 / temperature - 1 / t25)), "ohm")
    return Residual(measured=resistance, predicted=reading, corrected=temperature)
'''


def test_a_thermistor_beside_a_thermometer_in_degc(tmp_path, capsys, monkeypatch):
    """10 kohm, B = 3950 K; in degC as the logger writes it."""
    monkeypatch.chdir(tmp_path)
    celsius = np.linspace(5, 60, 40)
    resistance = 10_000 * np.exp(3950 * (1 / (celsius + 273.15) - 1 / 298.15))
    resistance *= 1 + 1e-4 * np.random.default_rng(0).standard_normal(40)
    rows = "".join(f"{r:.3f},{t:.4f}\n" for r, t in zip(resistance, celsius, strict=True))
    (tmp_path / "r.csv").write_text("resistance [ohm],reference [degC]\n" + rows)
    wrong = THERMISTOR.format(unit="degC", value="reference")
    (tmp_path / "wrong.py").write_text(wrong)
    assert run(["calibrate", "wrong.py", "r.csv"]) == 1
    said = capsys.readouterr().err
    assert "model thermistor, reference [degC]: 1 divided by a temperature in degC" in said
    assert "declare the signal in K (data in degC are converted), or add constant(273.15" in said
    for unit, value in (("K", "reference"), ("degC", "reference + 273.15")):
        (tmp_path / "right.py").write_text(THERMISTOR.format(unit=unit, value=value))
        assert run(["calibrate", "right.py", "r.csv", "--json"]) == 0
        found = json.loads(capsys.readouterr().out)["estimate"]["parameters"]
        assert found["beta"]["value"] == pytest.approx(3950, abs=4 * found["beta"]["std"])
        assert found["r25"]["value"] == pytest.approx(10_000, abs=4 * found["r25"]["std"])
        assert found["beta"]["std"] < 5


def test_the_load_cell_of_the_readme_stays_usable():
    @model
    def load_cell(
        mass=signal("kg"),
        temperature=signal("degC"),
        reading=signal("mV"),
        *,
        sensitivity=param("mV/N", start=0.01),
        zero=param("mV"),
        drift=param("mV/K"),
        gravity=constant(9.81, "m/s^2"),
    ):
        """A strain-gauge cell whose zero drifts with temperature."""
        force = quantity("force", mass * gravity, "N")
        warm = zero + drift * temperature + drift * (temperature - 20.0)
        predicted = quantity("predicted", warm + sensitivity * force, "mV")
        return Residual(measured=reading, predicted=predicted, corrected=force)

    check_units(load_cell)
