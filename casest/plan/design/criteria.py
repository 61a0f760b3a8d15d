"""What a design is good for: functions of the covariance C of the unknowns, smaller is better.

Each is convex in the information M = C⁻¹ (Pukelsheim, Optimal Design of Experiments, 2006, ch. 6),
with the slope dΦ = −tr(C·weight·C·dM).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from casest.declaration.shapes import Array

#: Power of the mean that stands for a maximum in slopes: 64 is within 7 % of it over 100 values.
POWER = 64.0
#: Share of a combination in a slope below which it is rounding.
NEGLIGIBLE = 1e-17
#: Candidates that are looked at exactly where that takes an eigenvalue each.
SHORTLIST = 24


class Criterion(Protocol):
    """Φ(C): its value, its slope, and what one more candidate would make of it."""

    def value(self, C: Array) -> float:
        """Φ."""

    def weight(self, C: Array) -> Array:
        """L (n, n), positive semidefinite, with dΦ = −tr(C L C dM) (a subgradient's where Φ is a
        maximum)."""

    def after(self, C: Array, factors: Array) -> Array:
        """Φ (N,) where each of the candidates (N, k, n) is added by itself."""

    def base(self, C: Array, L: Array) -> float:
        """What the tangent with this weight starts from: Φ, or a mean in place of a maximum."""

    def ratio(self, best: float, found: float, n: int) -> float:
        """Standard deviations of a design with Φ = best, as a share of those with Φ = found."""


def inverse(M: Array) -> Array:
    """The covariance (n, n) of an information matrix, symmetric and positive to rounding."""
    half = np.linalg.solve(np.linalg.cholesky(M), np.eye(len(M)))
    return np.asarray(half.T @ half)


def added(C: Array, factors: Array) -> tuple[Array, Array]:
    """F C (N, k, n), and the Cholesky factor (N, k, k) of I + F C Fᵀ."""
    FC = factors @ C
    inner = FC @ factors.transpose(0, 2, 1)
    inner += np.eye(inner.shape[1])
    return FC, np.asarray(np.linalg.cholesky(inner))


@dataclass(frozen=True)
class Volume:
    """D: log det C, twice the logarithm of the volume of the ellipsoid of uncertainty."""

    def value(self, C: Array) -> float:
        """Φ."""
        return float(np.linalg.slogdet(C)[1])

    def weight(self, C: Array) -> Array:
        """C⁻¹: the slope is C itself."""
        return inverse(C)

    def after(self, C: Array, factors: Array) -> Array:
        """Φ (N,) with each candidate added."""
        root = added(C, factors)[1]
        logs = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(self.value(C) - logs)

    def base(self, C: Array, L: Array) -> float:
        """Φ."""
        return self.value(C)

    def ratio(self, best: float, found: float, n: int) -> float:
        """Of the geometric mean of the axes of the ellipsoid."""
        return float(np.exp((best - found) / (2 * n)))


@dataclass(frozen=True)
class Trace:
    """A and c: tr(KᵀCK), the sum of the variances of the combinations in the columns of K."""

    K: Array

    def value(self, C: Array) -> float:
        """Φ."""
        return float(np.einsum("ij,ik,kj->", self.K, C, self.K))

    def weight(self, C: Array) -> Array:
        """K Kᵀ."""
        return np.asarray(self.K @ self.K.T)

    def after(self, C: Array, factors: Array) -> Array:
        """Φ (N,) with each candidate added."""
        return np.asarray(self.value(C) - _falls(C, factors, self.K).sum(axis=1))

    def base(self, C: Array, L: Array) -> float:
        """Φ."""
        return self.value(C)

    def ratio(self, best: float, found: float, n: int) -> float:
        """Of the root of the sum."""
        return _root_of_ratio(best, found)


@dataclass(frozen=True)
class Largest:
    """G, and goals: the largest variance of the combinations in the columns of K."""

    K: Array

    def variances(self, C: Array) -> Array:
        """Of each combination."""
        return np.asarray(np.sum(self.K * (C @ self.K), axis=0))

    def value(self, C: Array) -> float:
        """Φ."""
        return float(self.variances(C).max())

    def weight(self, C: Array) -> Array:
        """Shares of the combinations that are near the largest."""
        root = self.root(C)
        return np.asarray(root @ root.T)

    def root(self, C: Array) -> Array:
        """A root of the weight, (n, combinations that count)."""
        shares = _shares(self.variances(C))
        counts = shares > NEGLIGIBLE
        return np.asarray(self.K[:, counts] * np.sqrt(shares[counts]))

    def after(self, C: Array, factors: Array) -> Array:
        """Φ (N,) with each candidate added."""
        return np.asarray((self.variances(C) - _falls(C, factors, self.K)).max(axis=1))

    def base(self, C: Array, L: Array) -> float:
        """The mean with the shares of L, no larger than Φ."""
        return float(np.sum(L * C))

    def ratio(self, best: float, found: float, n: int) -> float:
        """Of the largest."""
        return _root_of_ratio(best, found)


@dataclass(frozen=True)
class Longest:
    """E: the largest eigenvalue of C, the variance along the longest axis of the ellipsoid."""

    def value(self, C: Array) -> float:
        """Φ."""
        return float(np.linalg.eigvalsh(C)[-1])

    def weight(self, C: Array) -> Array:
        """Shares of the axes that are near the longest."""
        values, axes = np.linalg.eigh(C)
        return np.asarray((axes * _shares(values)) @ axes.T)

    def after(self, C: Array, factors: Array) -> Array:
        """Φ (N,) with each candidate added; of all but the best few, an upper estimate."""
        values, axes = np.linalg.eigh(C)
        falls = _falls(C, factors, axes * np.sqrt(_shares(values))).sum(axis=1)
        found = np.asarray(values[-1] - falls + abs(values[-1]))
        for i in np.argsort(-falls)[:SHORTLIST]:
            FC, root = added(C, factors[i : i + 1])
            half = np.linalg.solve(root[0], FC[0])
            found[i] = np.linalg.eigvalsh(C - half.T @ half)[-1]
        return found

    def base(self, C: Array, L: Array) -> float:
        """The mean with the shares of L, no larger than Φ."""
        return float(np.sum(L * C))

    def ratio(self, best: float, found: float, n: int) -> float:
        """Of the longest axis."""
        return _root_of_ratio(best, found)


def _falls(C: Array, factors: Array, K: Array) -> Array:
    """By how much the variance of each combination falls with each candidate, (N, columns)."""
    FC, root = added(C, factors)
    return np.asarray(np.sum(np.linalg.solve(root, FC @ K) ** 2, axis=1))


def _shares(variances: Array) -> Array:
    """Slope of the mean of a high power: shares that add up to one."""
    largest = variances.max()
    powers = np.maximum(variances / largest, 0.0) ** (POWER - 1)
    return np.asarray(powers / powers.sum())


def _root_of_ratio(best: float, found: float) -> float:
    return float(np.sqrt(max(best, 0.0) / found)) if found > 0 else 1.0
