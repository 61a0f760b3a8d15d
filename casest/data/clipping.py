"""Readings at the end of their range: there what is measured is lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Array

#: Equal readings in a row, at the largest or least of a record, that noise does not leave.
IN_A_ROW = 3


def at_full_scale(values: Array) -> NDArray[np.bool_]:
    """Which samples (N,) of a record (N, k) are at the end of a range: its extreme, in a row."""
    found = np.zeros(len(values), dtype=np.bool_)
    for column in values.T:
        for extreme in (column.max(initial=-np.inf), column.min(initial=np.inf)):
            found |= _in_a_row(column == extreme)
    return found


def _in_a_row(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The same, without what is there less than IN_A_ROW times in a row."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(np.int8)))
    kept = np.zeros_like(mask)
    for first, end in edges.reshape(-1, 2):
        kept[first:end] = end - first >= IN_A_ROW
    return kept
