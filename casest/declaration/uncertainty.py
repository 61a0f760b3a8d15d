"""What is known of how wrong a known number may be: standard deviations, and what they share.

A reference is common to all readings: its error is systematic, and does not average away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import DeclarationError

#: Smallest eigenvalue of a correlation matrix, with rounding of what was printed to some digits.
ROUNDED = -1e-6


@dataclass(frozen=True)
class Joint:
    """Covariance of numbers that were found together: of one statement, or one earlier result.

    `source` names the result; empty of what was stated of one constant alone, which shares nothing.
    """

    covariance: tuple[tuple[float, ...], ...]
    source: str = ""


@dataclass(frozen=True)
class Uncertainty:
    """Where the numbers of one constant stand in what was found together.

    `scale` is what each is multiplied by: the conversion from the unit that it was stated in.
    `freedom`: degrees of freedom of all their standard deviations; infinite where these are known.
    """

    joint: Joint
    places: tuple[int, ...]
    scale: tuple[float, ...]
    freedom: float = np.inf

    def __len__(self) -> int:
        """Count the numbers."""
        return len(self.places)

    @property
    def std(self) -> Array:
        """Standard deviations, (k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def covariance(self) -> Array:
        """Covariance of these numbers, (k, k)."""
        return self._of_joint(self)

    def shared(self, other: Uncertainty) -> Array:
        """Covariance (k, l) with the numbers of another constant: zero if not found together."""
        if not self.joint.source or self.joint != other.joint:
            return np.zeros((len(self), len(other)))
        return self._of_joint(other)

    def _of_joint(self, other: Uncertainty) -> Array:
        whole = np.array(self.joint.covariance)[np.ix_(self.places, other.places)]
        return np.asarray(whole * np.outer(self.scale, other.scale))

    def only(self, chosen: Sequence[int]) -> Uncertainty:
        """Some of the numbers."""
        places = tuple(self.places[i] for i in chosen)
        return replace(self, places=places, scale=tuple(self.scale[i] for i in chosen))

    def scaled(self, factor: float) -> Uncertainty:
        """The same in another unit."""
        return replace(self, scale=tuple(factor * s for s in self.scale))


def stated(std: Any, shape: tuple[int, ...], freedom: float = np.inf) -> Uncertainty:
    """Independent numbers of an array of this shape; one `std` is that of each."""
    if not freedom > 0:
        raise DeclarationError(f"freedom {freedom!r}: degrees of freedom are above zero")
    array = np.asarray(std, dtype=float)
    if array.shape not in ((), shape):
        raise DeclarationError(f"std {std!r} has shape {array.shape}, the value has {shape}")
    each = np.broadcast_to(array, shape).ravel()
    if not (np.isfinite(each) & (each > 0)).all():
        below = each[~(np.isfinite(each) & (each > 0))][0]
        raise DeclarationError(
            f"std {below:g} must be above zero: leave it away for an exact value"
        )
    return replace(found_together(np.diag(each**2)), freedom=float(freedom))


def found_together(covariance: Array, source: str = "") -> Uncertainty:
    """All numbers of a covariance (k, k), in their order; DeclarationError where it is none."""
    checked(covariance)
    joint = Joint(tuple(tuple(map(float, row)) for row in covariance), source)
    count = len(joint.covariance)
    return Uncertainty(joint, tuple(range(count)), (1.0,) * count)


def checked(covariance: Array) -> None:
    """Refuse what is no covariance: not symmetric, or a combination with a variance below zero."""
    matrix = np.asarray(covariance, dtype=float)
    if matrix.ndim != 2 or len(matrix) != matrix.shape[1] or not np.isfinite(matrix).all():
        raise DeclarationError(f"a covariance is a square of numbers, not {matrix.shape}")
    variance = np.diag(matrix)
    if not (variance >= 0).all():
        raise DeclarationError(
            f"a covariance has variances of zero or more, not {variance.min():g}"
        )
    std = np.where(variance > 0, np.sqrt(np.abs(variance)), 1.0)
    correlation = matrix / np.outer(std, std)
    if not np.allclose(correlation, correlation.T, atol=1e-6):
        raise DeclarationError("a covariance is symmetric, and this one is not")
    smallest = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min(initial=0.0))
    if smallest < ROUNDED:
        raise DeclarationError(
            f"the correlations are not positive semidefinite (smallest eigenvalue {smallest:.2g}): "
            "no numbers can be correlated like this"
        )
