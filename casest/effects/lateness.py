"""By how much one recorded signal follows another, roughly: where a fit of the lag begins.

Axes, gains and offsets are unknown then, so what is compared is how fast each changes, in whatever
direction: the lag at which the two go together best, at the pace at which they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.curves import Curve
from casest.data.run import Run, Series
from casest.declaration.shapes import Array

#: Most steps of the grid on which lags are tried.
GRID = 2**16
#: Part of the shorter record by which one may be late.
FARTHEST = 0.5
#: Two signals go together where the correlation of how lively they are is this; else 0 is as good.
TOGETHER = 0.3
#: Steps over which a change is averaged: from sample to sample a noisy signal is lively by its
#: noise.
WIDTHS = (1, 4, 16, 64)
#: Parts of a step between which it is seen how alike they are: tops lie between steps.
FINER = 4
#: Standard errors of such a correlation that chance does not reach, of means of independent steps.
SEEN = 4.0
#: Of a signal with itself so much later: more is once more the same, as a wave's next period.
SAME = 0.9


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
    longest = int(FARTHEST * min(np.ptp(run.time), np.ptp(other.time)) / step)
    rates = [_rate(curve, grid) for curve in (mine, its)]
    best, most = 0.0, -np.inf
    for width in WIDTHS:
        lag, alike = _together(rates, width, longest)
        enough = SEEN * np.sqrt(2 * width / len(grid)) if width > 1 else 0.0
        if alike > max(most, enough):
            best, most = lag, alike
    if name not in run.elsewhere and most < TOGETHER:
        return 0.0
    return float(step * best)


def comes_again(runs: Sequence[Run], name: str, *, rotation: bool = False) -> float:
    """Time in s after which a recorded signal is the same once more; inf of what never is.

    By how much a steady wave is late can be told up to whole periods of it. Of several runs the
    longest is asked.
    """
    told = [r for r in runs if r.time is not None and len(r) > 3 and name in r.signals]
    if not told:
        return np.inf
    run = max(told, key=lambda r: float(np.ptp(np.asarray(r.time))))
    assert run.time is not None
    step = max(float(np.median(np.diff(run.time))), float(np.ptp(run.time)) / GRID)
    curve = Curve.through(run.time, run.signals[name], run.block, rotation=rotation)
    grid = np.arange(run.time[0], run.time[-1], step)
    there = curve.covers(grid)
    values = curve.at(grid, curve.nearest(grid))[0]
    values = np.where(there[:, None], values - values[there].mean(axis=0), 0.0)

    def with_itself(x: Array) -> Array:
        power = np.abs(np.fft.rfft(x, 2 * len(x), axis=0)) ** 2
        return np.asarray(np.fft.irfft(power, axis=0)[: int(FARTHEST * len(x))].sum(axis=1))

    pairs = with_itself(there[:, None].astype(float))
    alike = with_itself(values) / np.maximum(pairs, 1.0)
    away = np.flatnonzero(alike < 0.0)
    back = np.flatnonzero(alike[away[0] :] > SAME * alike[0]) if len(away) else away
    if not len(back):
        return np.inf
    first = int(away[0] + back[0])
    top = alike[first : first + int(away[0]) + 1]
    return float(step * (first + np.argmax(top)))


def _together(rates: Sequence[tuple[Array, NDArray[np.bool_]]], width: int, longest: int) -> Any:
    """The lag in steps at which two signals are lively together, and their correlation there."""
    a, b = (_liveliness(rate, there, width) for rate, there in rates)
    size = 2 * len(a)
    product = np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size))
    together = FINER * np.fft.irfft(product, FINER * size)
    lags = np.arange(-longest * FINER, longest * FINER + 1)
    alone = max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    alike = together[lags] / alone
    # Of what comes again and again the nearest: periods later it is as alike but for chance.
    top = np.append(alike[:-1] >= alike[1:], True) & np.append(True, alike[1:] >= alike[:-1])
    top &= alike >= alike.max() - np.sqrt(2 * width / len(a))
    best = int(min(lags[top], key=abs))
    return best / FINER, float(together[best]) / alone


def _rate(curve: Curve, grid: Array) -> tuple[Array, NDArray[np.bool_]]:
    """How a signal changes at each time (N, k); nothing where nobody recorded (N,)."""
    there = curve.covers(grid)
    rate = curve.at(grid, curve.nearest(grid))[1]
    return np.where(there[:, None], rate, 0.0), there


def _liveliness(rate: Array, there: NDArray[np.bool_], width: int) -> Array:
    """How fast it changes from one mean of so many steps to the next, about its mean."""
    from scipy.ndimage import uniform_filter1d

    smooth = rate if width == 1 else uniform_filter1d(rate, width, axis=0, mode="constant")
    length = np.linalg.norm(smooth, axis=1)
    return np.where(there, length - length[there].mean(), 0.0)
