"""Columns that hold the error of a reading: what a sheet computed from it and the reference.

A table of a calibration often has its errors beside it, absolute or relative, each to so many
digits. They follow the residual better than any influence does.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from casest.data.stillness import last_decimal
from casest.declaration.shapes import Array

#: Rows at least, and steps of its digits that a column must vary by (standard deviation).
FEWEST, STEPS = 5, 3.0


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
