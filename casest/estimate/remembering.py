"""Coloured noise of a record that is not many of its memories long.

White noise and one part that is forgotten as exp(−k/memory): two numbers of its colour, as much as
there is to see where there is little to average over. What a fit has taken of the noise, most of
it slow, is allowed for by what it leaves of each frequency; what such a record leaves open of the
colour by all colours, each as likely as Whittle's likelihood makes it (all are equally likely
before). A variance is their geometric mean, and its degrees of freedom are those of Student's t
that reaches as far as the mixture of normal errors does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.estimate.spectrum import LEFT, Part

#: Memories that are tried, evenly over their logarithm, from one sample to all of the longest
#: stretch; shares of the variance that remember.
MEMORIES = 12
SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 1.0)
#: Frequencies that count one by one, and bands of the others.
SINGLE, BANDS = 24, 60
#: What the intervals hold; degrees of freedom at least, and from which on they are as many as any.
HELD, FEWEST, MANY = 0.95, 1.0, 1e4


class _Axis(NamedTuple):
    """Noise of one axis: how likely each colour is (K,), its power (K, B) in bands of frequencies,
    and JᵀJ (B, n, n) of these."""

    weight: Array
    power: Array
    normal: Array


def remembering(parts: Sequence[Part], bread: Array) -> tuple[Array, Array]:
    """Covariance (n, n) of the unknowns, and degrees of freedom (n,) of each variance.

    `parts`: residual and Jacobian by frequency of all stretches and axes; `bread` (n, n): (JᵀJ)⁻¹.
    Each axis has noise of its own.
    """
    n = len(bread)
    covariance, size, doubt = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    for k in sorted({part.axis for part in parts}):
        axis = _axis([part for part in parts if part.axis == k], n)
        each = axis.power @ np.einsum("ia,bac,ic->bi", bread, axis.normal, bread)
        each = np.maximum(each, 0.0)
        with np.errstate(divide="ignore"):
            own = np.exp(axis.weight @ np.log(each))
        middle = np.einsum("b,bac->ac", axis.weight @ axis.power, axis.normal)
        covariance += bread @ middle @ bread
        size += own
        doubt += own**2 / _freedom(axis.weight, each, own)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.sqrt(np.where(size > 0, size / np.diag(covariance), 0.0))
        freedom = np.where(doubt > 0, size**2 / doubt, MANY)
    return covariance * np.outer(scale, scale), freedom


def _axis(parts: Sequence[Part], n: int) -> _Axis:
    """One axis of all stretches, its frequencies in order."""
    every = zip(*(part.powers for part in parts), strict=True)
    frequency, power, left = (np.concatenate(column) for column in every)
    order = np.argsort(frequency, kind="stable")
    count = len(frequency)
    fast = np.geomspace(min(SINGLE, count), count, BANDS).round().astype(int)
    edges = np.unique(np.concatenate([np.arange(min(SINGLE, count)), fast[fast < count]]))
    band = np.empty(count, int)
    band[order] = np.searchsorted(edges, np.arange(count), side="right") - 1
    normal, first = np.zeros((len(edges), n, n)), 0
    for part in parts:
        own = band[first : first + len(part.jacobian)]
        for b in np.unique(own):
            J = part.jacobian[own == b]
            normal[b][np.ix_(part.x, part.x)] += J.T @ J
        first += len(own)
    shapes = _shapes(frequency[order], edges, max(len(part.jacobian) for part in parts))
    told: Array = np.bincount(band, left).astype(float)
    told = np.where(told > LEFT * np.bincount(band), told, 0.0)
    squares = np.where(told > 0, np.bincount(band, power), 0.0)
    weight, sizes = _likely(shapes, told, squares)
    return _Axis(weight, shapes * sizes[:, None], normal)


def _shapes(frequency: Array, edges: NDArray[np.int_], longest: int) -> Array:
    """Power (K, B) of noise of variance one, of every colour, in bands that begin at `edges`."""
    ends = np.append(edges[1:], len(frequency))
    each = []
    for memory in np.geomspace(1.0, longest, MEMORIES):
        a = np.exp(-1 / memory)
        power = (1 - a**2) / (1 - 2 * a * np.cos(2 * np.pi * frequency) + a**2)
        each.append(np.add.reduceat(power, edges) / (ends - edges))
    found = [share * one + 1 - share for one in each for share in SHARES]
    return np.array(found)


def _likely(shapes: Array, told: Array, squares: Array) -> tuple[Array, Array]:
    """How likely each colour is (K,), and the variance (K,) of the noise that it is then."""
    sizes = np.maximum((1 / shapes) @ squares / told.sum(), 1e-300)
    chance = -0.5 * (told.sum() * np.log(sizes) + np.log(shapes) @ told)
    weight = np.exp(chance - chance.max())
    return weight / weight.sum(), sizes


def _freedom(weight: Array, each: Array, own: Array) -> Array:
    """Degrees of freedom (n,) with which Student's t of variance `own` (n,) holds as much as the
    mixture of normal errors of variances `each` (K, n)."""
    from scipy.special import ndtr, stdtrit

    found = np.full(len(own), MANY)
    for i in np.flatnonzero(own > 0):
        deviation = np.sqrt(np.maximum(each[:, i], 1e-300))
        low, high = 0.0, 10 * float(deviation.max())
        for _ in range(60):
            middle = (low + high) / 2
            held = weight @ (2 * ndtr(middle / deviation) - 1)
            low, high = (middle, high) if held < HELD else (low, middle)
        reach, few, many = high / np.sqrt(own[i]), FEWEST, MANY
        for _ in range(60):
            middle = np.sqrt(few * many)
            further = stdtrit(middle, (1 + HELD) / 2) > reach
            few, many = (middle, many) if further else (few, middle)
        found[i] = few
    return found
