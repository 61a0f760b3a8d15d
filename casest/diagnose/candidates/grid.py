"""Where to look for what has a moment, a level, a frequency or a time constant.

The residual itself says where: its cumulative sum, its periodogram, the largest readings. How much
was looked through is counted, and paid for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.linear import Index, Linear
from casest.diagnose.levels import LEVELS

#: Values on each grid: moments beside the best one, edges of pulses, levels, time constants, lines.
MOMENTS, EDGES, PULSES, LEVELS_TRIED, CONSTANTS, LINES = 15, 60, 10, 24, 8, 3
#: Lags of a recorded signal, each way; moments from which on something may grow.
LAGS, ONSETS = 8, 24
#: Shares of a span in which a loop may turn round.
SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)
#: The shortest time constant, in samples: a shorter one is a delay.
SHORTEST = 3.0
#: What has a slope at nothing as well: as long as it is short, or narrow.
FROM_NOTHING = {"memory", "threshold", "band"}
#: Share of a shift's squares that the unknowns may leave and it still counts as seen.
UNSEEN = 1e-3
#: Share of the readings that the lowest level lets through, and fewest beyond the highest; in a
#: table, where one input alone beyond it is none.
LOWEST, FEWEST, FEWEST_OF_FEW = 0.7, 6, 2
#: Share of the readings that the widest threshold holds back, and that the highest floor does.
BELOW, CUT = 0.6, 0.5


@dataclass(frozen=True)
class Seen:
    """What a grid is laid over: the push Pᵀr (N, q) of the residual on what the sensor gives, the
    prediction (N, q) if there is one, the time (N,) if there is one, the linear problem, P
    (N, m, q), the residual's slope in a shift of what the sensor gives, where it is not −1, and
    what the sensor met (N, d), if that is known."""

    push: Array
    reading: Array | None
    time: Array | None
    linear: Linear
    shift: Array | None = None
    met: Array | None = None


def on_grid(
    candidate: Candidate, seen: Seen, likely: float = 0.0, again: float = np.inf
) -> list[Candidate]:
    """The candidate at values of what it is searched over, `trials` saying among how many.

    `likely`: a lag that the records show by themselves; `again`: after what time (s) what may be
    late is the same once more.
    """
    profile = dict(candidate.effect.profile) if candidate.effect else {}
    if not profile:
        return [candidate]
    kinds, lowest = tuple(profile.values()), _lowest(candidate, profile)
    values, trials = searched(kinds, seen, likely, lowest, again)
    found = [
        replace(candidate, held=_held(dict(zip(profile, v, strict=True))), trials=int(trials))
        for v in values
    ]
    if set(profile.values()) <= FROM_NOTHING:
        found.append(replace(candidate, trials=max(int(trials), 1)))
    return found


def _lowest(candidate: Candidate, profile: Mapping[str, str]) -> float:
    """The least frequency that the effect may have."""
    assert candidate.effect is not None
    said = [
        d.lower[0]
        for name, d in candidate.effect.declarations
        if profile.get(name) == "frequency" and isinstance(d, Parameter)
    ]
    return max([0.0, *said])


def _held(values: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    return tuple((n, float(f"{v:.9g}")) for n, v in values.items())


Values = tuple[list[tuple[float, ...]], float]


def searched(
    kinds: tuple[str, ...],
    seen: Seen,
    likely: float = 0.0,
    lowest: float = 0.0,
    again: float = np.inf,
) -> Values:
    """Values to look at for what is searched over, and among how many they were chosen.

    `lowest`: the least frequency (rad/s); `likely` and `again`: as in `on_grid`.
    """
    if kinds == ("level",):
        return _levels(seen)
    if kinds == ("floor",):
        return _floors(seen)
    if kinds in (("threshold",), ("band",)):
        return _thresholds(seen.reading if kinds == ("threshold",) else seen.met)
    if seen.time is None:
        return [], 1
    if kinds == ("lag",):
        return _lags(seen, likely, again)
    if kinds == ("share",):
        turned = _turned_back(seen)
        return [(float(v),) for v in SHARES if v <= turned], len(SHARES)
    if kinds == ("onset",):
        return _onsets(seen)
    if kinds == ("time",):
        return _moments(seen)
    if kinds == ("time", "time"):
        return _pulses(seen)
    if kinds == ("frequency",):
        return _lines(seen, lowest)
    return _constants(seen)


def _levels(seen: Seen) -> Values:
    if seen.reading is None:
        return [], 1
    size = np.sort(np.abs(seen.reading).ravel())
    fewest = FEWEST if len(size) >= LEVELS.series else FEWEST_OF_FEW
    least, most = LOWEST * len(size), len(size) - fewest
    if most <= least:
        return [], 1
    beyond = np.unique(np.geomspace(len(size) - least, fewest, LEVELS_TRIED).astype(int))
    several = np.unique([float(f"{size[-b]:.6g}") for b in beyond])
    # Rows of one pose are predicted alike: what nothing exceeds but by rounding is no level.
    levels = [float(v) for v in several if np.count_nonzero(size > v * (1 + 1e-6)) >= fewest]
    return [(v,) for v in levels], max(len(levels), 1)


def _floors(seen: Seen) -> Values:
    """Values that so many readings are predicted below, up to half of them."""
    several = np.zeros(0) if seen.reading is None else np.sort(seen.reading.ravel())
    if CUT * len(several) <= FEWEST:
        return [], 1
    below = np.unique(np.geomspace(FEWEST, CUT * len(several), LEVELS_TRIED).astype(int))
    floors = np.unique([float(f"{several[k]:.6g}") for k in below])
    floors = floors[np.searchsorted(several, floors) >= FEWEST]
    return [(float(v),) for v in floors], max(len(floors), 1)


def _thresholds(values: Array | None) -> Values:
    """Sizes that a part of the values stays below, up to most of them."""
    size = np.zeros(0) if values is None else np.abs(values).ravel()
    if not np.any(size > 0):
        return [], 1
    several = np.quantile(size[size > 0], np.linspace(0, BELOW, CONSTANTS + 1)[1:])
    widths = np.unique([float(f"{v:.6g}") for v in several])
    return [(float(v),) for v in widths], len(widths)


def _turned_back(seen: Seen) -> float:
    """How far what the sensor met comes back, up and down again or the other way, as a share of its
    span.

    A loop that nothing turned round in is a bend at the beginning.
    """
    y = seen.reading if seen.met is None else seen.met
    if y is None:
        return 1.0
    up = (y - np.minimum.accumulate(y, axis=0)).max(axis=0)
    down = (np.maximum.accumulate(y, axis=0) - y).max(axis=0)
    span = np.maximum(np.ptp(y, axis=0), 1e-300)
    return float((np.minimum(up, down) / span).max(initial=0.0))


def _edge(count: int) -> int:
    return max(4, count // 100)


class Shifts:
    """What a shift of what the sensor gives takes from the squares, on rows a to b and no others.

    By least squares beside the unknowns, from sums over the rows before each: a reading's length
    shows of a shift what lies along it, and that turns.
    """

    def __init__(self, seen: Seen) -> None:
        r, basis = seen.linear.residual, seen.linear.basis
        n, axes = r.shape
        P = np.tile(np.eye(axes), (n, 1, 1)) if seen.shift is None else seen.shift
        left = (r.ravel() - basis @ (basis.T @ r.ravel())).reshape(r.shape)
        rows = basis.reshape(n, axes, -1)
        self._s, self._S, self._K = (
            np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
            for each in (
                np.einsum("nmq,nm->nq", P, left),
                np.einsum("nmq,nmk->nqk", P, P),
                np.einsum("nmp,nmq->npq", rows, P),
            )
        )

    def gain(self, a: Index, b: Index) -> Array:
        """For each pair of rows, in squares of the residual."""
        s, S, K = (x[b] - x[a] for x in (self._s, self._S, self._K))
        size = np.sqrt(np.maximum(np.einsum("...qq->...q", S), 1e-300))
        beside = S - np.einsum("...pq,...pk->...qk", K, K)
        beside = beside / (size[..., :, None] * size[..., None, :])
        s = s / size
        found = np.linalg.solve(beside + UNSEEN * np.eye(s.shape[-1]), s[..., None])
        return np.asarray(np.sum(s * found[..., 0], axis=-1))


def _between(time: Array, k: int) -> float:
    return float(0.5 * (time[k - 1] + time[k]))


def _moments(seen: Seen) -> Values:
    assert seen.time is not None
    n, edge = len(seen.time), _edge(len(seen.time))
    if n < 4 * edge:
        return [], 1
    rows = np.arange(edge, n - edge + 1)
    best = edge + int(np.argmax(Shifts(seen).gain(rows, np.full_like(rows, n))))
    even = np.linspace(edge, n - edge, MOMENTS).astype(int)
    chosen = sorted({best, *even.tolist()})
    return [(_between(seen.time, k),) for k in chosen if 0 < k < n], n


def _onsets(seen: Seen) -> Values:
    assert seen.time is not None
    n = len(seen.time)
    rows = (np.arange(1, ONSETS) * n) // ONSETS
    return [(float(seen.time[k]),) for k in rows if 0 < k < n], ONSETS


def _pulses(seen: Seen) -> Values:
    assert seen.time is not None
    time, n = seen.time, len(seen.time)
    edge = _edge(n)
    if n < 8 * edge:
        return [], 1
    gain = Shifts(seen).gain
    grid = np.unique(np.linspace(edge, n - edge, EDGES).astype(int))
    a, b = (g.ravel() for g in np.meshgrid(grid, grid, indexing="ij"))
    a, b = a[b - a >= edge], b[b - a >= edge]
    best = int(np.argmax(gain(a, b)))
    first, last = int(a[best]), int(b[best])
    reach = max(2, n // EDGES)
    for _ in range(2):
        near = np.arange(max(edge, first - reach), min(last - edge, first + reach) + 1)
        if len(near):
            first = int(near[np.argmax(gain(near, np.full_like(near, last)))])
        near = np.arange(max(first + edge, last - reach), min(n - edge, last + reach) + 1)
        if len(near):
            last = int(near[np.argmax(gain(np.full_like(near, first), near))])
    even = np.linspace(0, n, PULSES + 1).astype(int)[1:-1]
    pairs = {(int(i), int(j)) for i in even for j in even if i < j}
    if edge < first and last < n - edge:  # else it is one step, and what begins or ends a record
        pairs.add((first, last))
    return [(_between(time, i), _between(time, j)) for i, j in sorted(pairs)], n * n / 2


def _constants(seen: Seen) -> Values:
    assert seen.time is not None
    step = float(np.median(np.diff(seen.time))) if len(seen.time) > 1 else 0.0
    longest = float(np.ptp(seen.time)) / 4
    if not longest > SHORTEST * step > 0:
        return [], 1
    return [(float(v),) for v in np.geomspace(SHORTEST * step, longest, CONSTANTS)], CONSTANTS


def _lags(seen: Seen, likely: float, again: float) -> Values:
    """From half a sample on, in steps of a factor, both ways; and what the records show. Within
    half a period of that: nothing tells one of a wave's periods from the next."""
    assert seen.time is not None
    step = float(np.median(np.diff(seen.time))) if len(seen.time) > 1 else 0.0
    longest = float(np.ptp(seen.time)) / 40
    if not longest > step > 0:
        return [], 1
    sizes = step * np.geomspace(0.5, max(longest / step, 1.0), LAGS)
    found = [*(-sizes), *sizes, *([likely] if likely else [])]
    near = [v for v in found if abs(v - likely) < again / 2]
    return [(float(v),) for v in near], max(len(near), 1)


def _lines(seen: Seen, lowest: float) -> Values:
    """Frequencies (rad/s) that stand out of their neighbourhood, of the longest span."""
    assert seen.time is not None
    if not seen.linear.spans:
        return [], 1
    span = max(seen.linear.spans, key=lambda s: s.stop - s.start)
    t, r = seen.time[span], seen.push[span]
    step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    if len(t) < 64 or not step > 0:
        return [], 1
    place = np.round((t - t[0]) / step).astype(int)
    length = int(place.max()) + 1
    if length > 4 * len(t):
        return [], 1
    even = np.zeros((length, r.shape[1]))
    even[place] = (r - r.mean(axis=0)) / (r.std(axis=0) + 1e-300)
    power = (np.abs(np.fft.rfft(even, axis=0)) ** 2).sum(axis=1)
    # The slowest are a course; the fastest one is the sampling's own.
    slowest = int(np.ceil(lowest * length * step / (2 * np.pi)))
    power[: max(5, length // 200, slowest)] = 0
    power[-max(2, length // 200) :] = 0
    width = max(8, length // 200)
    level = np.convolve(power, np.ones(2 * width + 1) / (2 * width + 1), "same")
    ratio = power / np.maximum(level, 1e-300 + 1e-12 * power.max(initial=0.0))
    best: list[int] = []
    for k in np.argsort(-ratio * (power > 0)):
        if len(best) == LINES:
            break
        if all(abs(int(k) - b) > 2 for b in best):
            best.append(int(k))
    return [(2 * np.pi * _refined(power, k) / (length * step),) for k in best], length // 2


def _refined(power: Array, k: int) -> float:
    """The maximum between the bins, from its neighbours (parabola of the logarithm)."""
    if not 0 < k < len(power) - 1 or not np.all(power[k - 1 : k + 2] > 0):
        return float(k)
    a, b, c = np.log(power[k - 1 : k + 2])
    bend = a - 2 * b + c
    return k + 0.5 * (a - c) / bend if bend < 0 else float(k)


def nearer(candidate: Candidate, seen: Seen, scale: float) -> list[Candidate]:
    """The candidate at values around its own, `scale` of the distance on the first grid away."""
    if candidate.effect is None:
        return []
    profile, held = dict(candidate.effect.profile), dict(candidate.held)
    return [
        replace(candidate, held=_held({**held, name: moved}))
        for name, value in held.items()
        for moved in _steps(profile[name], value, seen, scale)
    ]


def _steps(kind: str, value: float, seen: Seen, scale: float) -> list[float]:
    if kind == "level":
        return [value * (1 + s * 0.06 * scale) for s in (-1, -0.5, 0.5, 1)]
    if kind == "floor":
        span = 0.0 if seen.reading is None else float(np.ptp(seen.reading))
        return [value + s * 0.06 * scale * span for s in (-1, -0.5, 0.5, 1)]
    if kind in ("timescale", "memory", "threshold", "band", "share", "lag"):
        return [value * float(np.exp(s * 0.7 * scale)) for s in (-1, -0.5, 0.5, 1)]
    if kind == "frequency" or seen.time is None:
        return []
    gap = float(np.median(np.diff(seen.time)))
    reach = max(1, round(len(seen.time) / MOMENTS / 2 * scale))
    steps = sorted({max(1, round(reach * s)) for s in (0.25, 0.5, 1)})
    edge = _edge(len(seen.time))
    inside = seen.time[edge - 1], seen.time[-edge]
    moved = [value + way * k * gap for k in steps for way in (-1, 1)]
    return [moment for moment in moved if inside[0] <= moment <= inside[1]]
