"""Kalman filter and fixed-interval smoother in discrete time: matrices in, estimates out.

What a record with a continuous model becomes once its steps are known; also the way in for a model
that is discrete from the beginning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.declaring.shapes import Array
from casest.dynamics.stepping import Pattern, kalman_step, run_steps, unpacked


@dataclass(frozen=True)
class Steps:
    """x(k+1) = Φ x + u + w, w with covariance Q; y = C x + d + v, v with variances R.

    Phi, Q (N − 1, n, n) and forced u (N − 1, n) of every step; C (N, m, n), d, R and y (N, m) of
    every sample, y NaN where a reading is missing. `of_Phi` and `of_C`: which entries can differ
    from zero, where that is known (less work).
    """

    Phi: Array
    forced: Array
    Q: Array
    C: Array
    d: Array
    R: Array
    y: Array
    of_Phi: Pattern | None = None  # noqa: N815
    of_C: Pattern | None = None  # noqa: N815

    @property
    def present(self) -> NDArray[np.bool_]:
        """Which readings there are, (N, m)."""
        return np.asarray(np.isfinite(self.y))

    @property
    def seen(self) -> Array:
        """C without what is missing: a reading that the state does not reach says nothing."""
        return np.where(self.present[:, :, None], self.C, 0.0)

    @property
    def patterns(self) -> tuple[Pattern, Pattern]:
        """Entries of Φ and of C that can differ from zero."""
        every = (self.Phi.shape[1:], self.C.shape[1:])
        known = (self.of_Phi, self.of_C)
        return tuple(tuple(np.ndindex(s)) if p is None else p
                     for s, p in zip(every, known, strict=True))  # type: ignore[return-value] # fmt: skip


@dataclass(frozen=True)
class Estimates:
    """States x (N, n) and covariances P (N, n, n) after each reading and before it.

    innovations y − Cx − d (N, m) and their covariance S (N, m, m), NaN where a reading is missing.
    """

    x: Array
    P: Array
    predicted_x: Array
    predicted_P: Array  # noqa: N815
    innovations: Array
    S: Array


def kalman(steps: Steps, start: Array, covariance: Array) -> Estimates:
    """Kalman filter; `start` (n,) and `covariance` (n, n) hold before the first reading."""
    m, n = steps.C.shape[1:]
    C, R = steps.seen, steps.R
    y = np.where(steps.present, steps.y - steps.d, 0.0)
    Phi = np.concatenate([np.eye(n)[None], steps.Phi])
    forced = np.concatenate([np.zeros((1, n)), steps.forced])
    Q = np.concatenate([np.zeros((1, n, n)), steps.Q])
    state = np.concatenate([start, covariance.T.ravel()])
    step = kalman_step(n, m, *steps.patterns)
    after, before = run_steps(step, state, [Phi, forced, Q, C, R, y])
    (x, P), (before_x, before_P) = unpacked(after, n), unpacked(before, n)
    return Estimates(x, P, before_x, before_P, *_innovations(steps, before_x, before_P))


def _innovations(steps: Steps, x: Array, P: Array) -> tuple[Array, Array]:
    present = steps.present
    ours = np.where(present, steps.y - steps.d - np.einsum("kij,kj->ki", steps.seen, x), np.nan)
    return ours, np.where(present[:, :, None] & present[:, None, :], _spread(steps, P), np.nan)


def _spread(steps: Steps, P: Array) -> Array:
    """Covariance of the innovations; of a missing reading, of its noise alone."""
    m = steps.C.shape[1]
    S = steps.seen @ P @ steps.seen.transpose(0, 2, 1)
    S[:, np.arange(m), np.arange(m)] += steps.R
    return np.asarray(S)


def smoothed(steps: Steps, found: Estimates) -> tuple[Array, Array]:
    """Fixed-interval smoother: states (N, n) and covariances (N, n, n) from the whole record.

    Bryson & Frazier's form (Bierman 1977): x + Pλ and P − PΛP, with λ and Λ what later readings
    say. No covariance is inverted, so that one may be singular.
    """
    C, before = steps.seen, found.predicted_P
    weight = np.linalg.inv(_spread(steps, before))
    H = C[1:] @ steps.Phi
    K = before[1:] @ (C[1:].transpose(0, 2, 1) @ weight[1:])
    seen = H.transpose(0, 2, 1) @ weight[1:]
    nu = np.nan_to_num(found.innovations[1:])[:, :, None]
    lam, Lam = gathered(steps.Phi - K @ H, seen @ H, (seen @ nu)[:, :, 0])
    x, P = found.x.copy(), found.P.copy()
    x[:-1] += (P[:-1] @ lam[:, :, None])[:, :, 0]
    P[:-1] -= P[:-1] @ Lam @ P[:-1]
    return x, 0.5 * (P + P.transpose(0, 2, 1))


def gathered(M: Array, W: Array, w: Array) -> tuple[Array, Array]:
    """Backwards λ(k) = M(k)ᵀλ(k+1) + w(k), Λ(k) = M(k)ᵀΛ(k+1)M(k) + W(k), from zero at the end.

    M, W (K, n, n) and w (K, n); λ (K, n) and Λ (K, n, n). About √K stretches of √K steps go side by
    side: first what each does to any end, then, the ends known, every step.
    """
    count, n = w.shape
    length = max(1, int(np.sqrt(count)))
    stretches = -(-count // length)
    lead = stretches * length - count  # at the beginning, where nothing comes after

    def cut(parts: Array) -> Array:
        padded = np.concatenate([np.zeros((lead, *parts.shape[1:])), parts])
        return padded.reshape(stretches, length, *parts.shape[1:])

    M, both = cut(M), cut(np.concatenate([W, w[:, :, None]], axis=2))
    # λ rides along as one more column of Λ, which M does not multiply from the right.
    whole, ends = np.broadcast_to(np.eye(n), (stretches, n, n)), np.zeros((stretches, n, n + 1))
    for k in range(length - 1, -1, -1):
        whole, ends = whole @ M[:, k], _earlier(M[:, k], ends, both[:, k])
    after = np.zeros((stretches, n, n + 1))
    for j in range(stretches - 1, 0, -1):
        after[j - 1] = _earlier(whole[j], after[j], ends[j])
    found = np.empty((stretches, length, n, n + 1))
    for k in range(length - 1, -1, -1):
        found[:, k] = after = _earlier(M[:, k], after, both[:, k])
    found = found.reshape(-1, n, n + 1)[lead:]
    return found[:, :, n], found[:, :, :n]


def _earlier(M: Array, after: Array, added: Array) -> Array:
    n = M.shape[-1]
    moved = np.swapaxes(M, -1, -2) @ after
    moved[..., :n] = moved[..., :n] @ M
    return np.asarray(moved + added)
