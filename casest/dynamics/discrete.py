"""Kalman filter and fixed-interval smoother in discrete time: matrices in, estimates out.

What a record with a continuous model becomes once its steps are known; also the way in for a model
that is discrete from the beginning.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.dynamics.factors import size
from casest.dynamics.stepping import (
    Pattern,
    both_ways,
    kalman_step,
    noise_factors,
    picked,
    told_step,
    unpacked,
    upper,
)
from casest.engine import chained, stretches

#: Samples of a record of which what is told of them is held at once.
TOLD = 4096


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

    @cached_property
    def read(self) -> Array:
        """y − d, and nothing where a reading is missing."""
        return np.where(self.present, self.y - self.d, 0.0)

    @property
    def patterns(self) -> tuple[Pattern, Pattern]:
        """Entries of Φ and of C that can differ from zero."""
        every = (self.Phi.shape[1:], self.C.shape[1:])
        known = (self.of_Phi, self.of_C)
        return tuple(tuple(np.ndindex(s)) if p is None else p
                     for s, p in zip(every, known, strict=True))  # type: ignore[return-value] # fmt: skip


@dataclass(frozen=True)
class Packed:
    """Steps as recursions take them, each with the sample that it leads to.

    Phi and C (K, …): entries of their patterns; forced (K, n); noise (K, …): Q's factors; R and
    read (K, m), and which readings there are.
    """

    Phi: Array
    forced: Array
    noise: Array
    C: Array
    R: Array
    read: Array
    present: NDArray[np.bool_]
    patterns: tuple[Pattern, Pattern]

    @staticmethod
    def of(steps: Steps | Packed) -> Packed:
        """Of steps as matrices."""
        if isinstance(steps, Packed):
            return steps
        of_Phi, of_C = steps.patterns
        Phi, noise = picked(steps.Phi, of_Phi), _factored(steps.Q)
        own = (picked(steps.seen, of_C), steps.R, steps.read)
        C, R, read = (part[1:] for part in own)
        return Packed(Phi, steps.forced, noise, C, R, read, steps.present[1:], steps.patterns)

    def parts(self, where: slice = slice(None)) -> list[Array]:
        """What some of the steps are given."""
        every = (self.Phi, self.forced, self.noise, self.C, self.R, self.read)
        return [part[where] for part in every]

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of states and readings."""
        return self.forced.shape[1], self.R.shape[1]


@dataclass(frozen=True)
class Estimates:
    """States x (N, n) and covariances P (N, n, n) after each reading and before it.

    innovations y − Cx − d (N, m) and their covariance S (N, m, m), NaN where a reading is missing.
    `factored`: x and the factors of P after each reading, as the smoother takes them.
    """

    x: Array
    P: Array
    predicted_x: Array
    predicted_P: Array  # noqa: N815
    innovations: Array
    S: Array
    factored: Array


def kalman(steps: Steps, start: Array, covariance: Array) -> Estimates:
    """Kalman filter; `start` (n,) and `covariance` (n, n) hold before the first reading."""
    return _followed(steps, *_from_start(steps, start, covariance))


def continued(steps: Steps, state: Array) -> Estimates:
    """The same at every sample but the first, where the filter has come to `state`, as factored."""
    parts = {name: getattr(steps, name)[1:] for name in ("C", "d", "R", "y")}
    return _followed(replace(steps, **parts), Packed.of(steps), state)


@dataclass(frozen=True)
class Brief:
    """Of `Estimates` what is shown: states x (N, n) with their std, innovations (N, m) with the std
    that is expected of them, NaN where a reading is missing, and νᵀS⁻¹ν (N,) of every whole one."""

    x: Array
    std: Array
    innovations: Array
    expected_std: Array
    normalised_innovations: Array
    factored: Array


def brief(steps: Steps | Packed, state: Array | None, start: Array, covariance: Array) -> Brief:
    """The filter from `state` (None: from the start), without covariances: half of the work.

    Of `stopped` states (L, …) along the way: several times as fast."""
    several = state is not None and state.ndim > 1
    samples, begun = _begun(steps, state, start, covariance)
    (n, m), parts = samples.sizes, samples.parts()
    step = kalman_step(n, m, *samples.patterns, give="brief")
    factored, own, said = step.along(begun, parts) if several else step(begun, parts)
    if not samples.present.all():
        said[:, : 2 * m][~np.tile(samples.present, 2)] = np.nan
        said[~samples.present.all(axis=1), -1] = np.nan
    return Brief(own[:, :n], own[:, n:], said[:, :m], said[:, m:-1], said[:, -1], factored)


def states(steps: Steps | Packed, state: Array | None, start: Array, covariance: Array) -> Array:
    """States alone, as factored, from `state`, or from the start where it is None."""
    samples, begun = _begun(steps, state, start, covariance)
    step = kalman_step(*samples.sizes, *samples.patterns, give="end")
    return step(begun, samples.parts())[0]


def stopped(
    steps: Steps | Packed, state: Array | None, start: Array, covariance: Array
) -> tuple[Array | None, Array]:
    """Where the filter has come to, as factored, along the way from `state`, and at the end."""
    passed = states(steps, state, start, covariance)
    if state is None:
        return None, passed[-1].copy()
    return np.vstack([state, passed[stretches(len(passed))[1:] - 1]]), passed[-1].copy()


def after_readings(
    steps: Steps, state: Array | None, start: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """The same as states (N, n) and covariances (N, n, n), and the last one as factored."""
    samples, begun = _begun(steps, state, start, covariance)
    n, m = samples.sizes
    step = kalman_step(n, m, *samples.patterns, give="after")
    last, both = step(begun, samples.parts(), keep=False)
    return *unpacked(both, n), last[-1]


def ended(steps: Steps, state: Array | None, start: Array, covariance: Array) -> Array:
    """Where the filter comes to, as factored, from `state`, or from the start where it is None."""
    samples, begun = _begun(steps, state, start, covariance)
    step = kalman_step(*samples.sizes, *samples.patterns, give="end")
    return np.asarray(step(begun, samples.parts(), keep=False)[0][-1])


def unfactored(factored: Array, n: int) -> tuple[Array, Array]:
    """States (N, n) and covariances (N, n, n)."""
    U = np.tile(np.eye(n), (len(factored), 1, 1))
    rows, columns = np.triu_indices(n, 1)
    order = np.lexsort((rows, columns))  # column by column
    U[:, rows[order], columns[order]] = factored[:, 2 * n :]
    return factored[:, :n], (U * factored[:, None, n : 2 * n]) @ U.transpose(0, 2, 1)


def std_of(covariances: Array) -> Array:
    """Standard deviations, (N, n), of covariances (N, n, n)."""
    return np.asarray(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))


def normalised(innovations: Array, S: Array) -> Array:
    """νᵀS⁻¹ν of innovations (N, m), NaN where one is missing in part."""
    whole = np.isfinite(innovations).all(axis=1)
    found, own = np.full(len(innovations), np.nan), innovations[whole]
    found[whole] = np.sum(own * np.linalg.solve(S[whole], own[:, :, None])[:, :, 0], axis=1)
    return found


#: Steps, and the state before the first.
Given = tuple[Packed, Array]


def _begun(steps: Steps | Packed, state: Array | None, start: Array, covariance: Array) -> Given:
    if state is not None:
        return Packed.of(steps), state
    assert isinstance(steps, Steps)
    return _from_start(steps, start, covariance)


def _from_start(steps: Steps, start: Array, covariance: Array) -> Given:
    n, (of_Phi, of_C) = steps.C.shape[2], steps.patterns
    # No step leads to the first sample: Φ = 0 from an empty state, and what is known beforehand.
    forced = np.concatenate([start[None], steps.forced])
    noise = _factored(np.concatenate([covariance[None], steps.Q]))
    Phi, C = picked(steps.Phi, of_Phi), picked(steps.seen, of_C)
    found = Packed(Phi, forced, noise, C, steps.R, steps.read, steps.present, steps.patterns)
    return found, np.zeros(size(n))


def _factored(Q: Array) -> Array:
    n = Q.shape[1]
    (found,) = noise_factors(n)([picked(Q, upper(n))])
    return found[:, :, 0]


def _followed(samples: Steps, packed: Packed, state: Array) -> Estimates:
    n, m = packed.sizes
    factored, *both = kalman_step(n, m, *packed.patterns)(state, packed.parts())
    (x, P), before = (unpacked(part, n) for part in both)
    return Estimates(x, P, *before, *_innovations(samples, *before), factored)


def _innovations(steps: Steps, x: Array, P: Array) -> tuple[Array, Array]:
    present = steps.present
    said = np.einsum("kij,kj->ki", steps.C, x) + steps.d
    m = steps.C.shape[1]
    S = steps.C @ P @ steps.C.transpose(0, 2, 1)
    S[:, np.arange(m), np.arange(m)] += steps.R
    whole = present[:, :, None] & present[:, None, :]
    return np.where(present, steps.y - said, np.nan), np.where(whole, S, np.nan)


def smoothed(steps: Steps, found: Estimates) -> tuple[Array, Array]:
    """Fixed-interval smoother: states (N, n) and covariances (N, n, n) by the whole record."""
    n = steps.C.shape[2]
    x, P, _ = smoothed_before(steps, found.factored[:-1], np.zeros(n * n + 2 * n))
    return np.concatenate([x, found.x[-1:]]), np.concatenate([P, found.P[-1:]])


def smoothed_before(
    steps: Steps | Packed, factored: Array, told: Array
) -> tuple[Array, Array, Array]:
    """The same at every sample but the last, of which what is `told` by readings after it is known.

    `factored` (N − 1, …) by the filter; also returned: what is told of the first sample.
    """
    x, P, back = _backwards(steps, factored, told, brief=False)
    return x, P, back


def smoothed_brief(
    steps: Steps | Packed, factored: Array, told: Array
) -> tuple[Array, Array, Array]:
    """The same with standard deviations (N − 1, n) in place of covariances."""
    x, std, back = _backwards(steps, factored, told, brief=True)
    return x, std, back


def _backwards(steps: Steps | Packed, factored: Array, told: Array, brief: bool) -> list[Array]:
    """States, what is shown beside them, and what is told of the first sample."""
    packed, count = Packed.of(steps), len(factored)
    n, m = packed.sizes
    step, combined = told_step(n, m, *packed.patterns), both_ways(n, packed.patterns[0], brief)
    found = [np.empty((count, n)), np.empty((count, n) if brief else (count, n, n))]
    for stop in range(count, 0, -TOLD):
        own = slice(max(stop - TOLD, 0), stop)
        (back,) = step(told, [p[::-1] for p in packed.parts(own)])
        each = combined([back[::-1], factored[own]])
        for whole, part in zip(found, each, strict=True):
            whole[own] = part.reshape(whole[own].shape)
        told = back[-1].copy()
    return [*found, told]


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
    back = chained(M[::-1], -told[-2::-1, :, :1], -told[-1, :, :1])[::-1]
    return np.asarray(found.predicted_x - (found.predicted_P @ back)[:, :, 0])
