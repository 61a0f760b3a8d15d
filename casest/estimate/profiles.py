"""Profiles of the likelihood, to be drawn where the cost is no parabola."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.estimate import Estimate
from casest.estimate.profile_likelihood import Profile

#: How far twice the cost rises over σ² in what is drawn, points on the way there each way if it is
#: a parabola, and at most.
HIGH, POINTS, MOST = 9.0, 8, 24
#: Rise over that of the parabola, from a rise of one on, within which it is one.
PARABOLA = (0.7, 1 / 0.7)


@dataclass(frozen=True)
class Drawn:
    """One unknown: its value (k,), and how far twice the cost has risen there over σ² while all
    others are fitted again; `parabola` (k,) is what standard deviations suppose."""

    name: str
    unit: str
    value: Array
    rise: Array
    parabola: Array

    @property
    def bent(self) -> bool:
        """Is it no parabola?"""
        far = (self.rise > 1) | (self.parabola > 1)
        ratio = self.rise[far] / np.maximum(self.parabola[far], 1e-300)
        return bool(np.any((ratio < PARABOLA[0]) | (ratio > PARABOLA[1])))


def profiles(estimate: Estimate) -> list[Drawn]:
    """The profile of every unknown that is a plain number on no bound; of a trusted estimate.

    The other unknowns are fitted again at every point, from the last one on, up to a bound.
    """
    problem, around = estimate.problem, estimate.around
    curved = {
        i for s in problem.slots if s.parameter.shape.curved for i in range(s.x.start, s.x.stop)
    }
    found = []
    with np.errstate(all="ignore"):
        for j in sorted(set(np.flatnonzero(estimate.free).tolist()) - curved):
            away, rise = _curve(around, j)
            value, parabola = around.best.x[j] + away, away**2 / around.covariance[j, j]
            found.append(Drawn(problem.names[j], problem.units[j], value, rise, parabola))
    return found


def _curve(around: Profile, j: int) -> tuple[Array, Array]:
    """Distances from the best value of unknown j, and the rises there, in order."""
    step = float(np.sqrt(HIGH * around.covariance[j, j])) / POINTS
    found = [(0.0, 0.0)]
    for sign in (-1, 1):
        distances = np.asarray(sign * step * np.arange(1.0, MOST + 1))
        for distance, rise in zip(distances, around.outwards(j, distances), strict=False):
            if not np.isfinite(rise):
                break
            found.append((distance, max(rise, 0.0)))
            if rise >= HIGH:
                break
    away, rises = np.array(sorted(found)).T
    return away, rises
