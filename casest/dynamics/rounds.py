"""A nonlinear model along a record of any length: filter and rounds of its smoother, in pieces.

As in `course`: the filter keeps where it was at the beginning of every piece, and what readings
after a piece tell of its end is all that goes from one to the one before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import continued, ended, kalman, smoothed_before
from casest.dynamics.extended import beginning, extended_step, given, pieces, relinearised, told
from casest.dynamics.stepping import unpacked
from casest.dynamics.transition import Pace

#: Samples, and of each x (…, n), P (…, n, n), innovations (…, m) and their covariance (…, m, m).
Piece = tuple[slice, Array, Array, Array, Array]


def filtered(model: Dynamics, run: Run, pace: Pace, cuts: Sequence[slice]) -> Iterator[Piece]:
    """The extended filter; `cuts` share their ends, the first sample of each but the first is left
    out."""
    n, m = model.size, model.traced.h.numel()
    step, state = extended_step(model, pieces(model, run, pace)), beginning(model)
    for where in cuts:
        parts, present = given(model, run.take(where), pace.part(where))
        first = int(where.start > 0)
        states, after, _, said = step(state, [p[first:] for p in parts])
        state = states[-1].copy()
        own = slice(where.start + first, where.stop)
        yield own, *unpacked(after, n), *told(said, present[first:], m)


def smoothed(
    model: Dynamics, run: Run, pace: Pace, cuts: Sequence[slice], along: Array
) -> Iterator[tuple[slice, Array, Array]]:
    """Samples, states and covariances by the whole record, linearised along states (N, n); from the
    last piece to the first."""
    begun: list[Array | None] = [None]
    for where in cuts[:-1]:
        steps = relinearised(model, run.take(where), along[where], pace=pace.part(where))
        begun.append(ended(steps, begun[-1], model.start, model.start_covariance))
    n = model.size
    later = np.zeros(n * n + 2 * n)
    for where, state in zip(cuts[::-1], begun[::-1], strict=True):
        steps = relinearised(model, run.take(where), along[where], pace=pace.part(where))
        if state is None:
            own = kalman(steps, model.start, model.start_covariance)
        else:
            own = continued(steps, state)
        if where is cuts[-1]:
            yield slice(where.stop - 1, where.stop), own.x[-1:], own.P[-1:]
        factored = own.factored if state is None else np.vstack([state, own.factored])
        x, P, later = smoothed_before(steps, factored[:-1], later)
        yield slice(where.start, where.stop - 1), x, P
