"""What changed since the old calibration, in the sensor's terms: the smallest repair.

Every cause frees some directions of the shared parameters; the record is fitted along them, and the
test asks whether the others may stay as they were.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.leastsquares.problem import Slot
from casest.validity.judged import Subject, Test, repaired_variance, tested
from casest.validity.whitened import Factor

#: A cause explains a record whose test beside it has at least this chance.
EXPLAINS = 0.001
#: Causes that cost no more than this beyond the best one are named with it: a likelihood of one in
#: twenty.
ALIKE = 6.0


@dataclass(frozen=True)
class Cause:
    """Directions (n, k) that may have changed together; the parameters they belong to."""

    label: str
    parameters: tuple[str, ...]
    directions: Array

    @property
    def size(self) -> int:
        """How many numbers it changes."""
        return int(self.directions.shape[1])


@dataclass(frozen=True)
class Moved:
    """One unknown before and after the smallest repair, with the standard deviation after."""

    name: str
    before: float
    after: float
    std: float
    std_before: float


@dataclass(frozen=True)
class Change:
    """The smallest cause that explains the record, its test and what it moves.

    `alike`: other causes that explain it nearly as well. `samples`: how many like those of
    the record make the repair as sharp as the old calibration was.
    """

    cause: Cause
    rest: Test
    moved: tuple[Moved, ...]
    alike: tuple[str, ...]
    samples: int


def changed(subject: Subject) -> Change:
    """The smallest cause that repairs the calibration for this record.

    Of those that leave nothing to explain: least T beside it, with Schwarz's price for each number
    that it changes.
    """
    price = float(np.log(subject.problem.residual_count))
    tried = [(cause, _beside(subject, cause)) for cause in causes(subject)]
    good = [(c, t) for c, t in tried if t.p_value >= EXPLAINS] or tried[-1:]
    costs = [test.statistic + price * cause.size for cause, test in good]
    best = int(np.argmin(costs))
    near = [k for k, cost in enumerate(costs) if cost < costs[best] + ALIKE and k != best]
    return _repaired(subject, *good[best], tuple(good[k][0].label for k in near))


def _beside(subject: Subject, cause: Cause) -> Test:
    """Is what the cause leaves as it was?"""
    free = np.hstack([subject.free, cause.directions])
    _, factor = subject.rows.fitted(subject.point, free)
    return tested(subject, factor, free)


def _repaired(subject: Subject, cause: Cause, rest: Test, alike: tuple[str, ...]) -> Change:
    """What the repair moves, and how sharp it is."""
    free = np.hstack([subject.free, cause.directions])
    point, factor = subject.rows.fitted(subject.point, free)
    moved = subject.problem.difference(point, subject.point)
    spread = repaired_variance(subject, factor, free)
    old = np.sqrt(np.diag(subject.covariance))
    touched = np.flatnonzero(cause.directions.any(axis=1))
    before = subject.point.x
    found = tuple(
        Moved(subject.problem.names[i], float(before[i]), float(before[i] + moved[i]),
              float(np.sqrt(spread[i])), float(old[i]))
        for i in touched
    )  # fmt: skip
    return Change(cause, rest, found, alike, _needed(subject, factor, touched))


def _needed(subject: Subject, factor: Factor, touched: NDArray[np.int_]) -> int:
    """Samples like these that make the touched unknowns as sharp as they were; 0: as exact."""
    columns = factor.R[:, touched]
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0, size, np.nan)
    inverse = np.linalg.pinv(np.nan_to_num(columns / size), rcond=1e-10)
    now = subject.noise.sigma**2 * np.sum(inverse**2, axis=1) / size**2
    old = np.diag(subject.covariance)[touched]
    count = sum(map(len, subject.problem.runs))
    known = old > 0
    if not known.any():
        return 0
    times = float(np.max(now[known] / old[known], initial=0.0))
    return max(int(np.ceil(count * times)), len(touched) + 1) if np.isfinite(times) else 0


# -- what may have changed -------------------------------------------------------------------------


def causes(subject: Subject) -> Iterator[Cause]:
    """Single numbers, common factors, axes, whole parameters, pairs of them, everything."""
    problem, n = subject.problem, subject.problem.unknowns
    slots = [s for s in problem.slots if s.run is None and subject.shared[s.x].all()]
    eye = np.eye(n)
    for s in slots:
        if s.x.stop - s.x.start > 1:
            yield from _parts(subject, s)
    yield from _axes(subject, slots)
    whole = [(s.parameter.name, eye[:, s.x]) for s in slots]
    for i, (name, own) in enumerate(whole):
        yield Cause(name, (name,), own)
        for other, more in whole[:i]:
            yield Cause(f"{other} and {name}", (other, name), np.hstack([more, own]))
    names = tuple(name for name, _ in whole)
    if len(whole) > 2:
        yield Cause("everything", names, np.hstack([own for _, own in whole]))


def _parts(subject: Subject, slot: Slot) -> Iterator[Cause]:
    """One number of a parameter; all by a common factor; the diagonal of a matrix and the rest."""
    n, name = subject.problem.unknowns, slot.parameter.name
    eye, at = np.eye(n), np.arange(slot.x.start, slot.x.stop)
    for i in at:
        yield Cause(subject.problem.names[i], (name,), eye[:, [i]])
    if slot.parameter.shape.curved:
        return
    x = subject.point.x[slot.x]
    positive = np.asarray(slot.parameter.lower)[: len(at)] >= 0
    if positive.any() and np.any(x):
        factor = np.zeros((n, 1))
        factor[at, 0] = x
        yield Cause(f"{name} by a common factor", (name,), factor)
    places = [re.findall(r"\d+", subject.problem.names[i].rpartition("[")[2]) for i in at]
    if all(len(p) == 2 for p in places):
        diagonal = [i for i, p in zip(at, places, strict=True) if p[0] == p[1]]
        rest = [i for i, p in zip(at, places, strict=True) if p[0] != p[1]]
        if diagonal and rest:
            yield Cause(f"diagonal of {name}", (name,), eye[:, diagonal])
            yield Cause(f"{name} between the axes", (name,), eye[:, rest])


def _axes(subject: Subject, slots: list[Slot]) -> Iterator[Cause]:
    """All numbers of one axis of the reading, where several parameters have one each."""
    n, eye = subject.problem.unknowns, np.eye(subject.problem.unknowns)
    several = [s for s in slots if s.x.stop - s.x.start >= 3 and not s.parameter.shape.curved]
    if len(several) < 2:
        return
    for axis in range(3):
        chosen, owners = [], []
        for s in several:
            for i in range(s.x.start, s.x.stop):
                places = re.findall(r"\d+", subject.problem.names[i].rpartition("[")[2])
                if places and int(places[-1]) == axis:
                    chosen.append(i)
                    owners.append(s.parameter.name)
        if 1 < len(chosen) < n:
            yield Cause(f"axis {'xyz'[axis]}", tuple(dict.fromkeys(owners)), eye[:, chosen])
