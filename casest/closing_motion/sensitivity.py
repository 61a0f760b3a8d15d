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

from casest.closing_motion.effects import Candidate, extended
from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.filter import Filtered
from casest.dynamics.transition import Linearised, steps_to, transitions
from casest.engine import Columns, Replay
from casest.modelling.tracing import flat


@dataclass(frozen=True)
class Sensitivity:
    """Whitened innovations z (N, m), their answers H (N, m, p) to p numbers, X (N, n, p).

    ν(k) = ν − L·H·k with LLᵀ = S, the covariance of an innovation; `L` (N, m, m). Missing
    readings are zero in z and H. `columns`: where each candidate's numbers are.
    """

    z: Array
    H: Array
    L: Array
    X: Array
    columns: tuple[slice, ...]


def sensitivity(
    model: Dynamics,
    added: Sequence[tuple[Candidate, Array]],
    tried: Sequence[Candidate],
    run: Run,
    found: Filtered,
) -> Sensitivity:
    """Answers of the innovations of `found`, the filter of a model with effects `added`, to the
    numbers of `tried`: further candidates at zero, or those that are added at their values."""
    F, G, columns = _slopes(model, added, tried, run, found.smoothed)
    system = found.system
    present = np.isfinite(system.y)
    C = np.where(present[:, :, None], system.C, 0.0)
    G = np.where(present[:, :, None], G, 0.0)
    m = C.shape[1]
    R = np.diag(found.model.noise)[None] / steps_to(system)[:, None]
    PC = found.predicted_P @ C.transpose(0, 2, 1)
    S = C @ PC
    S[:, np.arange(m), np.arange(m)] += R
    K: Array = np.linalg.solve(S, PC.transpose(0, 2, 1)).transpose(0, 2, 1).astype(float)
    X, H = _answers(transitions(system)[0], _over_steps(system, F), C, G, K)
    L: Array = np.asarray(np.linalg.cholesky(S), float)
    nu = np.where(present, found.innovations, 0.0)
    z: Array = np.asarray(np.linalg.solve(L, nu[:, :, None])[:, :, 0], float)
    return Sensitivity(z, np.asarray(np.linalg.solve(L, H), float), L, X, columns)


def _slopes(
    model: Dynamics,
    added: Sequence[tuple[Candidate, Array]],
    tried: Sequence[Candidate],
    run: Run,
    along: Array,
) -> tuple[Array, Array, tuple[slice, ...]]:
    """F = ∂f/∂k (N, n, p) and G = ∂h/∂k (N, m, p) along states of the filter (N, ≥ n)."""
    held = [(c, v) for c, v in added if c not in tried]
    at = [next((v for c, v in added if c is t), np.zeros(t.size)) for t in tried]
    n, F, G = model.size, list[Array](), list[Array]()
    columns, place = [], 0
    for candidate, value in zip(tried, at, strict=True):
        others = [(c, v) for c, v in zip(tried, at, strict=True) if c is not candidate]
        others = [(c, v) for c, v in others if np.any(v)]
        free = extended(model, [*held, *others, (candidate, None)])
        t = free.traced
        k = t.x[n:]
        wanted = [ca.densify(ca.jacobian(e, k)) for e in (t.f[:n], t.h)]
        sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in free.signals])
        function = ca.Function("slopes", [ca.SX.sym("none", 0), sample], wanted,
                               ["parameters", "sample"], ["F", "G"])  # fmt: skip
        x = np.hstack([along[:, :n], np.broadcast_to(value, (len(along), candidate.size))])
        parts = Columns([np.ascontiguousarray(x), *(run.signals[s.name] for s in free.signals)])
        of_f, of_h = Replay(function)(np.zeros(0), parts)
        F.append(of_f)
        G.append(of_h)
        columns.append(slice(place, place + candidate.size))
        place += candidate.size
    wide = along.shape[1] - n  # states of coloured noise, which nothing else drives
    joined = np.concatenate(F, axis=2)
    return np.pad(joined, ((0, 0), (0, wide), (0, 0))), np.concatenate(G, axis=2), tuple(columns)


def _over_steps(system: Linearised, F: Array) -> Array:
    """∫Φ(t₁, s)F(s) ds of every step, (N − 1, n, p): Simpson's rule."""
    h = system.steps[:, None, None]
    Phi, half = transitions(system)[0], transitions(system, (0.5, 1.0))[0]
    return np.asarray(h / 6 * (Phi @ F[:-1] + 2 * half @ (F[:-1] + F[1:]) + F[1:]))


def _answers(Phi: Array, pushed: Array, C: Array, G: Array, K: Array) -> tuple[Array, Array]:
    """X after each reading and H = CX + G before it."""
    N, n, p = len(C), C.shape[2], G.shape[2]
    X, H = np.zeros((N, n, p)), np.empty((N, C.shape[1], p))
    x = np.zeros((n, p))
    for k in range(N):
        if k:
            x = Phi[k - 1].dot(x)
            x += pushed[k - 1]
        H[k] = h = C[k].dot(x) + G[k]
        X[k] = x = x - K[k].dot(h)
    return X, H
