"""The control chart over many dates: an exponentially weighted mean of their shifts.

ILAC-G24/OIML D 10, method 2, by a multivariate EWMA (S. W. Roberts, 1959; C. A. Lowry et al., 1992)
in normal equations: H ← (1 − λ)·H + λ·RᵀR of each date, and so the right sides, so that dates which
each see a few unknowns add up. The variance has what each date's noise makes of it, and the old
values' own error, which all dates share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.validity.judged import SEEN, Subject, beside

#: Weight of the latest date: a mean over about nine of them, sharp for shifts of about one standard
#: deviation.
WEIGHT = 0.2


@dataclass(frozen=True)
class Line:
    """One unknown over D dates: its shift from the old value with the standard deviation of that
    date's own noise (NaN where the date does not show it), the weighted mean, and its limit; `old`:
    the standard deviation of the old value."""

    name: str
    old: float
    shift: Array
    std: Array
    mean: Array
    limit: Array

    @property
    def out(self) -> NDArray[np.intp]:
        """Dates at which the mean is beyond its limit, (k,)."""
        return np.flatnonzero(np.abs(self.mean) > self.limit)


@dataclass(frozen=True)
class Chart:
    """A line for each unknown; `p_values` (D,) of the weighted means of all together.

    `level`: below it a p-value is an alarm; the lines' limits have the same chance together.
    """

    lines: tuple[Line, ...]
    p_values: Array
    level: float

    def out(self, date: int) -> bool:
        """Is anything beyond its limit at a date?"""
        return bool(self.p_values[date] < self.level) or bool(self.named(date))

    def named(self, date: int) -> list[str]:
        """Unknowns beyond their limits at a date."""
        return [line.name for line in self.lines if date in line.out]


class Sums(NamedTuple):
    """Normal matrix H, right side g = Hδ + noise for shifts −δ, the noise's covariance N."""

    H: Array
    g: Array
    N: Array

    def plus(self, other: Sums, weight: float) -> Sums:
        """With another date's, which weighs so much."""
        kept = 1 - weight
        return Sums(
            kept * self.H + weight * other.H,
            kept * self.g + weight * other.g,
            kept**2 * self.N + weight**2 * other.N,
        )


class Solved(NamedTuple):
    """Shifts and their covariance by noise alone, NaN in hidden ones; `test`: (T, rank)."""

    shift: Array
    noise: Array
    test: tuple[float, int]


def chart(subjects: Sequence[Subject], level: float, weight: float = WEIGHT) -> Chart:
    """The chart of all that the old calibration holds; `level`: the chance that anything is beyond
    its limit at a date while nothing changed."""
    from scipy.special import chdtrc, ndtri

    first = subjects[0]
    shared = np.flatnonzero(first.shared)
    old = first.covariance[np.ix_(shared, shared)]
    each = [sums_of(s) for s in subjects]
    course, total = [], Sums(*(np.zeros_like(part) for part in each[0]))
    for own in each:
        total = total.plus(own, weight)
        course.append(solved(total, old))
    alone = [solved(own, old) for own in each]
    tests = [s.test for s in course]
    p = np.array([float(chdtrc(k, T)) if k else 1.0 for T, k in tests])
    beyond = -float(ndtri(level / 4 / max(len(shared), 1)))
    lines = []
    for k, i in enumerate(shared):
        limit = beyond * np.sqrt([s.noise[k] + old[k, k] for s in course])
        line = Line(
            first.problem.names[i],
            float(np.sqrt(old[k, k])),
            np.array([s.shift[k] for s in alone]),
            np.sqrt([s.noise[k] for s in alone]),
            np.array([s.shift[k] for s in course]),
            np.asarray(limit),
        )
        if np.isfinite(line.mean).any():
            lines.append(line)
    return Chart(tuple(lines), p, level / 2)


def sums_of(subject: Subject) -> Sums:
    """One date's normal equations in the shared unknowns, its own directions projected out."""
    shared = np.flatnonzero(subject.shared)
    factor = subject.rows.factor(subject.point)
    R = beside(factor.R, subject.free)[:, shared]
    H = R.T @ R
    return Sums(H, R.T @ factor.b, subject.noise.sigma**2 * H)


def solved(sums: Sums, old: Array) -> Solved:
    """Shifts of the unknowns, what of them noise makes, and T of their being none; `old`
    covariance of the values that they count from."""
    size = np.sqrt(np.diag(sums.H))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(sums.H / np.outer(size, size))
    keep = values > SEEN * max(values.max(initial=0.0), 1e-300)
    half = vectors[:, keep] / values[keep]
    inverse = (half @ vectors[:, keep].T) / np.outer(size, size)
    shift, noise = -inverse @ sums.g, inverse @ sums.N @ inverse
    hidden = np.sum(vectors[:, ~keep] ** 2, axis=1) > 1e-12
    told = (half.T / size) @ sums.g
    V = (half.T / size) @ (sums.N + sums.H @ old @ sums.H) @ (half.T / size).T
    T = float(told @ np.linalg.solve(V, told)) if len(told) else 0.0
    diagonal = np.diag(noise)
    return Solved(
        np.where(hidden, np.nan, shift), np.where(hidden, np.nan, diagonal), (T, len(told))
    )
