"""Records whose inputs are held: a weight that lies on a cell, a bath that stays at a temperature.

What such a record says of the model is as much as it has plateaus: each has an error of its own
(the weight's, the seat's), and a thousand readings of it are one. So a cause is judged twice: from
plateau to plateau by the F test of their means, as poses are, and within the plateaus as a series.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.evidence.held_out import clipped
from casest.diagnose.evidence.likelihood import Explained, Likelihood
from casest.diagnose.evidence.linear import Index, Linear, Parts
from casest.diagnose.evidence.score import Trial, judged
from casest.diagnose.levels import LEVELS


def held_stretches(values: Array, breaks: NDArray[np.bool_]) -> Index:
    """Number of the stretch (N,) over which values (N, q) are held, −1 where they are not.

    They are held where they stay the same, or jitter far less than they jump at both ends; `breaks`
    (N − 1,) are ends too, whatever the values do there. Stretches that jump among themselves are
    taken one by one if no row is left out, else as one: a reading that toggles between two steps is
    held all the same. Thresholds are tried by factors of `LEVELS.jump`, so that none is missed.
    """
    steps = np.abs(np.diff(values, axis=0)).max(axis=1)
    rounding = 1e-9 * float(np.ptp(values, axis=0).max())
    found = np.full(len(values), -1)
    for threshold in _thresholds(steps[steps > rounding], rounding):
        starts = np.concatenate([[0], np.flatnonzero((steps > threshold) | breaks) + 1])
        sizes = np.diff(np.append(starts, len(values)))
        top, bottom = np.maximum.reduceat(values, starts), np.minimum.reduceat(values, starts)
        reach = (top - bottom).max(axis=1)
        same = (reach <= rounding) & (sizes >= LEVELS.repeats)
        jitters = (sizes >= LEVELS.jitters) & (LEVELS.jump * reach < _leaps(starts, steps, breaks))
        wider = (same | jitters) & ~np.logical_and.reduceat(found >= 0, starts)
        rows = np.repeat(wider, sizes)
        found[rows] = np.repeat(starts, sizes)[rows]
    return found


def _thresholds(steps: Array, rounding: float) -> Iterator[float]:
    """From none on, up to the largest of the steps."""
    yield rounding
    threshold, largest = steps.min(initial=np.inf), steps.max(initial=0.0)
    while threshold < largest:
        yield float(threshold)
        threshold *= LEVELS.jump


def _leaps(starts: Index, steps: Array, breaks: NDArray[np.bool_]) -> Array:
    """The smaller jump at the ends of each stretch; the larger where both ends are breaks."""
    inner = starts[1:] - 1
    size = np.concatenate([[0.0], steps[inner], [0.0]])
    free = np.concatenate([[True], breaks[inner], [True]])
    jump = np.where(free, np.inf, size)
    least = np.minimum(jump[:-1], jump[1:])
    return np.where(np.isinf(least), np.maximum(size[:-1], size[1:]), least)


def plateaus_of(met: Array, spans: Sequence[slice]) -> Index | None:
    """Number of each row's plateau (N,), where what the sensor met (N, q) is held; else None.

    Where plateaus are many, their errors are a noise as any other.
    """
    breaks = _breaks(met, spans)
    held = held_stretches(met, breaks)
    moves = (held[1:] < 0) & np.any(np.diff(met, axis=0) != 0, axis=1)
    number = np.concatenate([[0], np.cumsum(breaks | moves | (np.diff(held) != 0))])
    count = int(number[-1]) + 1
    few = 1 < count < LEVELS.series and count * LEVELS.jitters <= len(met)
    return number if few else None


def settled_rows(met: Array, spans: Sequence[slice]) -> NDArray[np.bool_]:
    """In which rows (N,) what the sensor met (N, q) is held, and was and will be some rows off."""
    breaks = _breaks(met, spans)
    held = held_stretches(met, breaks)
    settled = held >= 0
    for k in np.flatnonzero(~breaks & (np.diff(held) != 0)):
        settled[max(0, k + 1 - LEVELS.jitters) : k + 1 + LEVELS.jitters] = False
    return settled


def _breaks(met: Array, spans: Sequence[slice]) -> NDArray[np.bool_]:
    """Behind which rows (N − 1,) a span ends."""
    breaks = np.zeros(len(met) - 1, dtype=bool)
    breaks[[span.start - 1 for span in spans if span.start]] = True
    return breaks


@dataclass(frozen=True)
class Held:
    """A fit to a record with plateaus; causes are of so many `families`."""

    linear: Linear
    families: int

    def says(self, trials: Sequence[Trial]) -> bool:
        """Do the plateaus' means say it, as so many poses, or the course within them?"""
        inside = judged(trials, *self._within, families=self.families)
        if inside is not None and inside.score > LEVELS.strong:
            return True
        poses = [replace(t, columns=self._means(t.columns)) for t in trials]
        between = judged(poses, *self._between, families=self.families)
        return between is not None and between.p_value < LEVELS.chance

    @cached_property
    def _within(self) -> tuple[Likelihood, Explained]:
        """Of the series, where each plateau has an offset of its own on each axis."""
        N, m = self.linear.residual.shape
        own = np.zeros((N, m, self._count, m))
        for axis in range(m):
            own[np.arange(N), axis, self._number, axis] = self.linear.root[:, axis]
        slopes = np.concatenate([self.linear.beside, own.reshape(N, m, -1)], axis=2)
        return _beside_none(replace(self.linear, slopes=slopes, feigned=None))

    @cached_property
    def _between(self) -> tuple[Likelihood, Explained]:
        """Of the means as poses."""
        residual, slopes = (self._means(v) for v in (clipped(self.linear), self.linear.slopes))
        place = np.arange(self._count)
        poses = Linear(residual, slopes, (), Parts(place, place, place, place), self.linear.least)
        return _beside_none(poses)

    @property
    def _number(self) -> Index:
        assert self.linear.plateaus is not None
        return self.linear.plateaus

    @property
    def _count(self) -> int:
        return int(self._number[-1]) + 1

    def _means(self, values: Array) -> Array:
        """Of rows (N, m, …) on each plateau (U, m, …), by their weights."""
        found = np.zeros((self._count, *values.shape[1:]))
        sizes = np.zeros((self._count, values.shape[1]))
        np.add.at(found, self._number, (values.T * self.linear.root.T).T)
        np.add.at(sizes, self._number, self.linear.root**2)
        return np.asarray((found.T / np.maximum(sizes, 1e-300).T).T)


def _beside_none(linear: Linear) -> tuple[Likelihood, Explained]:
    likelihood = Likelihood(linear)
    return likelihood, likelihood.beside()
