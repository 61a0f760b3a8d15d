"""Numbers beside their standard deviation, as text and page write them."""

from __future__ import annotations

import numpy as np


def rounded(value: float, std: float, missing: str = "not determined") -> tuple[str, str]:
    """Value and standard deviation to two digits of the latter, as a metrologist writes them.

    `missing` stands for a standard deviation that is not finite; the value then has no digits.
    """
    if not np.isfinite(std):
        return "–", missing
    if std <= 1e-15 * abs(value):  # below what a double holds
        return f"{value:.9g}", f"{std:.1g}"
    std = two_digits(std)
    digits = 1 - int(np.floor(np.log10(std)))
    if -6 <= digits <= 9 and abs(value) < 1e7:
        places = max(digits, 0)
        return f"{value:z.{places}f}", f"{std:.{places}f}"  # no -0.00
    exponent = int(np.floor(np.log10(max(abs(value), std))))
    places = max(exponent + digits, 0)
    return f"{value:.{places}e}", f"{std:.1e}"


def percent(share: float) -> str:
    """A share to two digits, or to whole percents: "0.75 %", "66 %", "100 %"."""
    number = 100 * share
    return f"{number:.0f} %" if abs(number) >= 9.95 else f"{number:.2g} %"


def two_digits(std: float) -> float:
    """0.000996 is 0.0010, not 0.00100."""
    return float(f"{std:.1e}")
