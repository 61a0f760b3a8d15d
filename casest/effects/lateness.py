"""By how much one recorded signal follows another, roughly: where a fit of the lag begins.

Axes, gains and offsets are unknown then, so what is compared is how fast each changes, in whatever
direction: the lag at which the two go together best.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.data.curves import Curve
from casest.data.run import Run, Series
from casest.declaration.shapes import Array

#: Most steps of the grid on which lags are tried.
GRID = 2**16
#: Part of the shorter record by which one may be late.
FARTHEST = 0.5
#: Two signals go together where the correlation of how lively they are is this; else 0 is as good.
TOGETHER = 0.3


def likely_lag(
    runs: Sequence[Run], measured: str, name: str, *, within: bool = False, rotation: bool = False
) -> float:
    """Time in s by which the signal `measured` follows `name` of another file; 0 if untold.

    With `within` also one of the same file, which is a `rotation` or not, where the two are lively
    together: a load and a thermometer are not. Of several runs that of the longest is taken.
    """
    told = [run for run in runs if name in run.elsewhere or (within and name in run.signals)]
    told = [run for run in told if run.time is not None and len(run) > 3]
    if not told:
        return 0.0
    run = max(told, key=lambda r: float(np.ptp(np.asarray(r.time))))
    assert run.time is not None
    other = run.elsewhere.get(name) or Series(
        file=run.file, time=run.time, values=run.signals[name], block=run.block, rotation=rotation
    )
    step = max(float(np.median(np.diff(run.time))), float(np.ptp(run.time)) / GRID)
    mine = Curve.through(run.time, run.signals[measured], run.block)
    its = Curve.through(other.time, other.values, other.block, rotation=other.rotation)
    first = min(run.time[0], other.time[0])
    grid = np.arange(first, max(run.time[-1], other.time[-1]), step)
    a, b = (_liveliness(curve, grid) for curve in (mine, its))
    longest = int(FARTHEST * min(np.ptp(run.time), np.ptp(other.time)) / step)
    size = 2 * len(grid)
    product = np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size))
    together = np.fft.irfft(product, size)
    lags = np.arange(-longest, longest + 1)
    best = lags[np.argmax(together[lags])]
    alone = np.linalg.norm(a) * np.linalg.norm(b)
    if name not in run.elsewhere and together[best] < TOGETHER * alone:
        return 0.0
    return float(step * best)


def _liveliness(curve: Curve, grid: Array) -> Array:
    """How fast a signal changes at each time, about its mean; nothing where nobody recorded."""
    there = curve.covers(grid)
    rate = np.linalg.norm(curve.at(grid, curve.nearest(grid))[1], axis=1)
    return np.where(there, rate - rate[there].mean(), 0.0)
