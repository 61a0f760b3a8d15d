"""How the innovations of a filter answer to constant numbers that its model lacks.

The innovations of a linear filter are linear in such numbers, so that one pass tells all: with
ẋ = Ax + c + F·k and y = Cx + d + G·k the sensitivities X = ∂x̂/∂k and H = −∂ν/∂k run through the
filter beside the state. H whitened by the innovations' covariance is a least-squares problem in
which the states are already marginal: its score test is exact (Willsky & Jones 1976).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import linear_recursion
from casest.dynamics.filter import Filtered
from casest.dynamics.transition import Linearised, variances
from casest.effects.moving import Candidate, extended
from casest.engine import Columns, Replay


@dataclass(frozen=True)
class Sensitivity:
    """Whitened innovations z (N, m), their answers H (N, m, p) to p numbers.

    ν(k) = ν − L·H·k with LLᵀ = S, the covariance of an innovation; `L` (N, m, m). Missing
    readings are zero in z and H. `moves` (n, p): what one of each number does to the states, rms.
    `columns`: where each candidate's numbers are.
    """

    z: Array
    H: Array
    L: Array
    moves: Array
    columns: tuple[slice, ...]


@dataclass(frozen=True)
class Gains:
    """A filter along its record, as numbers that its model lacks meet it.

    `left` = I − KC (N, n, n) with the gain K (N, n, m); `later` what a step and the reading after
    it leave of a state (N − 1, n, n); `back` = L⁻¹ of the innovations' covariance LLᵀ (N, m, m); z
    their whitened values (N, m); C (N, m, n) and `present` (N, m) of the readings there are.
    """

    system: Linearised
    C: Array
    K: Array
    L: Array
    left: Array
    later: Array
    back: Array
    z: Array
    present: NDArray[np.bool_]


def gains(found: Filtered) -> Gains:
    """Of a filter."""
    system = found.system
    present = np.isfinite(system.y)
    C = np.where(present[:, :, None], system.C, 0.0)
    m = C.shape[1]
    R = variances(found.model, system.steps)
    PC = found.predicted_P @ C.transpose(0, 2, 1)
    S = C @ PC
    S[:, np.arange(m), np.arange(m)] += R
    K: Array = np.linalg.solve(S, PC.transpose(0, 2, 1)).transpose(0, 2, 1).astype(float)
    L: Array = np.asarray(np.linalg.cholesky(S), float)
    nu = np.where(present, found.innovations, 0.0)
    back = np.asarray(np.linalg.inv(L), float)
    z = np.asarray((back @ nu[:, :, None])[:, :, 0], float)
    left = np.eye(C.shape[2]) - K @ C
    return Gains(system, C, K, L, left, left[1:] @ system.moved[0], back, z, present)


def sensitivity(
    model: Dynamics,
    added: Sequence[tuple[Candidate, Array]],
    tried: Sequence[Candidate],
    run: Run,
    found: Filtered,
) -> Sensitivity:
    """Answers of the innovations of `found`, the filter of a model with effects `added`, to the
    numbers of `tried`: further candidates at zero, or those that are added at their values."""
    g, count = gains(found), sum(c.size for c in tried)
    H, moves = np.empty((*g.z.shape, count)), np.empty((g.C.shape[2], count))
    columns, place = [], 0
    for candidate in tried:  # one after the other: all at once would need much memory
        where = slice(place, place + candidate.size)
        F, G = _slopes(model, added, tried, candidate, run, found.smoothed)
        G = np.where(g.present[:, :, None], G, 0.0)
        pushed = _over_steps(g.system, F)
        # After each reading, and before it.
        X = linear_recursion(g.later, g.left[1:] @ pushed - g.K[1:] @ G[1:], -g.K[0] @ G[0])
        G[1:] += g.C[1:] @ (g.system.moved[0] @ X[:-1] + pushed)
        H[:, :, where] = g.back @ G
        moves[:, where] = np.sqrt(np.mean(X[len(X) // 5 :] ** 2, axis=0))
        columns.append(where)
        place = where.stop
    return Sensitivity(g.z, H, g.L, moves, tuple(columns))


def pushes(
    model: Dynamics,
    added: Sequence[tuple[Candidate, Array]],
    candidate: Candidate,
    run: Run,
    found: Filtered,
    z: Array,
) -> Array:
    """What whitened innovations z (N, m, q) say of each sample's share in a candidate's numbers.

    (N, p, q): Hᵀz of numbers that act at that sample alone, for all samples by one pass backwards
    (the filter's adjoint). Of a step the sum from its sample on, of a line its transform.
    """
    g = gains(found)
    F, G = _slopes(model, added, [], candidate, run, found.smoothed)
    G = np.where(g.present[:, :, None], G, 0.0)
    said = g.back.transpose(0, 2, 1) @ z
    through = (g.C[1:] @ g.system.moved[0]).transpose(0, 2, 1) @ said[1:]
    # λ: of the state after a reading; what comes after the last one is nothing.
    after = np.zeros((len(z), F.shape[1], z.shape[2]))
    after[:-1] = linear_recursion(g.later[-2::-1].transpose(0, 2, 1), through[-2::-1], through[-1])[
        ::-1
    ]
    on_step = g.C[1:].transpose(0, 2, 1) @ said[1:] + g.left[1:].transpose(0, 2, 1) @ after[1:]
    own = G.transpose(0, 2, 1) @ (said - g.K.transpose(0, 2, 1) @ after)
    h = g.system.steps[:, None, None]
    first = h / 6 * (g.system.moved[0] + 2 * g.system.later_half)
    last = h / 6 * (2 * g.system.later_half + np.eye(F.shape[1]))
    own[:-1] += F[:-1].transpose(0, 2, 1) @ (first.transpose(0, 2, 1) @ on_step)
    own[1:] += F[1:].transpose(0, 2, 1) @ (last.transpose(0, 2, 1) @ on_step)
    return np.asarray(own)


def _slopes(
    model: Dynamics,
    added: Sequence[tuple[Candidate, Array]],
    tried: Sequence[Candidate],
    candidate: Candidate,
    run: Run,
    along: Array,
) -> tuple[Array, Array]:
    """F = ∂f/∂k (N, n, p) and G = ∂h/∂k (N, m, p) along states of the filter (N, ≥ n)."""
    n = model.size
    value = next((v for c, v in added if c is candidate), np.zeros(candidate.size))
    others = [(c, v) for c, v in added if c is not candidate and (c not in tried or np.any(v))]
    free = extended(model, [*others, (candidate, None)])
    t = free.traced
    k = t.x[n:]
    wanted = [ca.densify(ca.jacobian(e, k)) for e in (t.f[:n], t.h)]
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in free.signals])
    function = ca.Function("slopes", [ca.SX.sym("none", 0), sample], wanted,
                           ["parameters", "sample"], ["F", "G"])  # fmt: skip
    x = np.hstack([along[:, :n], np.broadcast_to(value, (len(along), candidate.size))])
    parts = Columns([np.ascontiguousarray(x), *(run.signals[s.name] for s in free.signals)])
    F, G = Replay(function)(np.zeros(0), parts)
    wide = along.shape[1] - n  # states of coloured noise, which nothing else drives
    return np.pad(F, ((0, 0), (0, wide), (0, 0))), G


def _over_steps(system: Linearised, F: Array) -> Array:
    """∫Φ(t₁, s)F(s) ds of every step, (N − 1, n, p): Simpson's rule."""
    h = system.steps[:, None, None]
    Phi, half = system.moved[0], system.later_half
    return np.asarray(h / 6 * (Phi @ F[:-1] + 2 * half @ (F[:-1] + F[1:]) + F[1:]))
