"""What is known of the state without noise, put into the estimates.

Each estimate is moved onto the constraint, by its covariance (estimate projection: Simon & Chia
2002). The filter runs on without it: fed back, a constraint that holds at every instant is counted
again at every sample, with a slope that changes as the estimate does, and a curved one soon makes
the filter sure of what it cannot know.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import (
    Brief,
    Packed,
    Steps,
    brief,
    continued,
    kalman,
    normalised,
    std_of,
)
from casest.dynamics.samples import over_samples, replay
from casest.engine import Replay
from casest.errors import UsageError

#: Rounds of Newton's method towards the constraint, and the change in standard deviations that
#: ends them.
ROUNDS, SETTLED = 20, 1e-9


def known(model: Dynamics, run: Run, x: Array, P: Array) -> tuple[Array, Array]:
    """States x (N, n) with covariances P (N, n, n), given that the constraints hold.

    The most probable state on the constraint; the covariance keeps what the constraint's curvature
    hides.
    """
    if model.traced.limited:
        raise UsageError(
            f"{model.name}: a filter does not keep constraint(…, at_least=…): give the state "
            "bounds= and filter with --horizon"
        )
    count = model.traced.g.numel()
    if not count:
        return x, P
    signals = [run.signals[s.name] for s in model.signals]
    std = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-300))
    at = x
    for _ in range(ROUNDS):
        g, G, H = over_samples(_constraints(model), [np.ascontiguousarray(at), *signals])
        PG = P @ G.transpose(0, 2, 1)
        H = H.reshape(len(x), count, model.size, model.size)
        S = G @ PG
        left = g + G @ (x - at)[:, :, None]
        before, at = at, x - (PG @ _solved(S, left))[:, :, 0]
        if np.max(np.abs(at - before) / std) < SETTLED:
            break
    HP = H @ P[:, None]
    hidden = 0.5 * np.trace(HP @ HP, axis1=2, axis2=3)
    S[:, np.arange(count), np.arange(count)] += hidden
    after = P - PG @ _solved(S, PG.transpose(0, 2, 1))
    return at, 0.5 * (after + after.transpose(0, 2, 1))


def shown(
    model: Dynamics, run: Run, where: slice, steps: Steps | Packed, state: Array | None
) -> Brief:
    """What is shown of the filter over a piece of the record, with what is known put in.

    From `state` of the piece's first sample, which is left out (and more along the way: `brief`);
    None: from the start.
    """
    if not model.traced.g.numel():
        return brief(steps, state, model.start, model.start_covariance)
    assert isinstance(steps, Steps)
    if state is None:
        own = kalman(steps, model.start, model.start_covariance)
    else:
        own = continued(steps, state if state.ndim == 1 else state[0])
    x, P = known(model, run.take(slice(where.stop - len(own.x), where.stop)), own.x, own.P)
    squares = normalised(own.innovations, own.S)
    return Brief(x, std_of(P), own.innovations, std_of(own.S), squares, own.factored)


@lru_cache(maxsize=8)
def _constraints(model: Dynamics) -> Replay:
    """g, its slopes and its second derivatives, at a sample."""
    t = model.traced
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in model.signals])
    bends = [ca.hessian(one, t.x)[0] for one in ca.vertsplit(t.g)]
    return replay(sample, [t.g, t.G, ca.vertcat(*bends)])


def _solved(S: Array, right: Array) -> Array:
    """S⁻¹·right, and nothing where the constraint is already certain."""
    size = np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), 1e-300))[:, :, None]
    even = S / size / size.transpose(0, 2, 1)
    return np.asarray(np.linalg.pinv(even, rcond=1e-12) @ (right / size) / size)
