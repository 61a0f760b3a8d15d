"""Columns that were computed from a reading and another column: its error, a quotient, a product.

A table of a calibration often has its errors beside it, absolute or relative, each to so many
digits; a log of a motor its torque over its current. They follow the residual better than any
influence does.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from casest.data.stillness import last_decimal
from casest.declaration.shapes import Array

#: Rows at least, and steps of its digits that a column must vary by (standard deviation).
FEWEST, STEPS = 5, 3.0
#: Rows that tell whether a column is a quotient, and those of them that must be, to what share.
ROWS, NEARLY_ALL, EXACT = 400, 0.95, 1e-3


def is_error(x: Array, reading: Array, given: Array) -> bool:
    """Is a column (N,) reading − given, or that in parts or percent of either, to its digits?

    Of either sign, or without one. What moves a reading is in no fixed proportion to the error, and
    is not nought where that is.
    """
    there = np.isfinite(x) & np.isfinite(reading) & np.isfinite(given)
    x, reading, given = x[there], reading[there], given[there]
    if len(x) < FEWEST or not np.any(x):
        return False
    error = reading - given
    digits = last_decimal(reading) + last_decimal(given)
    for of, size in product((np.ones_like(x), reading, given), (1.0, 100.0)):
        if not np.all(of) or (size == 100.0 and np.ptp(of) == 0):
            continue
        candidate, off = size * error / of, 1.01 * (last_decimal(x) + size * digits / np.abs(of))
        if np.std(x) < STEPS * np.median(off):
            continue
        if any(np.all(np.abs(x - c) <= off) for c in (candidate, -candidate, np.abs(candidate))):
            return True
    return False


def is_quotient(x: Array, reading: Array, other: Array) -> bool:
    """Is a column (N,) the reading over, or times, another column, up to a factor?

    To a part in a thousand or its digits, where neither is nought. No influence goes with both so
    closely: each was measured with a noise of its own.
    """
    rows = slice(None, None, -(-len(x) // ROWS) or 1)
    x, reading, other = x[rows], reading[rows], other[rows]
    there = np.isfinite(x) & np.isfinite(reading) & np.isfinite(other) & (x != 0)
    there &= (reading != 0) & (np.abs(other) > EXACT * np.abs(other).max(initial=0.0))
    x, reading, other = x[there], reading[there], other[there]
    if len(x) < FEWEST or np.ptp(other) < 0.1 * np.abs(other).max():
        return False
    off = EXACT * np.abs(x) + 0.51 * last_decimal(x)
    if np.std(x) < STEPS * np.median(off):
        return False
    for made in (reading / other, reading * other):
        factor = np.median(x / made)
        if np.mean(np.abs(x - factor * made) <= off) >= NEARLY_ALL:
            return True
    return False
