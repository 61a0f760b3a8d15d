"""States of a linear window within bounds: the nearest to what readings say that keep to them.

Without bounds the states are x with covariance Σ; within A·x ≥ b they are x + ΣAᵀλ with the
multipliers λ ≥ 0 that make ½λᵀAΣAᵀλ − λᵀ(b − A·x) least: λ is zero where there is room (Karush,
Kuhn & Tucker). As a least-distance problem it is one of nonnegative least squares (Lawson & Hanson
1974, ch. 23), in as many unknowns as bounds are met, whatever the window's length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics.discrete import Steps
from casest.dynamics.record import equations

#: Violation, in standard deviations, that is rounding; rounds in which bounds are met.
ROUNDING, ROUNDS = 1e-10, 50


@dataclass(frozen=True)
class Kept:
    """States (K, n) of a window that keep to their bounds, None where there are none that do.

    `multipliers` (K, 2, n) of lower and upper bounds, zero where there is room; `known` (K, n, n):
    what covariances lose where bounds act; `worst`: sample and number that leave their bounds most.
    """

    states: Array | None
    multipliers: Array
    known: Array
    worst: tuple[int, int]


def kept(steps: Steps, covariance: Array, x: Array, bounds: tuple[Array, Array]) -> Kept | None:
    """The states of a window within bounds (n,) each; None where they are so already.

    `x` (K, n) without them, by readings and by what was known before with `covariance` (n, n).
    """
    lower, upper = bounds
    if np.all((x >= lower) & (x <= upper)):
        return None
    from scipy.sparse.linalg import splu

    factor, (K, n) = splu(equations(steps, covariance)), x.shape
    away = np.stack([lower - x, x - upper], axis=1)
    more = np.argwhere(away > 0)
    met, force = more[:0], np.zeros(0)
    for _ in range(ROUNDS):
        met = np.vstack([met, more])
        columns = _columns(factor, met, (K, n))
        sign = np.where(met[:, 1] == 0, 1.0, -1.0)
        W = sign[:, None] * columns[met[:, 0], met[:, 2]] * sign
        said = _multipliers(W, away[tuple(met.T)])
        if said is None:
            k, _, i = met[np.argmax(away[tuple(met.T)])]
            return Kept(None, np.zeros((K, 2, n)), np.zeros((K, n, n)), (int(k), int(i)))
        force = said
        found = x + columns @ (sign * force)
        left = np.stack([lower - found, found - upper], axis=1)
        left[tuple(met.T)] = 0.0
        more = np.argwhere(left > ROUNDING * np.sqrt(np.diag(W).max()))
        if not len(more):
            break
    return _on_bounds(found, bounds, met, force, sign * columns, W)


def _on_bounds(
    found: Array, bounds: tuple[Array, Array], met: Any, force: Array, columns: Array, W: Array
) -> Kept:
    """States found, those whose bound acts exactly on it."""
    (K, n), acting = found.shape, np.flatnonzero(force > 0)
    k, which, i = met[acting].T
    multipliers = np.zeros((K, 2, n))
    multipliers[k, which, i] = force[acting]
    found = np.clip(found, *bounds)
    found[k, i] = np.where(which == 0, bounds[0][i], bounds[1][i])
    B, inner = columns[:, :, acting], np.linalg.pinv(W[np.ix_(acting, acting)])
    return Kept(found, multipliers, B @ inner @ B.transpose(0, 2, 1), (0, 0))


def _columns(factor: Any, met: Any, shape: tuple[int, int]) -> Array:
    """Covariances (K, n, p) of all states with those at (p, 3): sample, which bound, number."""
    K, n = shape
    right = np.zeros((K, 2, n, len(met)))
    right[met[:, 0], 0, met[:, 2], np.arange(len(met))] = 1.0
    solved = factor.solve(right.reshape(2 * K * n, -1))
    return np.asarray(solved.reshape(K, 2, n, -1)[:, 0])


def _multipliers(W: Array, away: Array) -> Array | None:
    """λ ≥ 0 with Wλ ≥ away, and λ zero where it is more; None where there is none.

    A bound that nothing uncertain moves has no variance: it cannot be kept.
    """
    from scipy.optimize import nnls

    std = np.sqrt(np.maximum(np.diag(W), 1e-300))
    scaled, wanted = W / np.outer(std, std), away / std
    values, vectors = np.linalg.eigh(scaled)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    size = max(float(np.max(np.abs(wanted))), 1e-300)
    E = np.vstack([root.T, wanted / size])
    aim = np.zeros(len(E))
    aim[-1] = 1.0
    u, length = nnls(E, aim)
    if not length > 1e-12:
        return None
    acting = np.flatnonzero(u > 0)
    exact = np.linalg.lstsq(scaled[np.ix_(acting, acting)], wanted[acting], rcond=1e-13)[0]
    found = np.zeros(len(W))
    found[acting] = np.maximum(exact, 0.0)
    return found / std
