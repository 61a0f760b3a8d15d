"""Where to look for effects that have a frequency, a moment or a level: a few values of each.

The residual itself says where: its periodogram, its cumulative sum, the largest readings. What was
looked through is counted as trials, and makes the p-value larger.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.levels import CLIPPED

#: Lines of the periodogram, moments and levels that are tried.
LINES, MOMENTS, LEVELS = 4, 3, 3
#: Moments that are tried where the residual does not say: an implicit one has no axes of its own.
EVEN = 15
#: Residuals before and after a moment, at least: three poses at the end are fitted by any step.
BESIDE = 8
#: Share of the readings that the lowest level lets through, and fewest beyond the highest.
LOWEST, FEWEST = 0.7, 6
#: Samples of the longest periodogram.
LONGEST = 1 << 18


def on_grid(
    found: Sequence[Candidate],
    runs: Sequence[Run],
    residuals: Sequence[Array],
    readings: Sequence[Array] | None,
    sigma: float,
) -> list[Candidate]:
    """Candidates with a profile replaced by some with its value held."""
    expanded: list[Candidate] = []
    clipped = [np.clip(r, -CLIPPED * sigma, CLIPPED * sigma) for r in residuals]
    for candidate in found:
        profile = dict(candidate.effect.profile) if candidate.effect else {}
        if not profile:
            expanded.append(candidate)
            continue
        assert candidate.effect is not None
        ((name, kind),) = profile.items()
        # What is cut off is far out: the level is looked for in the residual as it is.
        seen = residuals if kind == "level" else clipped
        values, trials = _values(kind, runs, seen, readings)
        for value in values:
            effect = candidate.effect.holding(**{name: float(f"{value:.9g}")})
            expanded.append(replace(candidate, effect=effect, trials=trials, traced=None))
    return expanded


def freed_again(candidate: Candidate, original: Candidate) -> Candidate:
    """The candidate with its frequency unknown again, starting where it was found."""
    if candidate.effect is None or original.effect is None:
        return candidate
    profile = dict(original.effect.profile)
    smooth = [n for n, kind in profile.items() if kind == "frequency"]
    if not smooth:
        return candidate
    held = {n: float(d.array) for n, d in candidate.effect.declarations if n in smooth}
    return replace(candidate, effect=original.effect.starting(**held), traced=None)


def _values(
    kind: str,
    runs: Sequence[Run],
    residuals: Sequence[Array],
    readings: Sequence[Array] | None,
) -> tuple[list[float], int]:
    if kind == "frequency":
        return _lines(runs, residuals)
    if kind == "time":
        return _moments(runs, residuals) if readings is not None else _even(runs, residuals)
    if readings is None:
        return [], 1
    return _levels(np.concatenate(residuals), np.concatenate(readings))


def _levels(r: Array, y: Array) -> tuple[list[float], int]:
    """Levels beyond which the residual grows most with what the reading exceeds them by."""
    order = np.argsort(-np.abs(y).ravel())
    size, inward = np.abs(y).ravel()[order], (r * np.sign(y)).ravel()[order]
    if len(size) < 4 * FEWEST:
        return [], 1
    beyond = np.unique(np.geomspace(FEWEST, (1 - LOWEST) * len(size), 24).astype(int))
    beyond = beyond[beyond < len(size)]
    # Σr(|y| − level) and Σ(|y| − level)² over the readings beyond each level, from running sums.
    sums = np.cumsum(np.column_stack([size**0, size, size**2, inward, inward * size]), axis=0)
    level = size[beyond]
    n, first, second, plain, product = sums[beyond - 1].T
    spread = second - 2 * level * first + n * level**2
    # Rows of one pose are predicted alike: what nothing exceeds but by rounding is no level.
    exceeded = spread > 1e-9 * second
    gain = np.where(exceeded, (product - level * plain) ** 2 / np.maximum(spread, 1e-300), 0.0)
    _, once = np.unique(level, return_index=True)
    best = sorted((k for k in once if gain[k] > 0), key=lambda k: -gain[k])[:LEVELS]
    return [float(level[k]) for k in best], len(beyond)


def _lines(runs: Sequence[Run], residuals: Sequence[Array]) -> tuple[list[float], int]:
    """Frequencies (rad/s) that stand out of their neighbourhood, of the longest run."""
    run, r = max(zip(runs, residuals, strict=True), key=lambda pair: len(pair[0]))
    if "t" not in run.signals or len(run) < 64:
        return [], 1
    t = run.signals["t"][:, 0]
    step = float(np.median(np.diff(t)))
    if not step > 0:
        return [], 1
    # On an even grid; gaps stay empty.
    place = np.round((t - t[0]) / step).astype(int)
    keep = (place >= 0) & (place < LONGEST)
    length = int(place[keep].max()) + 1
    power = np.zeros(length // 2 + 1)
    for k in range(r.shape[1]):
        even = np.zeros(length)
        even[place[keep]] = r[keep, k]
        power += np.abs(np.fft.rfft(even)) ** 2
    power[:2] = 0
    width = max(8, length // 200)
    level = np.convolve(power, np.ones(2 * width + 1) / (2 * width + 1), "same")
    ratio = power / np.maximum(level, 1e-300 + 1e-12 * power.max(initial=0.0))
    best: list[int] = []
    for k in np.argsort(-ratio * (power > 0)):
        if len(best) == LINES:
            break
        if all(abs(int(k) - b) > 2 for b in best):
            best.append(int(k))
    return [2 * np.pi * _refined(power, k) / (length * step) for k in best], length // 2


def _refined(power: Array, k: int) -> float:
    """The maximum between the bins, from its neighbours (parabola of the logarithm)."""
    if not 0 < k < len(power) - 1 or not np.all(power[k - 1 : k + 2] > 0):
        return float(k)
    a, b, c = np.log(power[k - 1 : k + 2])
    bend = a - 2 * b + c
    return k + 0.5 * (a - c) / bend if bend < 0 else float(k)


def _moments(runs: Sequence[Run], residuals: Sequence[Array]) -> tuple[list[float], int]:
    """Moments (s) at which the cumulative sum of the residual bends most."""
    found: list[tuple[float, float]] = []
    for run, r in zip(runs, residuals, strict=True):
        if "t" not in run.signals or len(run) < 8:
            continue
        found += list(_bends(run.signals["t"][:, 0], r))
    found.sort(reverse=True)
    count = max((len(run) for run in runs), default=2)
    return [when for _, when in found[:MOMENTS]], max(int(8 * np.log(max(count, 2))), 1)


def _even(runs: Sequence[Run], residuals: Sequence[Array]) -> tuple[list[float], int]:
    """Moments (s) that cut the longest run into parts of as many samples."""
    run, r = max(zip(runs, residuals, strict=True), key=lambda pair: len(pair[0]))
    edge = least_beside(*r.shape)
    if "t" not in run.signals or len(run) <= 2 * edge:
        return [], 1
    t = run.signals["t"][:, 0]
    at = np.unique(np.linspace(edge - 1, len(t) - edge - 1, EVEN).round().astype(int))
    return [float(0.5 * (t[k] + t[k + 1])) for k in at], max(int(8 * np.log(len(t))), 1)


def least_beside(samples: int, axes: int) -> int:
    """Samples before and after a moment, at least."""
    return max(2, samples // 50, -(-BESIDE // axes))


def _bends(t: Array, r: Array) -> Iterator[tuple[float, float]]:
    n = len(t)
    k = np.arange(1, n)
    total = np.cumsum(r - r.mean(axis=0), axis=0)[:-1]
    size = np.sum(total**2, axis=1) / (k * (n - k) / n)
    edge = least_beside(*r.shape)
    size[: edge - 1] = size[n - edge :] = 0
    for _ in range(MOMENTS):
        at = int(np.argmax(size))
        if not size[at] > 0:
            return
        yield float(size[at]), float(0.5 * (t[at] + t[at + 1]))
        size[max(0, at - n // 20) : at + n // 20] = 0


def grid_value(candidate: Candidate) -> tuple[str, str, float] | None:
    """Name, kind and value of what a profile holds: a level or a moment."""
    profile = dict(candidate.effect.profile) if candidate.effect else {}
    for name, kind in profile.items():
        assert candidate.effect is not None
        for n, d in candidate.effect.declarations:
            if n == name and kind in ("level", "time"):
                return name, kind, float(d.array)
    return None


def strides(kind: str, value: float, runs: Sequence[Run]) -> list[float]:
    """From coarse to fine: shares of a level; samples around a moment."""
    if kind == "level":
        return [abs(value) * 0.02 / 4**k for k in range(4)]
    times = [run.signals["t"][:, 0] for run in runs if "t" in run.signals]
    gap = min((float(np.median(np.diff(t))) for t in times if len(t) > 1), default=1.0)
    return [gap * n for n in (8, 2, 1)]


def within(kind: str, value: float, runs: Sequence[Run], axes: int) -> bool:
    """Does a run have enough samples before and after the moment?"""
    if kind != "time":
        return True
    times = [run.signals["t"][:, 0] for run in runs if "t" in run.signals]
    return any(
        least_beside(len(t), axes)
        <= np.count_nonzero(t <= value)
        <= len(t) - least_beside(len(t), axes)
        for t in times
    )


def at_grid_value(score: Score, name: str, value: float) -> Score:
    """The score's candidate with another value held."""
    assert score.candidate.effect is not None
    effect = score.candidate.effect.holding(**{name: float(f"{value:.9g}")})
    return replace(score, candidate=replace(score.candidate, effect=effect, traced=None))
