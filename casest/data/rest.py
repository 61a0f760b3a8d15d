"""Rest intervals of a raw record: where the sensor lay still, and the mean of each such stretch.

The detector is the moving variance of Skog, Händel, Nilsson, Rantakokko, "Zero-velocity detection:
an algorithm evaluation", IEEE T-BME 57(11), 2010 (sec. II-B); intervals are used one mean each as
in Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for IMU calibration without
external equipments", ICRA 2014 (sec. IV). Both compare the variance with a constant or a multiple
of an initial rest; here the noise floor and the thresholds come from the record itself, so that
neither units nor offsets matter and no initial rest is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casest.data.run import Array, Index, Labels, Run
from casest.errors import DataError, UsageError

_WINDOW = 25  # samples, where the rate is unknown
_WINDOW_SECONDS = 0.25
_FEWEST, _MOST = 15, 400  # samples in a window
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


def at_rest(
    run: Run, *, also: Sequence[str] = (), window: int | None = None, shortest: int | None = None
) -> Run:
    """Average each rest interval of a raw run into one sample.

    also: names of further columns (a gyro's) that must be at rest too.
    window: samples over which the variance is taken; shortest: samples an interval needs.

    Returns a run with one sample per interval: means, `count`, `spread` (standard error of the
    mean with the noise's autocorrelation), `rows` and `block` the interval's index, and in
    `columns` the first and last data row of each as "first_row" and "last_row".
    Raises DataError where nothing rests, or rest cannot be told from motion.
    """
    names, channels = _channels(run, also)
    n_averaged = channels.shape[1] - len(also)
    found = find_rests(channels, run.block, _window(run, window), shortest, run.name, n_averaged)
    return _averaged(run, found, names, channels)


def find_rests(
    channels: Array,
    block: Index,
    window: int = _WINDOW,
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


def _channels(run: Run, also: Sequence[str]) -> tuple[list[str], Array]:
    """Stack what must be still: every signal that is no time and no rotation, then `also`."""
    if run.spread:
        raise UsageError(f"{run.name}: is averaged already; leave --at-rest out")
    names: list[str] = []
    parts: list[Array] = []
    for name, values in run.signals.items():
        if name == "t" or values.shape[1] == 9:
            continue
        names += _component_names(name, values.shape[1])
        parts.append(values)
    for name in also:
        column = run.columns.get(name)
        if column is None or column.dtype.kind == "U":
            raise UsageError(f"{run.name}: no column {name} of numbers to look for rest in")
        names.append(name)
        parts.append(np.asarray(column, dtype=np.float64)[:, None])
    if not parts:
        raise UsageError(f"{run.name}: no signal to look for rest in; leave --at-rest out")
    return names, np.concatenate(parts, axis=1)


def _component_names(name: str, size: int) -> list[str]:
    if size == 1:
        return [name]
    return [f"{name}{axis}" for axis in ("xyz" if size == 3 else map(str, range(size)))]


def _window(run: Run, window: int | None) -> int:
    """Return an odd number of samples: a quarter of a second where the rate is known."""
    if window is None and run.time is not None and len(run) > 1:
        window = round(_WINDOW_SECONDS / float(np.median(np.diff(run.time))))
        window = min(max(window, _FEWEST), _MOST)
    return (window or _WINDOW) | 1


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
    for first, last in _steady_parts(
        (cut.mean(axis=1) - x.mean(axis=0)) / noise, 0, n - 1, -(-fewest // window)
    ):
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


def _steady_parts(means: Array, first: int, last: int, fewest: int) -> list[tuple[int, int]]:
    """Return stretches of windows whose means, in noise sigmas, neither range nor drift far.

    The longest comes first, then what is left on either side is searched in the same way. A slow
    rotation falls apart into stretches that each drift all the way, and none of them counts.
    """
    if last - first + 1 < fewest:
        return []
    a, b = _longest_steady(means[first : last + 1])
    a, b = a + first, b + first
    if b - a + 1 < fewest:
        return []
    sides = [(first, a - 1), (b + 1, last)]
    rest = [part for side in sides for part in _steady_parts(means, *side, fewest)]
    return [(a, b), *rest] if _drift(means[a : b + 1]) < _DRIFT else rest


def _drift(means: Array) -> float:
    """Return the change along a straight line through the means, largest channel."""
    at = np.arange(len(means)) - (len(means) - 1) / 2
    slope = at @ means / (at @ at)
    return float(np.abs(slope).max() * (len(means) - 1))


def _longest_steady(means: Array) -> tuple[int, int]:
    """Return the longest stretch (first, last) in which each channel's range is below _RANGE."""
    best, first = (0, 0), 0
    for last in range(len(means)):
        while (np.ptp(means[first : last + 1], axis=0) > _RANGE).any():
            first += 1
        if last - first > best[1] - best[0]:
            best = (first, last)
    return best


def _averaged(run: Run, found: Rests, names: list[str], channels: Array) -> Run:
    spans = found.intervals
    index = np.arange(len(spans))
    columns: dict[str, Array | Labels] = {
        name: np.array([_mean_or_label(values[s.samples]) for s in spans])
        for name, values in run.columns.items()
    }
    columns["first_row"] = np.array([float(run.rows[s.first]) for s in spans])
    columns["last_row"] = np.array([float(run.rows[s.last]) for s in spans])
    return replace(
        run,
        signals={k: _means(v, spans) for k, v in run.signals.items()},
        columns=columns,
        column_units={k: run.column_units.get(k) for k in columns},
        time=None if run.time is None else np.array([run.time[s.samples].mean() for s in spans]),
        rows=index,
        block=index,
        count=np.array([len(s) for s in spans]),
        spread={k: _spreads(v, spans) for k, v in run.signals.items() if k != "t"},
        notes=(*run.notes, *_notes(run, found, names, channels)),
    )


def _mean_or_label(values: Array | Labels) -> float | str:
    """Return the mean of numbers; of labels the one they share, or nothing."""
    if values.dtype.kind == "U":
        return str(values[0]) if bool((values == values[0]).all()) else ""
    return float(np.asarray(values, dtype=np.float64).mean())


def _means(values: Array, spans: Sequence[Interval]) -> Array:
    means = np.array([values[s.samples].mean(axis=0) for s in spans])
    if values.shape[1] != 9:
        return means
    u, _, vt = np.linalg.svd(means.reshape(-1, 3, 3))  # the rotation nearest to the mean matrix
    return np.asarray((u @ vt).reshape(-1, 9), dtype=np.float64)


def _spreads(values: Array, spans: Sequence[Interval]) -> Array:
    steps = [resolution(values[:, k]) for k in range(values.shape[1])]
    return np.array(
        [
            [standard_error(values[s.samples, k], step) for k, step in enumerate(steps)]
            for s in spans
        ]
    )


def standard_error(x: Array, step: float = 0.0) -> float:
    """Return the standard error of the mean of a stationary, autocorrelated (n,) record.

    var(mean) = s²/n (1 + 2 Σ ρ_k), summed while pairs of ρ stay positive (Geyer 1992, sec. 3.3).
    Where the noise is below half the resolution `step`, averaging does not beat quantisation and
    step/√12 is added.
    """
    n = len(x)
    y = x - x.mean()
    spectrum = np.fft.rfft(y, 2 * n)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2)[:n] / n
    rough = step / np.sqrt(12) if covariance[0] < (step / 2) ** 2 else 0.0
    if covariance[0] <= 0.0:
        return float(rough)
    rho = covariance / covariance[0]
    pairs = rho[0 : n - n % 2 : 2] + rho[1:n:2]
    positive = len(pairs) if (pairs > 0).all() else int(np.argmax(pairs <= 0))
    inflation = max(2.0 * float(pairs[:positive].sum()) - 1.0, 1.0)
    return float(np.hypot(np.sqrt(covariance[0] * inflation / (n - 1)), rough))


def _notes(run: Run, found: Rests, names: list[str], channels: Array) -> list[str]:
    covered = sum(len(s) for s in found.intervals)
    still = [channels[s.samples] for s in found.intervals]
    residual = np.concatenate([x - x.mean(axis=0) for x in still])
    sigma = np.sqrt((residual**2).sum(axis=0) / (covered - len(found.intervals)))
    notes = [
        f"{len(found.intervals)} rest intervals found, {covered} of {len(run)} samples "
        f"({100 * covered / len(run):.0f} %)",
        "noise at rest: " + ", ".join(f"{n} {s:.3g}" for n, s in zip(names, sigma, strict=True)),
    ]
    if run.time is None:
        notes.append(f"rate unknown, rest judged over {_WINDOW} samples; --rate HZ may do better")
    if found.shortened:
        notes.append(f"{found.shortened} rest intervals shortened: they drift at one end")
    if found.split:
        notes.append(f"{found.split} quiet stretches split: the mean shifts inside them")
    if found.dropped:
        notes.append(f"{found.dropped} quiet stretches dropped: they drift all the time")
    return notes
