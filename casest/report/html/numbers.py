"""Numbers and units as a person reads them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def printed_unit(unit: str) -> str:
    """The unit with raised powers: m/s^2 as m/s²."""
    text = re.sub(r"\^(?:\((-?\d+)\)|(-?\d+))", lambda m: (m[1] or m[2]).translate(_RAISED), unit)
    text = re.sub(r"\((\([^()]*\))\)", r"\1", text)
    text = re.sub(r"^\(([^()]*)\)$", r"\1", text)
    return text.replace("*", "·").replace("degC", "°C")


def in_words(text: str) -> str:
    """A sentence whose numbers and units are printed as those of tables: 2.2e-07 1/s^2."""
    powers = re.sub(r"-?\d+(?:\.\d+)?e[-+]\d+", lambda m: printed(m[0]), text)
    return printed_unit(powers)


def printed(text: str) -> str:
    """A number's text with a true minus sign and powers of ten: -3.2e-07 as −3.2·10⁻⁷."""
    power = re.fullmatch(r"([-+\d.]+)e([-+]\d+)", text)
    if power:
        text = f"{power[1]}·10{str(int(power[2])).translate(_RAISED)}"
    return text.replace("-", "−")


def number(value: float | None, digits: int = 3) -> str:
    """A number to some digits; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    return printed(f"{value:.{digits}g}")


def two_digits(value: float | None) -> str:
    """A standard deviation: 0.001 is 0.0010."""
    if value is None or not math.isfinite(value):
        return "–"
    return printed(f"{value:#.2g}" if 0 < abs(value) < 9.95 else f"{value:.2g}")


def with_unit(value: float | None, unit: str, digits: int = 3) -> str:
    """A number with its unit."""
    return f"{number(value, digits)} {printed_unit(unit)}".removesuffix(" 1").strip()


def alike(values: Sequence[float | None], digits: int = 5) -> list[str]:
    """Numbers of one column with as many decimals each: the largest has so many digits."""
    there = [v for v in values if v is not None and math.isfinite(v)]
    largest = max(map(abs, there), default=0.0)
    if not largest or not 1e-6 < largest < 1e9:
        return [number(v, digits) for v in values]
    places = max(digits - 1 - math.floor(math.log10(largest)), 0)
    return [printed(f"{v:.{places}f}") if v in there else "–" for v in values]
