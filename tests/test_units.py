"""Units at the boundary: spellings, conversions, and what is refused."""

from __future__ import annotations

import subprocess
import sys

import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st

from casest.errors import UnitError, UsageError
from casest.results.units import resolved
from casest.units import (
    canonical,
    conversion,
    familiar,
    known,
    parse_quantity,
    product,
    quotient,
    size,
)

SPELLINGS = [
    ("g", "g"),
    ("mg", "mg"),
    ("G", "gauss"),
    ("gauss", "gauss"),
    ("Gs", "gauss"),
    ("dps", "deg/s"),
    ("DPS", "deg/s"),
    ("deg/s", "deg/s"),
    ("°/s", "deg/s"),
    ("deg/sec", "deg/s"),
    ("rad/s", "rad/s"),
    ("rad s-1", "rad/s"),
    ("uT", "uT"),
    ("µT", "uT"),
    ("μT", "uT"),
    ("T", "T"),
    ("LSB", "count"),
    ("counts", "count"),
    ("raw", "count"),
    ("m/s2", "m/s^2"),
    ("m/s^2", "m/s^2"),
    ("m/s²", "m/s^2"),
    ("m/s**2", "m/s^2"),
    ("m/s/s", "m/s^2"),
    ("m s^-2", "m/s^2"),
    ("m·s⁻²", "m/s^2"),
    ("m/sec^2", "m/s^2"),
    ("ms", "ms"),
    ("sec", "s"),
    ("degC", "degC"),
    ("°C", "degC"),
    ("C", "degC"),
    ("rad/s2", "rad/s^2"),
    ("rad/s^4", "rad/s^4"),
    ("1/(m/s²)", "1/(m/s^2)"),
    ("g/LSB", "g/count"),
    ("dps/s", "(deg/s)/s"),
    ("m/s²/√Hz", "m/s^2/sqrt(Hz)"),
    ("", "1"),
    ("Nm", "Nm"),
    ("N·m", "N*m"),
]


@pytest.fixture(scope="module")
def registry() -> pint.UnitRegistry:
    return pint.UnitRegistry()


@pytest.mark.parametrize(("spelling", "name"), SPELLINGS)
def test_each_spelling_has_one_canonical_name(spelling: str, name: str) -> None:
    assert canonical(spelling) == name
    assert canonical(name) == name


def test_known_spellings_and_their_conversions_need_no_pint() -> None:
    code = (
        "import sys; from casest.units import canonical, conversion, quotient, parse_quantity\n"
        "[canonical(u) for u in ('m/s²','dps','µT','LSB','1/(m/s^2)','rad/s^4','°C')]\n"
        "conversion('g', 'm/s^2'); quotient('m/s^2', 'count'); parse_quantity('28 cm')\n"
        "sys.exit('pint' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("old", "new", "pint_old", "pint_new"),
    [
        ("g", "m/s^2", "standard_gravity", "m/s^2"),
        ("mg", "m/s^2", "millistandard_gravity", "m/s^2"),
        ("Gal", "m/s^2", "cm/s^2", "m/s^2"),
        ("deg/s", "rad/s", "deg/s", "rad/s"),
        ("deg/h", "rad/s", "deg/hour", "rad/s"),
        ("rpm", "rad/s", "rpm", "rad/s"),
        ("arcsec", "rad", "arcsec", "rad"),
        ("gauss", "uT", "1e-4 tesla", "microtesla"),
        ("ms", "s", "millisecond", "s"),
        ("min", "s", "minute", "s"),
        ("cm", "m", "cm", "m"),
        ("hPa", "bar", "hectopascal", "bar"),
        ("mV", "V", "millivolt", "volt"),
        ("1/g", "1/(m/s^2)", "1/standard_gravity", "s^2/m"),
        ("deg/s^2", "rad/s^2", "deg/s^2", "rad/s^2"),
        ("ug/sqrt(Hz)", "m/s^2/sqrt(Hz)", "microstandard_gravity/hertz**0.5", "m/s^1.5"),
        ("furlong", "m", "furlong", "m"),
    ],
)
def test_factors_agree_with_pint(
    registry: pint.UnitRegistry, old: str, new: str, pint_old: str, pint_new: str
) -> None:
    expected = registry(pint_old).to(pint_new).magnitude
    assert conversion(old, new) == pytest.approx((expected, 0.0), rel=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "before", "after"),
    [
        ("degC", "K", 25.0, 298.15),
        ("degF", "degC", 212.0, 100.0),
        ("degF", "K", -459.67, 0.0),
        ("K", "degC", 0.0, -273.15),
    ],
)
def test_temperatures_convert_with_an_offset(
    old: str, new: str, before: float, after: float
) -> None:
    factor, offset = conversion(old, new)
    assert factor * before + offset == pytest.approx(after, abs=1e-9)


def test_a_temperature_inside_a_product_is_a_difference() -> None:
    assert conversion("1/degC", "1/K") == (1.0, 0.0)
    assert conversion("degF/s", "degC/s") == pytest.approx((5 / 9, 0.0))


@given(st.floats(-1e6, 1e6), st.sampled_from([("g", "m/s^2"), ("degF", "K"), ("dps", "rad/s")]))
def test_there_and_back_is_where_one_was(x: float, pair: tuple[str, str]) -> None:
    factor, offset = conversion(*pair)
    back, back_offset = conversion(*reversed(pair))
    assert back * (factor * x + offset) + back_offset == pytest.approx(x, abs=1e-6, rel=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("degC", "m/s^2", "degC does not convert to m/s\\^2: one is a temperature"),
        ("LSB", "m/s^2", "count does not convert to m/s\\^2: one is a raw count"),
        ("count", "1", "count does not convert to 1"),
        ("rad/s", "Hz", "an angular rate, the other a frequency"),
        ("T", "deg/s", "a magnetic field"),
    ],
)
def test_different_dimensions_do_not_convert(old: str, new: str, words: str) -> None:
    with pytest.raises(UnitError, match=words):
        conversion(old, new)


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("m/s^3^", "unknown unit 'm/s\\^3\\^': did you mean"),
        ("dpss", "unknown unit 'dpss': did you mean 'dps'"),
        ("meterz", "did you mean 'meter'"),
        ("qqqq", "unknown unit 'qqqq': write it like m/s\\^2"),
        ("m/", "unknown unit 'm/'"),
        ("2 m", "unknown unit '2 m'"),
        ("(m", "unknown unit"),
        ("m)", "unknown unit"),
        ("m^", "unknown unit"),
    ],
)
def test_an_unknown_unit_is_named_with_a_near_one(unit: str, words: str) -> None:
    with pytest.raises(UnitError, match=words):
        canonical(unit)
    assert not known(unit)


def test_a_unit_is_guessed_from_a_header_only_where_the_table_knows_it() -> None:
    assert familiar("rad/s")
    assert familiar("µT")
    assert not familiar("a")  # pint: a year
    assert not familiar("left")
    assert known("furlong")
    assert not familiar("furlong")


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ("1", "count", "1/count"),
        ("m/s^2", "count", "(m/s^2)/count"),
        ("m/s^2", "m/s^2", "1"),
        ("m/s^2", "1", "m/s^2"),
        ("1", "m/s^2", "1/(m/s^2)"),
        ("m/s^2", "(m/s^2)/count", "count"),
        ("count", "1/count", "count^2"),
        ("rad", "s", "rad/s"),
    ],
)
def test_quotients_read_well_and_are_units_again(a: str, b: str, expected: str) -> None:
    assert quotient(a, b) == expected
    assert canonical(expected) == expected


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ("(m/s^2)/count", "count", "m/s^2"),
        ("count", "(m/s^2)/count", "m/s^2"),
        ("1/count", "count", "1"),
        ("1/count", "m/s^2", "(m/s^2)/count"),
        ("1", "g", "g"),
        ("g", "1", "g"),
        ("m/s^2", "m/s^2", "(m/s^2)^2"),
        ("m", "kg", "m*kg"),
    ],
)
def test_products_cancel_what_cancels(a: str, b: str, expected: str) -> None:
    assert product(a, b) == expected
    assert canonical(expected) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("28 cm", (28.0, "cm")),
        ("0.28", (0.28, None)),
        ("-1e-3", (-1e-3, None)),
        ("9.81m/s2", (9.81, "m/s^2")),
        (".5 g", (0.5, "g")),
    ],
)
def test_a_quantity_is_a_number_and_perhaps_a_unit(
    text: str, expected: tuple[float, str | None]
) -> None:
    assert parse_quantity(text) == expected


def test_a_quantity_without_a_number_is_refused() -> None:
    with pytest.raises(UsageError, match="'cm' is not a number with a unit"):
        parse_quantity("cm")
    with pytest.raises(UnitError, match="unknown unit 'cmm'"):
        parse_quantity("28 cmm")


def test_g_is_a_gram_where_a_mass_is_wanted():
    assert conversion("g", "kg") == pytest.approx((1e-3, 0.0))
    assert conversion("mg", "kg") == pytest.approx((1e-6, 0.0))
    assert conversion("g", "m/s^2") == pytest.approx((9.80665, 0.0))


@pytest.mark.parametrize(
    ("written", "factor"),
    [("Ohm", 1.0), ("kOhm", 1e3), ("kΩ", 1e3), ("\u2126", 1.0), ("MΩ", 1e6), ("mOhm", 1e-3)],
)
def test_ohms_are_read_as_they_are_written(written, factor):
    assert size(written)[0] == factor
    assert size(written)[1] == size("V/A")[1]


def test_case_that_would_tell_two_units_apart_is_not_forgiven():
    with pytest.raises(UnitError, match="MOHM"):
        canonical("MOHM")


@pytest.mark.parametrize(
    ("declared", "printed"),
    [("1/([u])^2", "1/(m/s^2)^2"), ("[u]/s", "(m/s^2)/s"), ("([u])", "m/s^2"),
     ("1/([c])^2", "1/count^2"), ("[u]/sqrt(Hz)", "(m/s^2)/sqrt(Hz)")],
)  # fmt: skip
def test_a_unit_is_printed_without_parentheses_that_nobody_needs(declared, printed):
    assert resolved(declared, {"u": "m/s^2", "c": "count"}) == printed
