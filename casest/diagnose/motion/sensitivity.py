"""How the innovations of a filter answer to constant numbers that its model lacks.

The innovations of a linear filter are linear in such numbers, so that one pass tells all: with
ẋ = Ax + c + F·k and y = Cx + d + G·k the sensitivities X = ∂x̂/∂k and H = −∂ν/∂k run through the
filter beside the state. H whitened by the innovations' covariance is a least-squares problem in
which the states are already marginal: its score test is exact (Willsky & Jones 1976).
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.motion.slopes import batches, slopes
from casest.dynamics.declare import Dynamics
from casest.dynamics.filter import Filtered
from casest.dynamics.transition import variances
from casest.effects.moving import Candidate
from casest.engine import Compiled, chained

#: Numbers that are worked on at once, as values of slopes along a record.
TOGETHER = 4_000_000


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
    `begun` and `ended` (N − 1, n, n): what a push at the beginning and at the end of a step does by
    its end, if it is a straight line between (Simpson's rule).
    """

    C: Array
    K: Array
    L: Array
    left: Array
    Phi: Array
    later: Array
    begun: Array
    ended: Array
    back: Array
    z: Array
    present: NDArray[np.bool_]


#: Of the filter that was looked at last: all candidates are, one after the other.
_LATEST: list[tuple[Callable[[], Filtered | None], Gains]] = []


def gains(found: Filtered) -> Gains:
    """Of a filter; kept until another one is looked at, or it is no more."""
    for filter_of, known in _LATEST:
        if filter_of() is found:
            return known
    own = _gains(found)
    _LATEST[:] = [(weakref.ref(found, lambda _: _LATEST.clear()), own)]
    return own


def _gains(found: Filtered) -> Gains:
    system = found.system
    present = np.isfinite(system.y)
    C = np.where(present[:, :, None], system.C, 0.0)
    m, n = C.shape[1:]
    R = variances(found.model, system.steps)
    PC = found.predicted_P @ C.transpose(0, 2, 1)
    S = C @ PC
    S[:, np.arange(m), np.arange(m)] += R
    K: Array = np.linalg.solve(S, PC.transpose(0, 2, 1)).transpose(0, 2, 1).astype(float)
    L: Array = np.asarray(np.linalg.cholesky(S), float)
    nu = np.where(present, found.innovations, 0.0)
    back = np.asarray(np.linalg.inv(L), float)
    z = np.asarray((back @ nu[:, :, None])[:, :, 0], float)
    left = np.eye(n) - K @ C
    Phi, half, sixth = system.moved[0], 2 * system.later_half, system.steps[:, None, None] / 6
    begun, ended = sixth * (Phi + half), sixth * (half + np.eye(n))
    return Gains(C, K, L, left, Phi, left[1:] @ Phi, begun, ended, back, z, present)


def sensitivity(
    model: Dynamics,
    added: Sequence[tuple[Candidate, Array]],
    tried: Sequence[Candidate],
    run: Run,
    found: Filtered,
) -> Sensitivity:
    """Answers of the innovations of `found`, the filter of a model with effects `added`, to the
    numbers of `tried`: further candidates at zero, or those that are added at their values."""
    g, ends = gains(found), np.cumsum([0, *(c.size for c in tried)]).tolist()
    count, n = ends[-1], g.C.shape[2]
    H, moves = np.empty((*g.z.shape, count)), np.empty((n, count))
    columns = [slice(a, b) for a, b in pairwise(ends)]
    together = max(1, TOGETHER // (len(g.z) * n))
    for several in batches(added, tried, together):
        where = np.concatenate([np.arange(count)[columns[k]] for k in several])
        F, G = slopes(model, added, [tried[k] for k in several], run, found.smoothed, list(tried))
        H[:, :, where], moves[:, where] = _answers(g, F, G)
    return Sensitivity(g.z, H, g.L, moves, tuple(columns))


#: before: what a number does to the state before a reading; X: after it.
_SOURCE = """
static void add(double *to, const double *M, const double *x, long r, long n, long p, int less) {
  for (long i = 0; i < r; ++i)
    for (long l = 0; l < n; ++l) {
      const double own = less ? -M[i * n + l] : M[i * n + l];
      for (long j = 0; j < p; ++j) to[i * p + j] += own * x[l * p + j];
    }
}
void casest_answers(const double *Phi, const double *begun, const double *ended, const double *C,
                    const double *K, const double *back, const double *F, const double *G,
                    double *X, double *own, double *H, double *squares,
                    long count, long n, long m, long p, long pushed, long first) {
  for (long k = 0; k < count; ++k) {
    double *before = X + (k + 1) % 2 * n * p, *after = X + k % 2 * n * p;
    for (long i = 0; i < n * p; ++i) after[i] = 0;
    if (k) {
      add(after, Phi + (k - 1) * n * n, before, n, n, p, 0);
      if (pushed) {
        add(after, begun + (k - 1) * n * n, F + (k - 1) * n * p, n, n, p, 0);
        add(after, ended + (k - 1) * n * n, F + k * n * p, n, n, p, 0);
      }
    }
    for (long i = 0; i < m * p; ++i) own[i] = G[k * m * p + i];
    add(own, C + k * m * n, after, m, n, p, 0);
    for (long i = 0; i < m * p; ++i) H[k * m * p + i] = 0;
    add(H + k * m * p, back + k * m * m, own, m, m, p, 0);
    add(after, K + k * n * m, own, n, m, p, 1);
    for (long i = 0; k >= first && i < n * p; ++i) squares[i] += after[i] * after[i];
  }
}
"""
_ANSWERS = Compiled("casest_answers", _SOURCE)


def _answers(g: Gains, F: Array, G: Array) -> tuple[Array, Array]:
    """H (N, m, p), and what each number does to the states, rms (n, p), of F = ∂f/∂k (N, n, p) and
    G = ∂h/∂k (N, m, p)."""
    G = np.where(g.present[:, :, None], G, 0.0)
    (count, m, p), n, pushed = G.shape, F.shape[1], bool(F.any())
    first = count // 5
    if _ANSWERS.ready(count):
        H, squares = np.empty(G.shape), np.zeros((n, p))
        given = [g.Phi, g.begun, g.ended, g.C, g.K, g.back, F, G]
        room = [np.empty((2, n, p)), np.empty((m, p)), H, squares]
        given = [np.ascontiguousarray(part, float) for part in given]
        _ANSWERS([*given, *room], [count, n, m, p, int(pushed), first])
        return H, np.sqrt(squares / (count - first))
    met = -(g.K @ G)
    by_steps = g.begun @ F[:-1] + g.ended @ F[1:] if pushed else np.zeros((1, 1, 1))
    if pushed:
        met[1:] += g.left[1:] @ by_steps
    X = chained(g.later, met[1:], met[0])  # after each reading
    G[1:] += g.C[1:] @ (g.Phi @ X[:-1] + by_steps)
    return g.back @ G, np.sqrt(np.mean(X[first:] ** 2, axis=0))


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
    F, G = slopes(model, added, [candidate], run, found.smoothed)
    G = np.where(g.present[:, :, None], G, 0.0)
    said = g.back.transpose(0, 2, 1) @ z
    through = (g.C[1:] @ g.Phi).transpose(0, 2, 1) @ said[1:]
    # λ: of the state after a reading; what comes after the last one is nothing.
    after = np.zeros((len(z), F.shape[1], z.shape[2]))
    after[:-1] = chained(g.later[-2::-1].transpose(0, 2, 1), through[-2::-1], through[-1])[::-1]
    on_step = g.C[1:].transpose(0, 2, 1) @ said[1:] + g.left[1:].transpose(0, 2, 1) @ after[1:]
    own = G.transpose(0, 2, 1) @ (said - g.K.transpose(0, 2, 1) @ after)
    if F.any():
        own[:-1] += F[:-1].transpose(0, 2, 1) @ (g.begun.transpose(0, 2, 1) @ on_step)
        own[1:] += F[1:].transpose(0, 2, 1) @ (g.ended.transpose(0, 2, 1) @ on_step)
    return np.asarray(own)
