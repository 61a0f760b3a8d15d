"""Profiles of the likelihood, to be drawn where the cost is no parabola."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    problem, at = estimate.problem, estimate.optimum or estimate.point
    curved = {
        i for s in problem.slots if s.parameter.shape.curved for i in range(s.x.start, s.x.stop)
    }
    covariance = np.array(estimate.noise.sigma**2 * _inverse(problem.factor(at)[0], estimate.free))
    around = Profile(problem, at, problem.cost(at), covariance, estimate.noise.sigma)
    found = []
    with np.errstate(all="ignore"):
        for j in np.flatnonzero(estimate.free):
            if int(j) in curved:
                continue
            away, rise = _curve(around, int(j))
            parabola = away**2 / covariance[j, j]
            found.append(Drawn(problem.names[j], problem.units[j], at.x[j] + away, rise, parabola))
    return found


def _inverse(R: Array, free: NDArray[np.bool_]) -> Array:
    """(JᵀJ)⁻¹ in the unknowns that are on no bound, zero elsewhere, of the triangular factor."""
    own = np.flatnonzero(free)
    found = np.zeros_like(R)
    found[np.ix_(own, own)] = np.linalg.inv(R[:, own].T @ R[:, own])
    return found


def _curve(around: Profile, j: int) -> tuple[Array, Array]:
    """Distances from the best value of unknown j, and the rises there, in order."""
    step = float(np.sqrt(HIGH * around.covariance[j, j])) / POINTS
    found = [(0.0, 0.0)]
    for sign in (-1, 1):
        here, distance = around.best, 0.0
        for _ in range(MOST):
            distance += step
            there = around.held_at(here, j, sign * distance)
            if there is None:
                break
            rise = 2 * (around.problem.cost(there) - around.cost) / around.sigma**2
            if not np.isfinite(rise):
                break
            found.append((sign * distance, max(rise, 0.0)))
            here = there
            if rise >= HIGH:
                break
    away, rises = np.array(sorted(found)).T
    return away, rises
