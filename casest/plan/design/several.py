"""A criterion over several values that the unknowns may have: its mean, or the worst.

Unknowns and residuals of all values stand beside each other, so that a covariance is one of blocks
and what is convex for one value stays so: the certificate holds as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.plan.design.criteria import Criterion, Volume

#: What stands for a maximum in slopes: nats of D, and powers of variances.
NATS, POWER = 8.0, 32.0


@dataclass(frozen=True)
class Several:
    """A criterion of `count` blocks: the mean over them, or the `worst` of them."""

    inner: Criterion
    count: int
    worst: bool

    def value(self, C: Array) -> float:
        """Φ."""
        values = self._values(C)
        return float(values.max() if self.worst else values.mean())

    def weight(self, C: Array) -> Array:
        """Blocks of the criterion's own weights, by their shares."""
        found = np.zeros_like(C)
        for own, share in zip(self._blocks(C), self._shares(self._values(C)), strict=True):
            found[own, own] = share * self.inner.weight(C[own, own])
        return found

    def after(self, C: Array, factors: Array) -> Array:
        """Φ (N,) with each candidate added."""
        k = factors.shape[1] // self.count
        every = np.array([
            self.inner.after(C[own, own], factors[:, i * k : (i + 1) * k, own])
            for i, own in enumerate(self._blocks(C))
        ])  # fmt: skip
        return np.asarray(every.max(axis=0) if self.worst else every.mean(axis=0))

    def base(self, C: Array, L: Array) -> float:
        """A mean with the shares of the weight, no larger than Φ."""
        parts = [
            self.inner.base(C[own, own], self.inner.weight(C[own, own])) for own in self._blocks(C)
        ]
        return float(self._shares(self._values(C)) @ np.array(parts))

    def ratio(self, best: float, found: float, n: int) -> float:
        """Standard deviations of one block."""
        return self.inner.ratio(best, found, n // self.count)

    def _blocks(self, C: Array) -> list[slice]:
        n = len(C) // self.count
        return [slice(i * n, (i + 1) * n) for i in range(self.count)]

    def _values(self, C: Array) -> Array:
        return np.array([self.inner.value(C[own, own]) for own in self._blocks(C)])

    def _shares(self, values: Array) -> Array:
        """Shares of the blocks that add up to one."""
        if not self.worst:
            return np.full(self.count, 1 / self.count)
        if isinstance(self.inner, Volume):
            powers = np.exp(NATS * (values - values.max()))
        else:
            powers = (values / values.max()) ** POWER
        return np.asarray(powers / powers.sum())


def beside(factors: Sequence[Array]) -> Array:
    """Factors (N, k, n) of the same candidates at several values, as blocks (N, S·k, S·n)."""
    N, k, n = factors[0].shape
    found = np.zeros((N, len(factors) * k, len(factors) * n))
    for i, own in enumerate(factors):
        found[:, i * k : (i + 1) * k, i * n : (i + 1) * n] = own
    return found
