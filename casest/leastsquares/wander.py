"""A reading's offset that wanders: a random walk, seen as its means over rests and turns.

B(t) with independent increments of variance t: the mean over [s, e] has the variance s + (e − s)/3,
and with the mean over any later interval the covariance (s + e)/2. Counted from its mean over the
rests, so that the offset that is fitted is that of the whole record.
"""

from __future__ import annotations

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array


def wandering(run: Run) -> Array:
    """Covariance (2N, 2N) of a walk's means over N rests, then over the turn before each.

    Per unit of intensity, in seconds; of the first rest's turn, which there is none of, zero.
    """
    assert run.averaged is not None
    assert run.averaged.run.time is not None
    time = np.asarray(run.averaged.run.time, float)
    first, last = time[run.averaged.first], time[run.averaged.last]
    begin = np.concatenate([first, first[:1], last[:-1]]) - first[0]
    end = np.concatenate([last, first]) - first[0]
    end[len(first)] = 0.0
    middle = 0.5 * (begin + end)
    found = np.minimum(middle[:, None], middle)
    np.fill_diagonal(found, begin + (end - begin) / 3)
    centred = np.eye(len(found))
    centred[:, : len(first)] -= 1 / len(first)
    return np.asarray(centred @ found @ centred.T)
