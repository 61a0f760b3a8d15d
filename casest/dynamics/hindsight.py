"""A linear model with uncertain inputs along a record of any length, filter and smoother in passes.

The passes of `filter.filtered`, each in pieces as in `course`: beside the record and the result,
the states that a pass goes along are kept, and what can differ from zero of the noise that acts on
their errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import (
    Brief,
    Steps,
    after_readings,
    ended,
    smoothed_before,
    std_of,
    unfactored,
)
from casest.dynamics.filter import ALIKE, PASSES, discretised, share_left
from casest.dynamics.inputs import estimates, on_errors_alone, whole
from casest.dynamics.known import known, shown
from casest.dynamics.transition import Pace, linearised


@dataclass
class Along:
    """States x (N, n) that a pass goes along, and what acts on their errors, (N, …) as
    `inputs.whole` takes it; None: nothing does."""

    x: Array
    acting: Array | None

    def put(self, where: slice, x: Array, acting: Array) -> None:
        """For the next pass."""
        if self.acting is None:
            self.acting = np.empty((len(self.x), acting.shape[1]))
        self.x[where], self.acting[where] = x, acting


@dataclass(frozen=True)
class Passes:
    """A record in pieces that share their ends, inputs as they most likely were (N, k) by name."""

    model: Dynamics
    run: Run
    pace: Pace
    cuts: Sequence[slice]
    inputs: Mapping[str, Array]

    @staticmethod
    def of(model: Dynamics, run: Run, pace: Pace, cuts: Sequence[slice]) -> Passes:
        """`pace` with the shares of all samples."""
        return Passes(model, run, pace, cuts, estimates(model, run))

    def steps(self, where: slice, along: Along) -> Steps:
        """A piece in discrete time."""
        model, inputs = self.model, {name: part[where] for name, part in self.inputs.items()}
        own, pace = self.run.take(where), self.pace.part(where)
        system = linearised(model, own, along.x[where], pace, inputs)
        if along.acting is not None:
            system = system.driven(system.process + whole(model, along.acting[where]))
        return discretised(model, system)

    def first(self) -> Along:
        """What the last of the filter's passes goes along: the estimates of the one before."""
        n = self.model.size
        start = np.broadcast_to(self.model.start, (len(self.run), n))
        along, later = Along(start, None), Along(np.empty(start.shape), None)
        std = np.concatenate([s for s in self._filtered(along, later)])
        for _ in range(PASSES):
            along, later = later, Along(np.empty(start.shape), None)
            place, change = 0, list[float]()
            for own in self._filtered(along, later):
                before = std[place : place + len(own)]
                change.append(float(np.max(np.abs(own / before - 1))))
                before[:] = own
                place += len(own)
            if np.max(change) < ALIKE:
                break
        return along

    def _filtered(self, along: Along, later: Along) -> Iterator[Array]:
        """Standard deviations of the filter, piece by piece; its states are for the next pass."""
        model, state = self.model, None
        for where in self.cuts:
            steps = self.steps(where, along)
            begun = state is None
            x, P, state = after_readings(steps, state, model.start, model.start_covariance)
            own = where if begun else slice(where.start + 1, where.stop)
            x, P = known(model, self.run.take(own), x, P)
            later.put(own, x, self.acting(own, x, P))
            yield std_of(P)

    def acting(self, where: slice, x: Array, P: Array) -> Array:
        """What the noise of uncertain inputs adds to Ξ by acting on errors with covariances P."""
        found = on_errors_alone(self.model, self.run.take(where), x, P)
        assert self.pace.share is not None
        return np.asarray(self.pace.share[where][:, None] * found)

    def smooth(
        self,
        along: Along,
        filtered: Callable[[slice, Brief], None],
        smoothed: Callable[[slice, Array, Array], None],
    ) -> tuple[float, Array]:
        """Filter and smoother, handed over piece by piece; the next pass goes along its states.

        The filter with the samples that it is of, states (…, n) and their std of the smoother.
        Returned: the largest change of a state from those that it went along, in their std, and
        where the filter came to, as factored.
        """
        *ends, end = self._ends(along)
        told = np.zeros(self.model.size * (self.model.size + 2))
        steps, change = self.steps(self.cuts[-1], along), list[float]()

        def put(where: slice, x: Array, P: Array) -> None:
            x, P = known(self.model, self.run.take(where), x, P)
            std = std_of(P)
            smoothed(where, x, std)
            moved = np.abs(x - along.x[where]) / np.maximum(std, 1e-300)
            change.append(float(np.max(moved)))
            along.put(where, x, self.acting(where, x, P))

        for k in range(len(self.cuts) - 1, -1, -1):
            where, state = self.cuts[k], ends[k]
            own = shown(self.model, self.run, where, steps, state)
            filtered(slice(where.stop - len(own.x), where.stop), own)
            factored = own.factored if state is None else np.vstack([state, own.factored])
            x, P, told = smoothed_before(steps, factored[:-1], told)
            if k:  # before what it goes along is no more
                steps = self.steps(self.cuts[k - 1], along)
            if where.stop == len(self.run):
                last = unfactored(factored[-1:], self.model.size)
                put(slice(where.stop - 1, where.stop), *last)
            put(slice(where.start, where.stop - 1), x, P)
        assert end is not None
        return float(np.max(change)), end

    def least(self, along: Along, end: Array) -> float:
        """See `Filtered.least`, after a pass that left these states and came to this end."""
        without = self._ends(Along(along.x, None))[-1]
        assert without is not None
        last = self.run.take(slice(len(self.run) - 1, len(self.run)))
        x, P = unfactored(np.stack([end, without]), self.model.size)
        (one, *_), (other, *_) = (known(self.model, last, x[[k]], P[[k]])[1] for k in (0, 1))
        return share_left(one, other)

    def _ends(self, along: Along) -> list[Array | None]:
        """Where the filter has come to at the beginning of every piece, and at the end."""
        found: list[Array | None] = [None]
        for where in self.cuts:
            steps = self.steps(where, along)
            found.append(ended(steps, found[-1], self.model.start, self.model.start_covariance))
        return found
