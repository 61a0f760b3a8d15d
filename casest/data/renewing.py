"""Logs that are faster than a sensor in them: a reading is written again until there is a new one.

A sensor that is read every third row is one and two rows old in the others: late, in steps at a
rate of its own. Only the row counts in which it is new.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Array

#: Changes from which on it is seen that a signal is renewed every so many rows, and of how many at
#: most, since commands are held too.
ENOUGH, LONGEST = 100, 10
#: Share of changes that come sooner, at most, and just then, at least.
SELDOM, MOSTLY = 0.02, 0.6


#: Of whole rows that are written again: columns at least that say so, the share of its rows in
#: which one repeats, the rows that repeat all of them in those that repeat one, and how much longer
#: than usual one of a hundred rows stays: what is slow, or rounded, stays for any time.
COLUMNS, REPEATS, TOGETHER, LONGER = 3, (0.02, 0.9), 0.95, 2.0
#: Rows of a passage at least, each another one, that is there twice.
PASSAGE = 8


class Renewed(NamedTuple):
    """A source that is new every so many rows, and in which rows (N,) it is written again."""

    source: tuple[str, ...]
    rows: int
    again: NDArray[np.bool_]

    def __str__(self) -> str:
        return (
            f"{int(self.again.sum())} repeat {' '.join(self.source)}, which is new every "
            f"{self.rows} rows: what is written again is no reading (of a command that is held "
            "that long, log what is measured at its pace)"
        )


def renewed(sources: Mapping[tuple[str, ...], Array]) -> Iterable[Renewed]:
    """The sources (N, size) that are renewed less often than written."""
    for source, values in sources.items():
        rows = renewed_every(values)
        if rows > 1:
            yield Renewed(source, rows, _written_again(values, rows))


def renewed_every(values: Array) -> int:
    """Of how many rows one (N, size) is read, where it is written in others again; 1 of all.

    Hardly ever are two changes nearer than some rows then, and most are just that far apart. Set
    points last longer, or are few; a slow reading that is rounded stays for any number of rows.
    """
    between = np.diff(np.flatnonzero((values[1:] != values[:-1]).any(axis=1)))
    usual = int(np.median(between)) if len(between) >= ENOUGH else 1
    if not 2 <= usual <= LONGEST:
        return 1
    late = usual > 2  # a clock of its own may come a row sooner or later
    sooner = np.mean(between < usual - late)
    near = np.mean(np.abs(between - usual) <= late)
    return usual if sooner < SELDOM and near > MOSTLY else 1


def whole_rows_again(columns: Iterable[Array]) -> NDArray[np.bool_] | None:
    """Which rows (N,) only repeat all numbers of the one before but what counts them, as where two
    loops of a logger go at paces of their own; None where rows do not, where each column has
    repeats of its own, or where any is new in every row: that was read."""
    numbers = [c for c in columns if len(c) > 1 and not np.all(c[1:] > c[:-1])]
    repeats = np.array([np.concatenate([[False], c[1:] == c[:-1]]) for c in numbers])
    low, high = REPEATS
    own = repeats[[low < share < high for share in repeats.mean(axis=1)]] if numbers else repeats
    if len(own) < COLUMNS:
        return None
    again = np.asarray(repeats.all(axis=0), np.bool_)
    if again.sum() < max(ENOUGH, TOGETHER * float(np.median(own.sum(axis=1)))):
        return None
    between = np.diff(np.flatnonzero(~again))
    stays = np.quantile(between, 0.99) > LONGER * np.median(between)
    return None if stays else again


def passage_again(rows: Array) -> tuple[tuple[int, int], int]:
    """Where the longest passage of rows (N, q) that is there twice begins, both times, and of how
    many rows it is; 0 where there is none."""
    _, same = np.unique(rows, axis=0, return_inverse=True)
    seen: dict[int, int] = {}
    shift = np.zeros(len(rows), int)
    for k, number in enumerate(np.ravel(same).tolist()):
        shift[k] = k - seen.get(number, k)
        seen[number] = k
    edges = np.flatnonzero(np.diff(shift, prepend=-1, append=-1))
    found = ((0, 0), 0)
    for a, b in pairwise(edges.tolist()):
        others = len(set(np.ravel(same)[a:b].tolist()))
        if shift[a] and others == b - a >= max(PASSAGE, found[1] + 1):
            found = ((a - int(shift[a]), a), b - a)
    return found


def _written_again(values: Array, rows: int) -> NDArray[np.bool_]:
    """Which rows (N,) only repeat one that is read every `rows`: a reading may stay the same."""
    again = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(values))))
    return np.asarray((np.arange(len(values)) - first) % rows != 0)
