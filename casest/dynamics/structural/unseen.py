"""What no record shows of a model, at the states of one record: a bound of what that can tell.

The rank is exact (`structure`); the directions are those of the Lie derivatives' Jacobian at a
state, in floating point, inputs being there what the record has and varying freely from there on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.structural.answer import Structure
from casest.dynamics.structural.floating import Lie, null_space
from casest.dynamics.transition import usual

#: Operations of a derivative of the readings up to which directions are computed.
LARGEST = 20_000
#: Singular values that count must be so many times those that do not for directions to be known.
CLEAR = 1e4
#: Random courses of the inputs that are tried; steps of the record in which inputs change by
#: their own size.
COURSES, SLOW = 4, 10


@dataclass(frozen=True)
class Unseen:
    """Directions that no record shows, at the samples of one.

    `jacobian` of the readings' derivatives at a point, None where that is too long; `inputs` (N, m)
    of the record, `change` (orders, m) the usual size of their derivatives, `clock` (m,) which of
    them are time itself.
    """

    rank: int
    jacobian: Callable[[Array], Any] | None
    inputs: Array
    change: Array
    clock: Array

    @staticmethod
    def of(found: Structure, run: Run) -> Unseen | None:
        """Of a model whose structural rank is exact and less than full; else None."""
        if found.observable or found.rounded:
            return None
        lie, model = Lie(found.model, varying=True), found.model
        parts = [np.asarray(run.signals[n], float).reshape(len(run), -1) for n in lie.inputs]
        inputs = np.hstack([np.zeros((len(run), 0)), *parts])
        sizes = np.sqrt(np.nanmean(np.where(np.isfinite(inputs), inputs, 0.0) ** 2, axis=0))
        sizes = np.where(sizes > 0, sizes, 1.0)
        pace = SLOW * usual(np.diff(np.asarray(run.time, float)))
        change = sizes / pace ** np.arange(found.order + 1)[:, None]
        return Unseen(found.rank, _function(lie, model, found.order), inputs, change, lie.clocks)

    def at(self, x: Array, sample: int) -> Array | int:
        """Directions (n, n − rank) at a state (n,) of a sample; the rank where they are not
        clear."""
        if self.jacobian is None:
            return self.rank
        rng = np.random.default_rng(0)
        for _ in range(COURSES):
            course = self.change * rng.uniform(0.5, 1.5, self.change.shape)
            course *= rng.choice([-1.0, 1.0], course.shape)
            course[0] += np.nan_to_num(self.inputs[sample])
            course[0, self.clock] = self.inputs[sample, self.clock]
            course[1:2, self.clock], course[2:, self.clock] = 1.0, 0.0
            found = np.asarray(self.jacobian(np.concatenate([x, course.ravel()])), float)
            _, gap, null = null_space(found, self.rank)
            if gap > CLEAR:
                return null
        return self.rank


def _function(lie: Lie, model: Dynamics, order: int) -> Callable[[Array], Any] | None:
    for k in range(order + 1):
        if lie.operations(k) > LARGEST:
            return None
    found: Callable[[Array], Any] = lie.function(order)
    return found
