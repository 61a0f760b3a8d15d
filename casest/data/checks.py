"""What a record's values themselves give away: a signal that never changes, clipped readings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from casest.errors import DataError

Array = NDArray[np.float64]

LEAST, MOST = 1e-140, 1e140  # sums of squares beyond are 0 or infinite
_FEWEST = 8  # readings at an extreme before it is called clipping
_CROWDING = 5.0  # times as many as on the levels next to it (a smooth crest gives 2.4)
_STEEP = 3.0  # resolutions jumped on the way in (rest toggles by one)
_FOLLOWS = 0.9  # correlation with an input from which on a reading stands still where it does not
_WILD = 50.0  # widths of the middle half from the middle, beyond which a reading is wild, ...
_RARE = 0.01  # ... where no more of the rows than this are
_STALLED = 3  # equal rows in a row that chance does not leave, where two in a row are this rare:
_BY_CHANCE = 0.01  # expected stretches of as many by chance, ...
_FEW = 0.05  # ... and no more of the rows than this: else rows come twice for another reason


def without_gaps(values: Array) -> Array:
    """Return the samples of (N, size) all of whose numbers are finite; itself where all are."""
    whole = np.isfinite(values).all(axis=1)
    return values if whole.all() else values[whole]


def constant(values: Array) -> bool:
    """Are all samples of a signal (N, size), several of them, identical?"""
    return len(values) > 1 and bool((values == values[0]).all())


def refuse_constant(file: str, name: str, values: Array, columns: tuple[str, ...]) -> None:
    """Raise DataError where all samples of a signal (N, size) are identical."""
    if constant(values):
        shown = ", ".join(f"{value:g}" for value in values[0])
        raise DataError(
            f"{file}: signal {name} (columns {' '.join(columns)}) is {shown} in all "
            f"{len(values)} rows; a dead channel or the wrong column: see --columns {name}=…"
        )


def _largest(values: Array) -> float:
    """Largest magnitude, NaN aside; without an array of magnitudes."""
    high, low = (f.reduce(values, axis=None, initial=0.0) for f in (np.fmax, np.fmin))
    return float(max(high, -low))


def refuse_too_large(file: str, purpose: str, column: str, values: Array) -> None:
    """Raise DataError where the squares of a column leave the range of numbers; NaN is none."""
    largest = _largest(values)
    if largest > MOST:
        rows = np.flatnonzero(np.abs(values) > MOST)
        out = f"choose another column, or scale it: --scale {column}=*1e-100"
        if 2 * len(rows) < len(values):
            more = f" (and {len(rows) - 1} more such rows)" if len(rows) > 1 else ""
            out = f"it does in row {rows[0]}{more}: take it out, or choose another column"
        raise DataError(
            f"{file}: column {column} reaches {largest:.3g}, too large to compute with for "
            f"{purpose}; {out}"
        )


def refuse_too_small(file: str, name: str, values: Array, columns: tuple[str, ...]) -> None:
    """Raise DataError where the squares of a whole signal (N, size) are zero to the computer."""
    largest = _largest(values)
    if 0.0 < largest < LEAST:
        raise DataError(
            f"{file}: signal {name} (columns {' '.join(columns)}) is nowhere larger than "
            f"{largest:.3g}, too small to compute with; choose other columns with --columns "
            f"{name}=…, or scale them: --scale {name}=*1e200"
        )


def constant_columns(values: Array, columns: tuple[str, ...]) -> list[str]:
    """Return a note for each component that never changes while others do."""
    if len(values) < 2 or constant(values):
        return []
    still = (values == values[0]).all(axis=0)
    return [
        f"{column}: {values[0, i]:g} in all {len(values)} rows; a dead channel?"
        for i, column in enumerate(columns)
        if still[i]
    ]


def clipped(values: Array, columns: tuple[str, ...], beside: Array | None = None) -> list[str]:
    """Return a note for each component of (N, size) that looks clipped at full scale.

    An extreme is suspect where its value is repeated far more than the levels next to it. At rest
    that happens too (a quiet reading on one level), so besides, either the readings jump onto it
    in steps far above the resolution while the other components keep changing, or what they follow
    `beside` (N, k) goes on, or the same happens at the opposite extreme (a symmetric full scale).
    """
    return [
        f"{columns[i]}: {count} readings at the {'largest' if sign > 0 else 'smallest'} value "
        f"{extreme:.6g} — clipped at full scale?"
        for i, sign, extreme, count in full_scales(values, beside)
    ]


def wild(
    values: Array,
    columns: tuple[str, ...],
    rows: NDArray[np.int_] | range,
    beside: Array | None = None,
) -> list[str]:
    """Return a note for each component of (N, size) of which a few readings lie far off all others:
    a lost bit, a mark for none. An input has no residual that would tell. `rows` (N,) of the file.

    None of rows in which one of the other signals, `beside` (N, k), is at its own end as well: it
    goes there. Unless that is far off all others too: then the row is.
    """
    found = []
    goes_along = np.zeros(len(values), bool)
    for other in () if beside is None else beside.T:
        goes_along |= _at_an_end(other) & ~(_away(other) > _WILD)
    for i, column in enumerate(columns):
        x = values[:, i]
        away = _away(x)
        far = np.flatnonzero((away > _WILD) & ~goes_along)
        if 0 < len(far) <= len(x) * _RARE:
            named = ", ".join(str(int(rows[k])) for k in far[:3]) + (", …" if len(far) > 3 else "")
            more = f"like {x[far[0]]:.6g}" if len(far) > 1 else f"of {x[far[0]]:.6g}"
            found.append(
                f"{column}: {len(far)} of {len(x)} readings, {more} (row {named}), are "
                f"{away[far].min():.2g} times as far off as half of them: faults? Leave them out"
            )
    return found


def _away(x: Array) -> Array:
    """How far readings (N,) are from the middle, in widths of the middle half; none without one."""
    if not np.isfinite(x).any():
        return np.zeros(len(x))
    low, middle, high = np.nanquantile(x, (0.25, 0.5, 0.75))
    return np.asarray(np.abs(x - middle) / (high - low if high > low else np.inf))


def _at_an_end(x: Array) -> NDArray[np.bool_]:
    """Which readings (N,) are among the few largest or smallest?"""
    if not np.isfinite(x).any():
        return np.zeros(len(x), bool)
    least, most = np.nanquantile(x, (_RARE, 1 - _RARE))
    return np.asarray((x > most) | (x < least))


def full_scales(
    values: Array, beside: Array | None = None
) -> Iterator[tuple[int, int, float, int]]:
    """Component, sign, value and count of readings (N, size) at a full scale, by those signs."""
    for i in range(values.shape[1]):
        others = np.delete(values, i, axis=1)
        found = {
            sign: _suspect(sign * values[:, i], sign * others, () if beside is None else beside.T)
            for sign in (1, -1)
        }
        symmetric = all(count for count, _ in found.values()) and _symmetric(values[:, i])
        for sign, (count, moving) in found.items():
            if count and (moving or symmetric):
                yield i, sign, float(sign * (sign * values[:, i]).max()), count


def stalled(values: Array) -> NDArray[np.bool_]:
    """Which rows (N,) of several components (N, size) only repeat the one before.

    A logger that waits writes its last reading again, or zeros, which are none from the first on.
    Noise on several components at once does not: stretches of _STALLED rows and more where two
    equal ones hardly ever come.
    """
    none = np.zeros(len(values), dtype=np.bool_)
    if values.shape[1] < 2 or len(values) < 2:
        return none
    again = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    if not (again[2:] & again[1:-1]).any():  # long before anything is counted
        return none
    first = np.flatnonzero(~again)
    length = np.diff(np.append(first, len(values)))
    twos = int(np.count_nonzero((length > 1) & (length < _STALLED)))
    long = length >= _STALLED
    chance = max(twos, 1) / len(values)
    if chance ** (_STALLED - 1) * len(values) > _BY_CHANCE:
        return none
    found = again & np.repeat(long, length)
    zeros = first[long & ~values[first].any(axis=1)]
    found[zeros] = True
    return found if found.mean() <= _FEW else none


def _symmetric(x: Array) -> bool:
    """Whether the extremes are +F and -F, up to one part in a hundred."""
    return bool(abs(x.max() + x.min()) < 0.01 * (x.max() - x.min()))


def _suspect(x: Array, others: Array, beside: Iterable[Array]) -> tuple[int, bool]:
    """Return how many readings crowd at the largest value, and whether that was in motion."""
    if np.count_nonzero(x == x.max()) < _FEWEST:  # long before all are put in order
        return 0, False
    levels, counts = np.unique(x, return_counts=True)
    if len(levels) < 5 or counts[-1] < max(_FEWEST, _CROWDING * float(counts[-4:-1].mean())):
        return 0, False
    at_top = x == levels[-1]
    entries = np.flatnonzero(at_top[1:] & ~at_top[:-1])
    resolution = float(np.median(np.diff(levels[-20:])))
    floats = counts[:-1].max() == 1  # no other level repeats: nothing is quantised
    jumps = levels[-1] - x[entries]
    steep = floats or (jumps.size > 0 and float(np.median(jumps)) > _STEEP * resolution)
    moving = steep and _changing(others, at_top)
    moving = moving or any(_goes_on(x, given, at_top, resolution) for given in beside)
    return int(counts[-1]), bool(moving)


def _goes_on(x: Array, given: Array, at_top: NDArray[np.bool_], resolution: float) -> bool:
    """Whether what a component follows moves where it stands still, by more than its resolution and
    than it differs from that elsewhere."""
    both = np.isfinite(given)
    there, rest = given[both & at_top], both & ~at_top
    if not there.size or not rest.any() or min(np.ptp(given[rest]), np.ptp(x[rest])) == 0.0:
        return False
    if abs(np.corrcoef(x[both], given[both])[0, 1]) < _FOLLOWS:
        return False
    slope, level = np.polyfit(given[rest], x[rest], 1)
    differs = 1.5 * float(np.median(np.abs(x[rest] - level - slope * given[rest])))
    return bool(abs(slope) * np.ptp(there) > _STEEP * max(resolution, differs))


def _changing(others: Array, at_top: NDArray[np.bool_]) -> bool:
    """Whether the other components change while this one stands still (True if there are none)."""
    if others.shape[1] == 0:
        return True
    pairs = np.flatnonzero(at_top[1:] & at_top[:-1])
    if pairs.size == 0:
        return True  # never two in a row: the signal was only passing, and in motion
    return bool((others[pairs + 1] != others[pairs]).any(axis=1).mean() > 0.5)
