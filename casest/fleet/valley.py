"""Which sensors must be calibrated alone: those whose own rows leave open which valley is right.

A sensor stays with the others where its rows vouch for the fit (`estimate.evidence`) and starts
around its own, those of `solve.strategy`, find nothing lower and nothing else that fits alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.estimate.evidence import Evidence
from casest.estimate.reasons import MANY_ONLY, Code
from casest.estimate.valley import rows_can_follow
from casest.fleet.fit import Bounds, Fits, Flags, Places, minimise, padded
from casest.fleet.judge import Judge
from casest.fleet.neighbours import scatters
from casest.fleet.sums import Sensors, Squares
from casest.fleet.verdicts import Judged
from casest.leastsquares.problem import Point, Problem
from casest.solve.aliases import folded
from casest.solve.arguments import arguments_of
from casest.solve.outcome import Outcome
from casest.solve.strategy import APART, STARTS, around

#: With these there is nothing that could be searched.
HOPELESS = Code.READING | Code.NO_REDUNDANCY


class Ended(NamedTuple):
    """W sensors with where they began (n, W), where they ended, and the bounds between."""

    sensors: Sensors
    begin: Array
    fits: Fits
    bounds: Bounds

    def some(self, k: Places) -> Ended:
        """Those of the sensors at these places."""
        fits, bounds = self.fits.some(k), self.bounds.some(k)
        return Ended(self.sensors.some(k), self.begin[:, k], fits, bounds)


@dataclass(frozen=True)
class Doubt:
    """Asked of models that `estimate.valley` searches. `stated`: starts are the user's own."""

    model: Model
    squares: Squares
    judge: Judge
    stated: bool

    def __call__(
        self, ended: Ended, judged: Judged, runs: Callable[[int], Run], count: int
    ) -> Flags:
        """Is the valley of the first `count` of W sensors in doubt? `runs` gives their records."""
        hopeless = (judged.code & int(HOPELESS)) != 0
        # What only many are asked stands, wherever the rows vouch for the fit.
        doubtful = (judged.code & ~int(MANY_ONLY)) != 0
        unseen = np.zeros_like(doubtful)
        for k in _left(~doubtful & ~hopeless):
            some = ended.some(k)
            found = scatters(self.model, some.fits.x, some.fits.cost, some.sensors)
            unseen[k] = [s is None for s in found]
            doubtful[k] = [s is not None and not Evidence(s).vouched for s in found]
        for k in _left(~doubtful & ~hopeless):
            doubtful[k] = self._elsewhere(ended.some(k), unseen[k])
        if not self.stated and any(n.periodic for n in arguments_of(self.model).nodes):
            for i in np.flatnonzero(~doubtful[:count] & ~hopeless[:count]):
                doubtful[i] = self._turns(ended, int(i), runs(int(i)))
        return np.asarray((doubtful & ~hopeless)[:count])

    def _elsewhere(self, ended: Ended, unseen: Flags) -> Flags:
        """Do starts around that of each sensor, or the declared one, end lower, or elsewhere alike?

        Where its rows show no scatter (`unseen`), all must end at one cost.
        """
        normals = self.squares.normals(ended.begin, ended.sensors)
        diagonal = np.einsum("iis->is", normals.matrix)
        steps = list(around(ended.begin, normals.cost, diagonal))
        near, far = steps[:STARTS], steps[STARTS:]
        if self.stated:
            declared = np.concatenate([p.start_value() for p in self.model.parameters])
            near.append(declared[:, None] - ended.begin)
        rivalled, several = self._ends(ended, near)
        # One valley more is a reason to look for others.
        for k in _left(several & ~rivalled):
            rivalled[k] = self._ends(ended.some(k), [s[:, k] for s in far])[0]
        return np.asarray(rivalled | (unseen & several))

    def _ends(self, ended: Ended, steps: Sequence[Array]) -> tuple[Flags, Flags]:
        """Is there a rival of the fit, and are there several costs, (W,) each?"""
        here = ended.fits
        rivalled, several = np.zeros((2, len(here.cost)), bool)
        for step in steps:
            start = ended.bounds.inside(ended.begin + step)
            other = minimise(self.squares, ended.sensors, start, ended.bounds, near=False)
            rivalled |= self.judge.rivalled(ended.sensors, here, other)
            low, high = np.minimum(here.cost, other.cost), np.maximum(here.cost, other.cost)
            several |= np.isfinite(high) & (high > low * (1 + APART) + 1e-300)
        return rivalled, several

    def _turns(self, ended: Ended, i: int, run: Run) -> bool:
        """May a sine's argument be told another way: turns fewer between rows, or in its phase?"""
        problem = Problem(self.model, (run,))
        first, there = (Point(x[:, i], np.zeros(0)) for x in (ended.begin, ended.fits.x))
        best = Outcome("many", there, float(ended.fits.cost[i]), 0, 0, True, "", 0.0)
        follow = rows_can_follow(problem, first, self.stated)
        return not follow(there) or bool(folded(problem, first, best))


def _left(chosen: Flags) -> list[Places]:
    """The chosen places in one group that NumPy handles alike, if there are any."""
    k = np.flatnonzero(chosen)
    return [padded(k)] if k.size else []
