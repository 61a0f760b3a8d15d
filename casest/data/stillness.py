"""Where in a raw record the sensor lay still.

The detector is the moving variance of Skog, Händel, Nilsson, Rantakokko, "Zero-velocity detection:
an algorithm evaluation", IEEE T-BME 57(11), 2010 (sec. II-B); intervals are used one mean each as
in Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for IMU calibration without
external equipments", ICRA 2014 (sec. IV). Both compare the variance with a constant or a multiple
of an initial rest; here the noise floor and the thresholds come from the record itself, so that
neither units nor offsets matter and no initial rest is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.data.run import Array, Index
from casest.errors import DataError

WINDOW = 25  # samples, where the rate is unknown
_SHORTEST = 2  # windows in an interval
_FLOOR_QUANTILE = 0.10  # of the windowed variances: rest must make up more of the record than this
_BAND = 6.0  # robust standard deviations of the log variance at rest
_RANGE = 1.5  # largest range of the windowed means inside an interval, in noise sigmas
_DRIFT = 1.0  # largest change along a straight line through them
_KEPT = 0.25  # of the quiet samples must not drift, or nothing is believed
_STEP_WINDOWS = 2  # within so many windows
_STEP = 6.0  # a change of the mean by this many sigmas is another position
_HYSTERESIS = 10.0  # a variance this many times the limit of rest breaks a rest in any case
_NARROWEST = 0.231  # times _BAND: factor 4, between a fixed reading and one that toggles


@dataclass(frozen=True)
class Interval:
    """Samples first..last (both included) of a run, at rest."""

    first: int
    last: int

    def __len__(self) -> int:
        """Return the number of samples."""
        return self.last - self.first + 1

    @property
    def samples(self) -> slice:
        """The interval as an index."""
        return slice(self.first, self.last + 1)


@dataclass(frozen=True)
class Rests:
    """What was found in a record: intervals, and how many quiet stretches drifted."""

    intervals: tuple[Interval, ...]
    shortened: int
    split: int
    dropped: int


def find_rests(
    channels: Array,
    block: Index,
    window: int = WINDOW,
    shortest: int | None = None,
    name: str = "record",
    n_averaged: int | None = None,
) -> Rests:
    """Find the rest intervals of (N, K) channels; an interval never crosses a change of `block`.

    Only the first `n_averaged` channels must keep their mean (a gyro's bias may wander at rest).
    Invariant to scale and offset of each channel. Raises DataError where there is none.
    """
    fewest = shortest or _SHORTEST * window
    stretches = [s for s in _stretches(block) if len(s) >= max(window, fewest)]
    if not stretches:
        raise DataError(
            f"{name}: no stretch of {max(window, fewest)} samples without a gap, too short to look "
            f"for rest; leave --at-rest out if each row is a mean already"
        )
    variance = [_moving_variance(channels[s.samples], window) for s in stretches]
    level = _level(np.concatenate(variance), channels)
    low, high = _thresholds(level)
    candidates: list[Interval] = []
    at = 0
    for stretch in stretches:
        part = level[at : at + len(stretch)]
        candidates += [
            Interval(stretch.first + first, stretch.first + last)
            for first, last in _quiet(part, low, high)
            if last - first + 1 >= fewest
        ]
        at += len(stretch)
    return _without_drift(channels[:, :n_averaged], candidates, window, fewest, name)


def _stretches(block: Index) -> list[Interval]:
    starts = np.flatnonzero(np.r_[True, block[1:] != block[:-1]])
    ends = np.r_[starts[1:], len(block)] - 1
    return [Interval(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def _moving_variance(x: Array, window: int) -> Array:
    """Return the variance in a window centred on each sample, (n, K); at the ends the nearest."""
    sums = np.cumsum(np.vstack([np.zeros(x.shape[1]), x - x.mean(axis=0)]), axis=0)
    squares = np.cumsum(np.vstack([np.zeros(x.shape[1]), (x - x.mean(axis=0)) ** 2]), axis=0)
    mean = (sums[window:] - sums[:-window]) / window
    full = (squares[window:] - squares[:-window]) / window - mean**2
    half = window // 2
    return np.asarray(np.pad(np.maximum(full, 0.0), ((half, half), (0, 0)), mode="edge"))


def resolution(x: Array) -> float:
    """Return the step in which a channel is quantised, 0 where it takes any value."""
    levels = np.unique(x)
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * max(float(np.abs(levels).max()), 1e-100)]
    return float(steps.min()) if steps.size else 0.0


def last_decimal(x: Array) -> float:
    """Return the last decimal place that values (N,) are written to, 0 where they fill them all."""
    size = float(np.abs(x).max(initial=0.0))
    for step in 10.0 ** -np.arange(-3, 10):
        if np.all(np.abs(x - step * np.round(x / step)) <= 1e-9 * size):
            return float(step)
    return 0.0


def _level(variance: Array, channels: Array) -> Array:
    """Return the log of the mean over channels of variance / its own floor, (n,)."""
    variance = variance + _noise_floor(channels) ** 2 / 12  # what a fixed reading may hide
    floor = np.quantile(variance, _FLOOR_QUANTILE, axis=0)
    return np.asarray(np.log((variance / floor).mean(axis=1)))


def _thresholds(level: Array) -> tuple[float, float]:
    """Return (low, high): rest begins and ends below `low` and is broken only above `high`.

    `high` is the valley between rest and motion (Otsu 1979); `low` is the rest mode plus its own
    width, seen from below, where motion adds nothing. Two thresholds, since a knock on the table
    ends no rest while its edges must be clean.
    """
    valley = _otsu(level)
    mode = _mode(level[level <= valley])
    below = mode - level[level <= mode]
    width = max(float(np.median(below)) / 0.6745, _NARROWEST)
    low = min(mode + _BAND * width, max(valley, mode + _BAND * _NARROWEST))
    high = max(mode + _BAND * width, valley)
    return low, min(high, low + float(np.log(_HYSTERESIS)))


def _otsu(level: Array, bins: int = 200) -> float:
    """Return the split of a histogram that maximises the variance between its two parts."""
    if float(np.ptp(level)) < _NARROWEST:
        return float(level.max())  # nothing but rest
    counts, edges = np.histogram(level, bins)
    centres = (edges[1:] + edges[:-1]) / 2
    below = np.cumsum(counts)[:-1]
    above = counts.sum() - below
    sums = np.cumsum(counts * centres)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (sums[:-1] / below - (sums[-1] - sums[:-1]) / above) ** 2
    return float(edges[1 + int(np.nanargmax(between))])


def _mode(values: Array) -> float:
    """Return the half-sample mode (Bickel and Frühwirth 2006)."""
    ordered = np.sort(values)
    while len(ordered) > 3:
        half = (len(ordered) + 1) // 2
        widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
        start = int(np.argmin(widths))
        ordered = ordered[start : start + half]
    return float(ordered.mean())


def _quiet(level: Array, low: float, high: float) -> list[tuple[int, int]]:
    """Return (first, last) of each stretch below `high`, cut back to where it is below `low`."""
    calm = np.r_[False, level < high, False]
    starts = np.flatnonzero(calm[1:] & ~calm[:-1])
    ends = np.flatnonzero(~calm[1:] & calm[:-1])
    found = []
    for start, end in zip(starts, ends, strict=True):
        quiet = np.flatnonzero(level[start:end] < low)
        if quiet.size:
            found.append((int(start + quiet[0]), int(start + quiet[-1])))
    return found


def _without_drift(
    channels: Array, candidates: Sequence[Interval], window: int, fewest: int, name: str
) -> Rests:
    """Keep of each candidate the parts whose windowed mean stays put."""
    noise_floor = _noise_floor(channels)
    kept = [_settled(channels, c, window, fewest, noise_floor) for c in candidates]
    intervals = tuple(part for parts in kept for part in parts)
    dropped = sum(not parts for parts in kept)
    if not intervals:
        drifting = f" ({dropped} quiet stretches drift too much to count)" if dropped else ""
        raise DataError(
            f"{name}: no rest interval of {fewest} samples found{drifting}; hold the sensor still "
            f"for a second or more in each position, or leave --at-rest out"
        )
    _refuse_slow_motion(sum(map(len, intervals)), sum(map(len, candidates)), name)
    lost = [
        len(c) - sum(map(len, parts)) >= window
        for c, parts in zip(candidates, kept, strict=True)
        if len(parts) == 1
    ]
    split = sum(len(parts) > 1 for parts in kept)
    return Rests(intervals, sum(lost), split, dropped)


def _refuse_slow_motion(kept: int, quiet: int, name: str) -> None:
    """Refuse a record whose quiet stretches mostly drift."""
    if kept < _KEPT * quiet:
        raise DataError(
            f"{name}: rest cannot be told from slow motion: the mean stays put in only {kept} of "
            f"{quiet} quiet samples, the noise hides the rest; hold the sensor still for longer in "
            f"each position, or leave --at-rest out"
        )


def _noise_floor(channels: Array) -> Array:
    """Return the smallest noise a channel can show: its resolution, or rounding."""
    steps = [resolution(channels[:, k]) for k in range(channels.shape[1])]
    return np.asarray(np.maximum(steps, 1e-9 * np.ptp(channels, axis=0) + 1e-100))


def _settled(
    channels: Array, interval: Interval, window: int, fewest: int, noise_floor: Array
) -> list[Interval]:
    """Return the parts of `interval` that do not drift, in order of time."""
    x = channels[interval.samples]
    n = len(x) // window
    cut = x[: n * window].reshape(n, window, -1)
    noise = np.maximum(np.sqrt(np.median(cut.var(axis=1), axis=0)), noise_floor)
    parts = []
    means = (cut.mean(axis=1) - x.mean(axis=0)) / noise
    for first, last in _steady_parts(means, -(-fewest // window)):
        end = interval.last if last == n - 1 else interval.first + (last + 1) * window - 1
        parts.append(Interval(interval.first + first * window, end))
    kept = _longest_of_each_pose(x, noise, interval.first, parts, _STEP_WINDOWS * window)
    # a few windows of a slow motion agree by chance
    return kept if sum(map(len, kept)) >= _KEPT * len(interval) else []


def _longest_of_each_pose(
    x: Array, noise: Array, origin: int, parts: Sequence[Interval], step: int
) -> list[Interval]:
    """Keep one part of each position: a new one is reached by a large change within `step`.

    Parts that differ by little, or with a long way between them, are one position that creeps.
    """
    kept: list[Interval] = []
    before, end = None, 0
    for part in sorted(parts, key=lambda part: part.first):
        mean = x[part.first - origin : part.last + 1 - origin].mean(axis=0) / noise
        far = before is None or bool((np.abs(mean - before) > _STEP).any())
        if far and (before is None or part.first - end <= step):
            kept.append(part)
        else:
            kept[-1] = max(kept[-1], part, key=len)
        before, end = mean, part.last
    return kept


def _steady_parts(means: Array, fewest: int) -> list[tuple[int, int]]:
    """Return stretches of windows whose means, in noise sigmas, neither range nor drift far.

    The longest comes first, then what is left on either side is searched in the same way. A slow
    rotation falls apart into stretches that each drift all the way, and none of them counts.
    """
    reach = _reach(means)
    parts: list[tuple[int, int]] = []
    left = [(0, len(means) - 1)]
    while left:
        first, last = left.pop()
        if last - first + 1 < fewest:
            continue
        starts = np.maximum(reach[first : last + 1], first)
        longest = int(np.argmax(np.arange(first, last + 1) - starts))
        a, b = int(starts[longest]), first + longest
        if b - a + 1 < fewest:
            continue
        if _drift(means[a : b + 1]) < _DRIFT:
            parts.append((a, b))
        left += [(first, a - 1), (b + 1, last)]
    return parts


def _drift(means: Array) -> float:
    """Return the change along a straight line through the means, largest channel."""
    at = np.arange(len(means)) - (len(means) - 1) / 2
    slope = at @ means / (at @ at)
    return float(np.abs(slope).max() * (len(means) - 1))


def _reach(means: Array) -> Index:
    """Return for each window the first one from which on every channel's range is below _RANGE."""
    reach = np.zeros(len(means), dtype=np.int_)
    first = 0
    highest = lowest = means[0]
    for last, mean in enumerate(means):
        highest, lowest = np.maximum(highest, mean), np.minimum(lowest, mean)
        if (highest - lowest > _RANGE).any():
            back = means[first : last + 1][::-1]  # how far back from here is all within range
            high, low = np.maximum.accumulate(back), np.minimum.accumulate(back)
            first = last + 1 - int(np.argmax((high - low > _RANGE).any(axis=1)))
            highest, lowest = high[last - first], low[last - first]
        reach[last] = first
    return reach
