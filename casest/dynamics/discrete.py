"""Kalman filter and fixed-interval smoother in discrete time: matrices in, estimates out.

What a record with a continuous model becomes once its steps are known; also the way in for a model
that is discrete from the beginning.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
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

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Which readings there are, (N, m)."""
        return np.asarray(np.isfinite(self.y))

    @cached_property
    def seen(self) -> Array:
        """C without what is missing: a reading that the state does not reach says nothing."""
        if self.present.all():
            return self.C
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
    # No step leads to the first sample: Φ = 0 from an empty state, and what is known beforehand.
    Phi, forced, Q = (
        steps.Phi,
        np.concatenate([start[None], steps.forced]),
        np.empty((len(y), n, n)),
    )
    Q[0], Q[1:] = covariance, steps.Q
    step = kalman_step(n, m, *steps.patterns)
    after, before = run_steps(step, np.zeros(n + n * n), [Phi, forced, Q, C, R, y])
    (x, P), (before_x, before_P) = unpacked(after, n), unpacked(before, n)
    return Estimates(x, P, before_x, before_P, *_innovations(steps, before_x, before_P))


def _innovations(steps: Steps, x: Array, P: Array) -> tuple[Array, Array]:
    present = steps.present
    said = np.einsum("kij,kj->ki", steps.C, x) + steps.d
    m = steps.C.shape[1]
    S = steps.C @ P @ steps.C.transpose(0, 2, 1)
    S[:, np.arange(m), np.arange(m)] += steps.R
    whole = present[:, :, None] & present[:, None, :]
    return np.where(present, steps.y - said, np.nan), np.where(whole, S, np.nan)


def smoothed(steps: Steps, found: Estimates) -> tuple[Array, Array]:
    """Fixed-interval smoother (Rauch, Tung & Striebel 1965): states (N, n), covariances (N, n, n).

    The covariance left of a step is in Joseph's form, so that it stays positive however much later
    readings add.
    """
    x, P = found.x, found.P
    G = np.linalg.solve(found.predicted_P[1:], steps.Phi @ P[:-1]).transpose(0, 2, 1)
    left = np.eye(x.shape[1]) - G @ steps.Phi
    own_x = x[:-1] - (G @ found.predicted_x[1:, :, None])[:, :, 0]
    own_P = left @ P[:-1] @ left.transpose(0, 2, 1) + G @ steps.Q @ G.transpose(0, 2, 1)
    earlier = gathered(np.asarray(G, float), own_x, np.asarray(own_P, float), x[-1], P[-1])
    return np.concatenate([earlier[0], x[-1:]]), np.concatenate([earlier[1], P[-1:]])


def gathered(G: Array, w: Array, W: Array, x: Array, P: Array) -> tuple[Array, Array]:
    """Backwards x(k) = G(k)x(k+1) + w(k), P(k) = G(k)P(k+1)G(k)ᵀ + W(k), from x and P at the end.

    G, W (K, n, n) and w (K, n); x (K, n) and P (K, n, n). About √K stretches of √K steps go side by
    side: first what each does to any end, then, the ends known, every step.
    """
    count, n = w.shape
    length = max(1, int(np.sqrt(count)))
    stretches = -(-count // length)
    lead = stretches * length - count  # at the beginning, where nothing comes after

    def cut(parts: Array) -> Array:
        padded = np.concatenate([np.zeros((lead, *parts.shape[1:])), parts])
        return padded.reshape(stretches, length, *parts.shape[1:])

    # x rides along as one more column of P, which Gᵀ does not multiply from the right.
    G, both = cut(G), cut(np.concatenate([W, w[:, :, None]], axis=2))
    whole, ends = np.broadcast_to(np.eye(n), (stretches, n, n)), np.zeros((stretches, n, n + 1))
    for k in range(length - 1, -1, -1):
        whole, ends = G[:, k] @ whole, _earlier(G[:, k], ends, both[:, k])
    after = np.empty((stretches, n, n + 1))
    after[-1] = np.concatenate([P, x[:, None]], axis=1)
    for j in range(stretches - 1, 0, -1):
        after[j - 1] = _earlier(whole[j], after[j], ends[j])
    found = np.empty((stretches, length, n, n + 1))
    for k in range(length - 1, -1, -1):
        found[:, k] = after = _earlier(G[:, k], after, both[:, k])
    found = found.reshape(-1, n, n + 1)[lead:]
    return found[:, :, n], found[:, :, :n]


def linear_recursion(M: Array, b: Array, first: Array) -> Array:
    """x(k+1) = M(k)x(k) + b(k) from x(0) = first (n, p): all x, (K + 1, n, p).

    M (K, n, n) and b (K, n, p); about √K stretches go side by side, as above.
    """
    count, n, p = b.shape
    length = max(1, int(np.sqrt(count)))
    stretches = -(-count // length)
    spare = stretches * length - count

    def cut(parts: Array) -> Array:
        padded = np.concatenate([parts, np.zeros((spare, *parts.shape[1:]))])
        return padded.reshape(stretches, length, *parts.shape[1:])

    M, b = cut(M), cut(b)
    whole, ends = np.broadcast_to(np.eye(n), (stretches, n, n)), np.zeros((stretches, n, p))
    for k in range(length):
        whole, ends = M[:, k] @ whole, M[:, k] @ ends + b[:, k]
    before = np.empty((stretches, n, p))
    before[0] = first
    for j in range(1, stretches):
        before[j] = whole[j - 1] @ before[j - 1] + ends[j - 1]
    found = np.empty((stretches, length, n, p))
    for k in range(length):
        found[:, k] = before = M[:, k] @ before + b[:, k]
    return np.concatenate([first[None], found.reshape(-1, n, p)[:count]])


def smoothed_states(steps: Steps, found: Estimates) -> Array:
    """The smoother's states alone, (N, n), for a fraction of the work (Bryson & Frazier 1963)."""
    m = steps.C.shape[1]
    C = steps.seen
    S = C @ found.predicted_P @ C.transpose(0, 2, 1)
    S[:, np.arange(m), np.arange(m)] += steps.R
    nu = np.where(steps.present, found.innovations, 0.0)[:, :, None]
    told = C.transpose(0, 2, 1) @ np.linalg.solve(S, np.concatenate([nu, C @ found.predicted_P], 2))
    # λ before a reading: what it says, and what is left of λ after it.
    left = np.eye(C.shape[2]) - told[:, :, 1:]
    M = left[:-1] @ steps.Phi.transpose(0, 2, 1)
    back = linear_recursion(M[::-1], -told[-2::-1, :, :1], -told[-1, :, :1])[::-1]
    return np.asarray(found.predicted_x - (found.predicted_P @ back)[:, :, 0])


def _earlier(G: Array, after: Array, added: Array) -> Array:
    n = G.shape[-1]
    moved = G @ after
    moved[..., :n] = moved[..., :n] @ np.swapaxes(G, -1, -2)
    return np.asarray(moved + added)
