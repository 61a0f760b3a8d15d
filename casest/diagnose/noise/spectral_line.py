"""Lines in the residual's spectrum: one frequency that stands out of its neighbourhood.

The neighbourhood is the noise's own colour, so that only what is narrow counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.noise.noise_model import MIDDLE

#: Samples of a run from which on it has a spectrum, and of the longest one.
ENOUGH, LONGEST = 256, 1 << 18
#: Frequencies on either side that the level is taken from, and those next to a line that are not.
WIDE, NEXT = 40, 2
#: Of a frequency where time stamps lie on no grid.
UNEVEN = "cycles per sample (the stamps of time are uneven)"


@dataclass(frozen=True)
class Line:
    """The strongest line: frequency (Hz; per sample where time is uneven), p-value over all, its
    share of the squares."""

    frequency: float
    unit: str
    p_value: float
    share: float


def strongest_line(runs: Sequence[Run], residuals: Sequence[Array]) -> Line | None:
    """The most significant line of all runs; None where none is a series without gaps."""
    found = [
        line for run, r in zip(runs, residuals, strict=True) if (line := _line(run, r)) is not None
    ]
    if not found:
        return None
    best = min(found, key=lambda line: line.p_value)
    return replace(best, p_value=min(1.0, best.p_value * len(found)))


def _line(run: Run, r: Array) -> Line | None:
    if run.spread or len(r) < ENOUGH or run.time is None:
        return None
    step, unit = float(np.median(np.diff(run.time))), "Hz"
    if not step > 0:
        return None
    place = np.round((run.time - run.time[0]) / step).astype(int)
    if np.any(np.diff(place) < 1) or place[-1] + 1 > 1.1 * len(r):
        # Stamps that come in bursts say when a buffer was emptied: the samples may be even.
        step, unit, place = 1.0, UNEVEN, np.arange(len(r))
    length = int(place[-1]) + 1
    if length > LONGEST:
        return None
    even = np.zeros((length, r.shape[1]))
    even[place] = r
    power = np.sum(np.abs(np.fft.rfft(even, axis=0)) ** 2, axis=1)[1:-1]
    p, k, share = _most_significant(power, r.shape[1])
    return Line((k + 1) / (length * step), unit, p, share)


def _most_significant(power: Array, axes: int) -> tuple[float, int, float]:
    """Bonferroni's p-value, the place of the line that stands out most, and its share.

    The level is the mean of as many frequencies on the left as on the right: slopes cancel.
    """
    from scipy.special import fdtrc

    n = len(power)
    k = np.arange(MIDDLE, n - MIDDLE)
    if not len(k):
        return 1.0, 0, 0.0
    width = np.minimum(WIDE, np.minimum(k, n - 1 - k))
    total = np.concatenate([[0.0], np.cumsum(power)])
    around = total[k + width + 1] - total[k - width]
    inner = total[k + NEXT + 1] - total[k - NEXT]
    count = 2 * (width - NEXT)
    level = (around - inner) / count
    p = fdtrc(2 * axes, 2 * axes * count, power[k] / level)
    best = int(np.argmin(p))
    share = (inner[best] - (2 * NEXT + 1) * level[best]) / max(float(total[-1]), 1e-300)
    return min(1.0, float(p[best]) * len(k)), int(k[best]), float(np.clip(share, 0.0, 1.0))
