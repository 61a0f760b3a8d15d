"""Where the noise is louder than elsewhere: in bursts, while something shakes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS


def louder(residual: Array, spans: Sequence[slice]) -> Array:
    """Size of the noise at each row (N,) in that of most of the record; 1 where it is like it.

    By third differences, in which a misfit that follows a motion has no part, over blocks of rows;
    only what is plainly louder than three quarters of them counts: what more of a record does is no
    burst, but how the sensor is used. `spans`: stretches of evenly spaced rows.
    """
    found = np.ones(len(residual))
    blocks = [block for span in spans for block in _blocks(span)]
    sizes = np.array([_size(residual[block]) for block in blocks])
    if not len(sizes):
        return found
    usual = np.quantile(sizes, 0.75, axis=0)
    if not np.all(usual > 0):
        return found
    for block, size in zip(blocks, np.mean(sizes / usual, axis=1), strict=True):
        if size > LEVELS.louder:
            found[block] = size
    return found


def _blocks(span: slice) -> list[slice]:
    count = max(1, (span.stop - span.start) // LEVELS.block)
    edges = np.linspace(span.start, span.stop, count + 1).astype(int)
    return [slice(a, b) for a, b in pairwise(edges) if b - a > 6]


def _size(residual: Array) -> Array:
    """Median third difference (m,)."""
    return np.asarray(np.median(np.abs(np.diff(residual, 3, axis=0)), axis=0))
