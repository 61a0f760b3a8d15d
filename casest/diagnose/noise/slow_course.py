"""A slow course in the residual: what a plot shows at once, and no colour of noise explains.

Colour is kinship of near neighbours: noise that remembers as exp(−k/MEMORY), or less, is nearly as
strong at any period beyond SLOW samples as at those from FAST to SLOW. A smooth wave, a lag, an
offset that wanders are far stronger at the slow ones. The colour is not estimated: estimated from
a residual with a wave in it, it would explain the wave. A record must be FEWEST such periods long:
of a shorter one all three are less, in proportion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.estimate.correlation import is_series

#: Periods in samples from which on a course is slow, and that it is compared with.
SLOW, FAST = 60, 12
#: Slow periods in a record at least.
FEWEST = 4
#: Memory in samples of the longest colour that is no slow course (0.82 between neighbours).
MEMORY = 5
#: Power of such noise at the slowest over that at periods from FAST to SLOW:
#: ω is 2π·MEMORY/period, and the power 1/(1 + ω²).
_EDGES = 2 * np.pi * MEMORY / np.array([SLOW, FAST])
COLOUR = float(np.diff(_EDGES)[0] / np.diff(np.arctan(_EDGES))[0])
#: What is less likely nobody can tell from zero.
LEAST_CHANCE = 1e-16


@dataclass(frozen=True)
class SlowCourse:
    """share: of the residual's variance; samples: about those from a high to the next low of it.

    p_value: chance of as much in coloured noise, all octaves and axes counted; axis: its number.
    """

    share: float
    samples: int
    p_value: float
    axis: int


def slow_course(runs: Sequence[Run], residuals: Sequence[Array]) -> SlowCourse | None:
    """The most significant slow course of any axis; None where there are too few samples.

    Of several runs those count that are series of single readings.
    """
    series = [
        r for run, r in zip(runs, residuals, strict=True) if is_series(run) and not run.spread
    ]
    if not series:
        return None
    frequency = np.concatenate([np.arange(1, len(r)) / (2 * len(r)) for r in series])
    power = np.concatenate([_power(r) for r in series])
    slow = min(1.0, max(map(len, series)) / (FEWEST * SLOW)) * SLOW
    found = [_of_axis(frequency, power, a, slow) for a in range(power.shape[1])]
    large = [f for f in found if f.share >= LEVELS.share]
    return min(large or found, key=lambda f: (f.p_value, -f.share))


def slow_squares(runs: Sequence[Run], residuals: Sequence[Array]) -> float:
    """Mean square (over all axes) of the slow courses that are beyond doubt."""
    total, axes = 0.0, int(residuals[0].shape[1])
    for k in range(axes):
        own = [r[:, [k]] for r in residuals]
        found = slow_course(runs, own)
        if found is not None and found.p_value < LEVELS.misfit:
            total += found.share * float(np.mean(np.concatenate(own) ** 2))
    return total / axes


def _power(r: Array) -> Array:
    """Squares (n − 1, m) of the components along cosines of ½, 1, … periods."""
    mirrored = np.concatenate([r, r[::-1]])
    return np.asarray(np.abs(np.fft.rfft(mirrored, axis=0)[1 : len(r)]) ** 2 / (2 * len(r)))


def _of_axis(frequency: Array, every: Array, axis: int, longest: float) -> SlowCourse:
    """Octaves of the slow periods, of `longest` samples or more, against the fast ones: F tests."""
    from scipy.special import fdtrc

    power, slow = every[:, axis], frequency < 1 / longest
    level = power[~slow & (frequency < SLOW / FAST / longest)]
    least, chance, octaves = float(frequency.min()), 1.0, 0
    while least < 1 / longest:
        own = power[slow & (frequency >= least) & (frequency < 2 * least)]
        if own.size:
            F = own.mean() / max(level.mean(), 1e-300) / COLOUR
            chance = min(chance, float(fdtrc(own.size, level.size, F)))
            octaves += 1
        least *= 2
    share = float(power[slow].sum() - slow.sum() * level.mean()) / max(power.sum(), 1e-300)
    middle = _median(frequency[slow], np.maximum(power[slow] - level.mean(), 0.0))
    chance = min(1.0, max(chance, LEAST_CHANCE) * octaves * every.shape[1])
    return SlowCourse(max(share, 0.0), int(float(f"{0.5 / middle:.2g}")), chance, axis)


def _median(frequency: Array, weight: Array) -> float:
    """The frequency that half of the weight lies below."""
    order = np.argsort(frequency)
    below = np.cumsum(weight[order])
    return float(frequency[order][np.searchsorted(below, below[-1] / 2)])
