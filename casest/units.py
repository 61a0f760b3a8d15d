"""Units at the boundary: the spellings engineers write, one canonical name each, conversions.

Inside models there are only numbers; units are read, checked and converted where data come in.
Everything in the table below works without pint, whose registry takes half a second to load;
pint is asked only about names that are not in the table.
"""

from __future__ import annotations

import difflib
import functools
import math
import re
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from casest.errors import UnitError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

STANDARD_GRAVITY = 9.80665  # m/s^2, CGPM 1901

Dimension = tuple[tuple[str, Fraction], ...]  # base symbol and its power, sorted, none zero


@dataclass(frozen=True)
class _Size:
    """A unit in SI base units: SI value = factor * value + offset."""

    factor: float
    dimension: Dimension
    offset: float = 0.0


def _si(factor: float, offset: float = 0.0, **powers: int) -> _Size:
    return _Size(factor, tuple(sorted((k, Fraction(p)) for k, p in powers.items())), offset)


_MASS = _si(1.0, kg=1)
_GRAMS = {"g": _si(1e-3, kg=1), "mg": _si(1e-6, kg=1)}
_TESLA = {"kg": 1, "s": -2, "A": -1}
_KELVIN_OF_0_DEGC = 273.15

# Angle and count are dimensions of their own: rad/s is not Hz, and a count is nothing but a count.
_ATOMS: dict[str, _Size] = {
    "1": _si(1.0),
    "%": _si(0.01),
    "ppm": _si(1e-6),
    "count": _si(1.0, count=1),
    "s": _si(1.0, s=1),
    "ms": _si(1e-3, s=1),
    "us": _si(1e-6, s=1),
    "ns": _si(1e-9, s=1),
    "min": _si(60.0, s=1),
    "h": _si(3600.0, s=1),
    "Hz": _si(1.0, s=-1),
    "kHz": _si(1e3, s=-1),
    "m": _si(1.0, m=1),
    "km": _si(1e3, m=1),
    "cm": _si(1e-2, m=1),
    "mm": _si(1e-3, m=1),
    "um": _si(1e-6, m=1),
    "kg": _si(1.0, kg=1),
    "N": _si(1.0, kg=1, m=1, s=-2),
    "kN": _si(1e3, kg=1, m=1, s=-2),
    "Nm": _si(1.0, kg=1, m=2, s=-2),  # of a torque, not the yarn's number
    "kNm": _si(1e3, kg=1, m=2, s=-2),
    "mNm": _si(1e-3, kg=1, m=2, s=-2),
    "Ncm": _si(1e-2, kg=1, m=2, s=-2),
    "Nmm": _si(1e-3, kg=1, m=2, s=-2),
    "Pa": _si(1.0, kg=1, m=-1, s=-2),
    "hPa": _si(1e2, kg=1, m=-1, s=-2),
    "kPa": _si(1e3, kg=1, m=-1, s=-2),
    "MPa": _si(1e6, kg=1, m=-1, s=-2),
    "bar": _si(1e5, kg=1, m=-1, s=-2),
    "mbar": _si(1e2, kg=1, m=-1, s=-2),
    "A": _si(1.0, A=1),
    "mA": _si(1e-3, A=1),
    "V": _si(1.0, kg=1, m=2, s=-3, A=-1),
    "mV": _si(1e-3, kg=1, m=2, s=-3, A=-1),
    "uV": _si(1e-6, kg=1, m=2, s=-3, A=-1),
    "ohm": _si(1.0, kg=1, m=2, s=-3, A=-2),
    "kohm": _si(1e3, kg=1, m=2, s=-3, A=-2),
    "Mohm": _si(1e6, kg=1, m=2, s=-3, A=-2),
    "mohm": _si(1e-3, kg=1, m=2, s=-3, A=-2),
    "g": _si(STANDARD_GRAVITY, m=1, s=-2),
    "mg": _si(STANDARD_GRAVITY * 1e-3, m=1, s=-2),
    "ug": _si(STANDARD_GRAVITY * 1e-6, m=1, s=-2),
    "Gal": _si(1e-2, m=1, s=-2),
    "mGal": _si(1e-5, m=1, s=-2),
    "rad": _si(1.0, angle=1),
    "mrad": _si(1e-3, angle=1),
    "deg": _si(math.pi / 180, angle=1),
    "arcmin": _si(math.pi / 180 / 60, angle=1),
    "arcsec": _si(math.pi / 180 / 3600, angle=1),
    "rev": _si(2 * math.pi, angle=1),
    "rpm": _si(2 * math.pi / 60, angle=1, s=-1),
    "T": _si(1.0, **_TESLA),
    "mT": _si(1e-3, **_TESLA),
    "uT": _si(1e-6, **_TESLA),
    "nT": _si(1e-9, **_TESLA),
    "gauss": _si(1e-4, **_TESLA),
    "mgauss": _si(1e-7, **_TESLA),
    "K": _si(1.0, K=1),
    "degC": _si(1.0, _KELVIN_OF_0_DEGC, K=1),
    "degF": _si(5 / 9, _KELVIN_OF_0_DEGC - 32 * 5 / 9, K=1),
}

# Canonical spelling: the other spellings found in headers and manuals.
_SPELLINGS: dict[str, str] = {
    "1": "- none dimensionless unitless",
    "%": "percent pct",
    "count": "counts LSB lsb LSBs LSb raw ADC adc digit digits dn DN cnt cnts code codes",
    "s": "sec secs second seconds",
    "ms": "msec msecs millisecond milliseconds",
    "us": "usec usecs microsecond microseconds",
    "ns": "nsec nanosecond nanoseconds",
    "min": "minute minutes",
    "h": "hr hrs hour hours",
    "Hz": "hz hertz",
    "m": "meter meters metre metres",
    "cm": "centimeter centimetre",
    "mm": "millimeter millimetre",
    "g": "gee gees g0 gn g_n standard_gravity",
    "mg": "milli-g millig mgee",
    "ug": "micro-g microg",
    "m/s^2": "m/s2 m/s/s mps2 mpss ms-2 ms^-2 m*s^-2 s^-2*m m/(s*s) m/(s^2)",
    "m/s": "mps ms-1 ms^-1 m*s^-1",
    "rad": "rads radian radians",
    "deg": "degs degree degrees",
    "mdeg/s": "mdps",
    "deg/s": "dps DPS degps deg*s^-1",
    "rad/s": "rps rads/s radps rad*s^-1",
    "arcsec": "as arcsecond arcseconds",
    "arcmin": "arcminute arcminutes",
    "rev": "revolution revolutions turn turns",
    "rpm": "RPM rev/min U/min",
    "T": "tesla teslas",
    "uT": "microtesla",
    "mT": "millitesla",
    "nT": "nanotesla",
    "gauss": "G Gs Gauss",
    "mgauss": "mG mGs milligauss mGauss",
    "degC": "C celsius Celsius deg_C degrees_C",
    "degF": "F fahrenheit Fahrenheit deg_F",
    "K": "kelvin Kelvin",
    "V": "volt volts",
    "ohm": "Ohm ohms Ohms",
    "kohm": "kOhm KOhm kohms kOhms",
    "Mohm": "MOhm Mohms MOhms",
    "mohm": "mOhm mohms mOhms",
    "A": "amp ampere",
}
_CANONICAL = {name: name for name in _ATOMS} | {
    spelling: name
    for name, spellings in _SPELLINGS.items()
    for spelling in [name, *spellings.split()]
}
# Case tells g from G, ms from Ms and mohm from Mohm, so it is forgiven only in names of three
# letters or more that mean one unit in any case.
_IN_LOWER_CASE = [(name.lower(), unit) for name, unit in _CANONICAL.items() if len(name) >= 3]
_ANY_CASE = {
    name: unit
    for name, unit in _IN_LOWER_CASE
    if {u for n, u in _IN_LOWER_CASE if n == name} == {unit}
}

_SUPERSCRIPT = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_SIGNS = (
    ("µ", "u"),
    ("μ", "u"),
    ("°", "deg"),
    ("º", "deg"),
    ("−", "-"),
    ("Ω", "ohm"),
    ("\u2126", "ohm"),
)
_PRODUCT_SIGNS = ("·", "⋅", "×")  # a middle dot, a dot operator, a times sign
_TOKEN = re.compile(
    r"\s*(?:(?P<name>[A-Za-z_%][A-Za-z_0-9%]*)|(?P<number>[-+]?\d+(?:\.\d+)?)|(?P<sign>[*/^()]))"
)


@functools.cache
def canonical(unit: str) -> str:
    """Return the one spelling used for `unit`: "m/s²" -> "m/s^2", "dps" -> "deg/s", "G" -> "gauss".

    Raises UnitError naming the unit, with a near one suggested, where it is unknown.
    """
    text = _plain(unit)
    if text in _CANONICAL:
        return _CANONICAL[text]
    if text.lower() in _ANY_CASE:
        return _ANY_CASE[text.lower()]
    _size(text, unit)  # raises where a part of it is unknown
    spelled = "".join(_spelled(text, unit))
    return _CANONICAL.get(spelled, spelled)


def known(unit: str) -> bool:
    """Tell whether `unit` can be read at all (pint is asked about names not in the table)."""
    try:
        canonical(unit)
    except UnitError:
        return False
    return True


def familiar(unit: str) -> bool:
    """Tell whether `unit` is made of table names only: safe to guess from a header's last word.

    pint knows so many short names ("a" is an are or a year) that it must not be asked here.
    """
    try:
        tokens = list(_tokens(_plain(unit), unit))
    except UnitError:
        return False
    names = [value for kind, value in tokens if kind == "name" and value != "sqrt"]
    whole = _plain(unit)
    if whole in _CANONICAL or whole.lower() in _ANY_CASE:
        return True
    return bool(names) and all(_table_name(name) is not None for name in names) and known(unit)


def conversion(from_unit: str, to_unit: str) -> tuple[float, float]:
    """Return (factor, offset) such that new = factor * old + offset.

    The offset is zero except between temperatures. Raises UnitError where the dimensions differ.
    """
    old_name, new_name = canonical(from_unit), canonical(to_unit)
    if old_name == new_name:
        return 1.0, 0.0
    old, new = _size(old_name, from_unit), _size(new_name, to_unit)
    if new.dimension == _MASS.dimension and old_name in _GRAMS:
        old = _GRAMS[old_name]  # an acceleration to most, but not where a mass is wanted
    if old.dimension != new.dimension:
        raise UnitError(f"{old_name} does not convert to {new_name}: {_why(old, new)}")
    return old.factor / new.factor, (old.offset - new.offset) / new.factor


def size(unit: str) -> tuple[float, Dimension]:
    """Return the factor to SI base units and the powers of these: "cm" -> (0.01, (("m", 1),)).

    Angle (rad) and count are bases of their own. Raises UnitError where the unit is unknown.
    """
    found = _size(canonical(unit), unit)
    return found.factor, found.dimension


def zero_point(unit: str) -> float:
    """Return where the zero of a unit lies in SI: 273.15 for degC, 0 for all but temperatures."""
    return _size(canonical(unit), unit).offset


def quotient(a: str, b: str) -> str:
    """Return the unit of a / b in readable form: "1/count", "1", "(m/s^2)/count"."""
    if b == "1":
        return a
    if a == b:
        return "1"
    head, tail = _split_quotient(a)
    if tail is not None and head == b:  # (b/c)/b
        return quotient("1", tail)
    head, tail = _split_quotient(b)
    if tail is not None and head == a:  # a/(a/c)
        return tail
    if tail is not None and head == "1":  # a/(1/c)
        return product(a, tail)
    return f"{_wrapped(a)}/{_wrapped(b)}"


def product(a: str, b: str) -> str:
    """Return the unit of a * b in readable form; what cancels is cancelled."""
    if a == "1":
        return b
    if b == "1":
        return a
    for one, other in ((a, b), (b, a)):
        head, tail = _split_quotient(one)
        if tail == other:  # (c/b) * b
            return head
        if tail is not None and head == "1":  # (1/c) * b
            return quotient(other, tail)
    return f"{_wrapped(a)}^2" if a == b else f"{_wrapped(a)}*{_wrapped(b)}"


def parse_quantity(text: str) -> tuple[float, str | None]:
    """Split "28 cm" into (28.0, "cm"); a bare number has unit None.

    Raises UsageError where there is no number, UnitError where the unit is unknown.
    """
    found = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", text)
    if found is None:
        raise UsageError(f"'{text}' is not a number with a unit; write it as 0.28 or '28 cm'")
    number, unit = found.groups()
    return float(number), canonical(unit) if unit else None


def _plain(unit: str) -> str:
    """ASCII, without blanks at the ends, powers as ^n, products as *."""
    text = re.sub("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda m: "^" + m[0].translate(_SUPERSCRIPT), unit.strip())
    for sign, plain in _SIGNS:
        text = text.replace(sign, plain)
    for sign in _PRODUCT_SIGNS:
        text = text.replace(sign, "*")
    text = text.replace("**", "^")
    text = re.sub(r"√\(?(\w+)\)?", r"sqrt(\1)", text)
    text = re.sub(r"(?<=[A-Za-z0-9])\.(?=[A-Za-z])", "*", text)  # m.s^-2
    text = re.sub(r"(?<=[A-Za-z])(?=-\d)", "^", text)  # rad s-1
    return re.sub(r"\s*([*/^])\s*", r"\1", text) or "1"


def _tokens(text: str, unit: str) -> Iterator[tuple[str, str]]:
    at = 0
    while at < len(text):
        found = _TOKEN.match(text, at)
        if found is None:
            raise _unknown(unit)
        yield str(found.lastgroup), str(found[str(found.lastgroup)])
        at = found.end()


def _table_name(name: str) -> tuple[str, int] | None:
    """Return the canonical name and power of one word: "sec" -> ("s", 1), "s2" -> ("s", 2)."""
    if name in _CANONICAL:
        return _CANONICAL[name], 1
    if name.lower() in _ANY_CASE:
        return _ANY_CASE[name.lower()], 1
    if name[-1].isdigit() and name[:-1] in _CANONICAL:
        return _CANONICAL[name[:-1]], int(name[-1])
    return None


def _spelled(text: str, unit: str) -> Iterator[str]:
    """Yield the tokens of `text` with every name in its canonical spelling."""
    before = ""
    for kind, value in _tokens(text, unit):
        if before in ("name", "number", ")") and (kind == "name" or value == "("):
            yield "*"  # "m s^-2"
        if kind == "name" and value != "sqrt":
            name, power = _table_name(value) or (value, 1)
            name = f"({name})" if "/" in name else name
            yield name if power == 1 else f"{name}^{power}"
        else:
            yield value
        before = "" if value == "sqrt" else value if kind == "sign" else kind


def _size(text: str, unit: str) -> _Size:
    """Return the SI size of an expression of units."""
    tokens = list(_tokens(text, unit))
    if len(tokens) == 1 and tokens[0][0] == "name":
        return _atom(tokens[0][1], unit)  # a lone temperature keeps its offset
    size, rest = _expression(tokens, unit)
    if rest:
        raise _unknown(unit)
    return size


def _expression(tokens: list[tuple[str, str]], unit: str) -> tuple[_Size, list[tuple[str, str]]]:
    size, tokens = _power(tokens, unit)
    while tokens and tokens[0] != ("sign", ")"):
        divide = tokens[0] == ("sign", "/")
        if tokens[0][0] == "sign" and tokens[0][1] in "*/":
            tokens = tokens[1:]
        other, tokens = _power(tokens, unit)
        size = _times(size, other, Fraction(-1 if divide else 1))
    return size, tokens


def _power(tokens: list[tuple[str, str]], unit: str) -> tuple[_Size, list[tuple[str, str]]]:
    size, tokens = _operand(tokens, unit)
    if tokens[:1] == [("sign", "^")]:
        if len(tokens) < 2 or tokens[1][0] != "number":
            raise _unknown(unit)
        size = _times(_si(1.0), size, Fraction(tokens[1][1]))
        tokens = tokens[2:]
    return size, tokens


def _operand(tokens: list[tuple[str, str]], unit: str) -> tuple[_Size, list[tuple[str, str]]]:
    if not tokens:
        raise _unknown(unit)
    (kind, value), rest = tokens[0], tokens[1:]
    if kind == "number" and float(value) == 1.0:
        return _si(1.0), rest
    if kind == "name" and value == "sqrt":
        size, rest = _operand(rest, unit)
        return _times(_si(1.0), size, Fraction(1, 2)), rest
    if kind == "name":
        return _times(_si(1.0), _atom(value, unit), Fraction(1)), rest
    if value == "(":
        size, rest = _expression(rest, unit)
        if rest[:1] == [("sign", ")")]:
            return size, rest[1:]
    raise _unknown(unit)


def _times(a: _Size, b: _Size, power: Fraction) -> _Size:
    """Return a * b^power; an offset has no meaning inside a product and goes."""
    powers = dict(a.dimension)
    for base, exponent in b.dimension:
        powers[base] = powers.get(base, Fraction(0)) + exponent * power
    dimension = tuple(sorted((base, p) for base, p in powers.items() if p))
    return _Size(a.factor * b.factor ** float(power), dimension)


def _atom(name: str, unit: str) -> _Size:
    found = _table_name(name)
    if found is None:
        return _from_pint(name, unit)
    canonical_name, power = found
    if canonical_name in _ATOMS:
        size = _ATOMS[canonical_name]
        return size if power == 1 else _times(_si(1.0), size, Fraction(power))
    return _times(_si(1.0), _size(canonical_name, unit), Fraction(power))


_PINT_BASES = {
    "[length]": "m",
    "[time]": "s",
    "[mass]": "kg",
    "[current]": "A",
    "[temperature]": "K",
    "[substance]": "mol",
    "[luminosity]": "cd",
}


@functools.cache
def _from_pint(name: str, unit: str) -> _Size:
    import pint  # slow to load, hence only here

    registry = _registry()
    try:
        one = registry.Quantity(1.0, name).to_base_units()
        zero = registry.Quantity(0.0, name).to_base_units()
    except (pint.PintError, AttributeError, ValueError, AssertionError, TypeError):
        raise _unknown(unit) from None
    powers = {str(k): Fraction(v).limit_denominator(100) for k, v in one.dimensionality.items()}
    if not set(powers) <= set(_PINT_BASES):
        raise _unknown(unit)
    dimension = tuple(sorted((_PINT_BASES[base], power) for base, power in powers.items()))
    factor = float(one.magnitude - zero.magnitude)
    return _Size(factor, dimension, float(zero.magnitude))


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def _unknown(unit: str) -> UnitError:
    near = difflib.get_close_matches(unit.strip(), list(_CANONICAL), n=1)
    hint = f"did you mean '{near[0]}'?" if near else "write it like m/s^2, g, deg/s, uT or count"
    return UnitError(f"unknown unit '{unit.strip()}': {hint}")


_MEANING = {
    _ATOMS[unit].dimension: meaning
    for unit, meaning in {
        "1": "a pure number",
        "count": "a raw count",
        "s": "a time",
        "Hz": "a frequency",
        "m": "a length",
        "g": "an acceleration",
        "rad": "an angle",
        "rpm": "an angular rate",
        "T": "a magnetic field",
        "K": "a temperature",
        "Pa": "a pressure",
        "V": "a voltage",
    }.items()
}


def _why(old: _Size, new: _Size) -> str:
    def said(size: _Size) -> str:
        powers = (b if p == 1 else f"{b}^{p}" for b, p in size.dimension)
        return _MEANING.get(size.dimension, "*".join(powers))

    return f"one is {said(old)}, the other {said(new)}"


def _wrapped(unit: str) -> str:
    return f"({unit})" if re.search(r"[*/]", unit) else unit


def _unwrapped(unit: str) -> str:
    if not (unit.startswith("(") and unit.endswith(")")):
        return unit
    inner = unit[1:-1]
    return inner if inner.count("(") == inner.count(")") and _closes_last(unit) else unit


def _closes_last(unit: str) -> bool:
    depth = 0
    for at, sign in enumerate(unit):
        depth += (sign == "(") - (sign == ")")
        if depth == 0:
            return at == len(unit) - 1
    return False


def _split_quotient(unit: str) -> tuple[str, str | None]:
    """Split at the last "/" outside brackets: "(m/s^2)/count" -> ("m/s^2", "count")."""
    depth = 0
    for at in range(len(unit) - 1, -1, -1):
        depth += (unit[at] == ")") - (unit[at] == "(")
        if depth == 0 and unit[at] == "/":
            return _unwrapped(unit[:at]), _unwrapped(unit[at + 1 :])
    return unit, None
