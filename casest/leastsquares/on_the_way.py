"""A vector on the way from one rest to the next, in the frame of the rest before, and its mean.

What the body sees as x, at an attitude A against that rest, is A·x there. The specific force's
mean is the force at rest, for the body has no velocity at either end, however it was moved.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.leastsquares.turns import skew, steps


def means_on_the_way(
    values: Array, slopes: Array, time: Array, spans: NDArray[np.int_]
) -> tuple[Array, Array]:
    """Mean over each span (K, 3), and its slopes (K, 3, n).

    values (M, 6): a rate in rad/s and a vector, in the body's frame, at `time` (M,) s; slopes
    (M, 6, n) of them; spans (K, 2): first and last of the samples of each, one after the other. By
    trapezoids; rotations as they are, of the order of `turns`.
    """
    h, turn, before, after = steps(values[:, :3], time)
    begin, end = spans.T
    h[end[:-1]] = 0.0  # from one span to the next there is no way
    own = np.repeat(np.arange(len(spans)), end - begin + 1)
    attitude = _attitudes(turn, begin, end)
    weight = 0.5 * (np.append(h, 0.0) + np.append(0.0, h)) / (time[end] - time[begin])[own]
    shares = weight[:, None, None] * attitude
    seen = (shares @ values[:, 3:, None])[:, :, 0]
    mean = np.add.reduceat(seen, begin)
    # What a small rotation in one step moves is all that is seen after it.
    total = np.cumsum(seen, axis=0)
    later = (mean + total[begin] - seen[begin])[own] - total
    through = -skew(later[:-1]) @ attitude[1:] * (h > 0)[:, None, None]
    moving = np.zeros((len(values), 3, 6))
    moving[:-1, :, :3] += through @ before
    moving[1:, :, :3] += through @ after
    moving[:, :, 3:] = shares
    flat, columns = (
        moving.transpose(1, 0, 2).reshape(3, -1),
        slopes.reshape(6 * len(values), slopes.shape[2]),
    )
    each = [flat[:, 6 * a : 6 * b + 6] @ columns[6 * a : 6 * b + 6] for a, b in spans]
    return mean, np.array(each)


def _attitudes(turn: Array, begin: NDArray[np.int_], end: NDArray[np.int_]) -> Array:
    """Attitude (M, 3, 3) of every sample against the first of its span."""
    found = np.empty((len(turn) + 1, 3, 3))
    found[begin] = np.eye(3)
    for k in range(1, int(np.max(end - begin)) + 1):
        at = begin[begin + k <= end] + k
        found[at] = found[at - 1] @ turn[at - 1]
    return found
