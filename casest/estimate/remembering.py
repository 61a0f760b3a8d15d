"""Coloured noise of a record that is not many of its memories long.

White noise and one part that is forgotten as exp(−k/memory), or is smoother, as if that had been
averaged once more alike (of errors that a lag leaves, or a plant that moves slowly): two numbers of
its colour, as much as there is to see where there is little to average over. What a fit has taken
of the noise, most of it slow, is allowed for by what it leaves of each frequency; what such a
record leaves open of the colour by all colours, each as likely as Whittle's likelihood makes it
(all of one kind are equally likely before). A variance is their geometric mean, and its degrees of
freedom are those of Student's t that reaches as far as the mixture of normal errors does.
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
#: Of the longest stretch the longest memory of smooth noise, beyond which that is a few waves; and
#: by how much finer these are tried: what is slow goes with their fourth power.
SMOOTH, FINER = 0.1, 2
#: How likely any smooth colour is before, of which there are more than are met: a record that is
#: long enough says so.
SELDOM = 0.1
#: Frequencies that count one by one, and bands of the others.
SINGLE, BANDS = 24, 60
#: What the intervals hold; degrees of freedom at least, and from which on they are as many as any.
HELD, FEWEST, MANY = 0.95, 1.0, 1e4
#: Halvings in which a number is found to all its digits.
HALVINGS = 60


class _Axis(NamedTuple):
    """One axis of all stretches: how likely each colour of its noise is (K,), the noise's power
    (K, B) in bands of frequencies, and which band each frequency of every stretch is in."""

    parts: list[Part]
    bands: list[NDArray[np.int_]]
    weight: Array
    power: Array


def remembering(parts: Sequence[Part], bread: Array) -> tuple[Array, Array]:
    """Covariance (n, n) of the unknowns, and degrees of freedom (n,) of each variance.

    `parts`: residual and Jacobian by frequency of all stretches and axes; `bread` (n, n): (JᵀJ)⁻¹.
    Each axis has noise of its own.
    """
    n = len(bread)
    middle, size, doubt = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    for k in sorted({part.axis for part in parts}):
        axis = _axis([part for part in parts if part.axis == k])
        each = axis.power @ _pulls(axis, bread)
        own, there = np.zeros(n), (each > 0).all(axis=0)  # nothing of what other axes alone tell
        own[there] = np.exp(axis.weight @ np.log(each[:, there]))
        mean = axis.weight @ axis.power
        for part, band in zip(axis.parts, axis.bands, strict=True):
            middle[np.ix_(part.x, part.x)] += (part.jacobian.T * mean[band]) @ part.jacobian
        size += own
        doubt += own**2 / _freedom(axis.weight, each, own)
    covariance = bread @ middle @ bread
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.sqrt(np.where(size > 0, size / np.diag(covariance), 0.0))
        freedom = np.where(doubt > 0, size**2 / doubt, MANY)
    return covariance * np.outer(scale, scale), freedom


def _pulls(axis: _Axis, bread: Array) -> Array:
    """Squares (B, n) of what each band does to the unknowns, for noise of power one."""
    found = np.zeros((axis.power.shape[1], len(bread)))
    for part, band in zip(axis.parts, axis.bands, strict=True):
        np.add.at(found, band, (part.jacobian @ bread[part.x]) ** 2)
    return found


def _axis(parts: list[Part]) -> _Axis:
    """Which colours one axis may have by all of its stretches."""
    every = zip(*(part.powers for part in parts), strict=True)
    frequency, power, left = (np.concatenate(column) for column in every)
    order = np.argsort(frequency, kind="stable")
    count = len(frequency)
    fast = np.geomspace(min(SINGLE, count), count, BANDS).round().astype(int)
    edges = np.unique(np.concatenate([np.arange(min(SINGLE, count)), fast[fast < count]]))
    band = np.empty(count, int)
    band[order] = np.searchsorted(edges, np.arange(count), side="right") - 1
    lengths = [len(part.jacobian) for part in parts]
    shapes = _shapes(frequency[order], edges, max(lengths))
    told: Array = np.bincount(band, left).astype(float)
    told = np.where(told > LEFT * np.bincount(band), told, 0.0)
    squares = np.where(told > 0, np.bincount(band, power), 0.0)
    smooth = np.arange(len(shapes)) >= MEMORIES * len(SHARES)
    before = np.where(smooth, SELDOM / smooth.sum(), (1 - SELDOM) / (~smooth).sum())
    weight, sizes = _likely(shapes, told, squares, before)
    bands = np.split(band, np.cumsum(lengths)[:-1])
    return _Axis(parts, bands, weight, shapes * sizes[:, None])


def _shapes(frequency: Array, edges: NDArray[np.int_], longest: int) -> Array:
    """Power (K, B) of noise of variance one, of every colour, in bands that begin at `edges`."""
    ends = np.append(edges[1:], len(frequency))
    once = [_forgotten(frequency, a) for a in np.geomspace(1.0, longest, MEMORIES)]
    smooth = np.geomspace(1.0, max(SMOOTH * longest, 1.0), FINER * MEMORIES)
    each = [np.add.reduceat(p, edges) / (ends - edges)
            for p in (*once, *(_forgotten(frequency, m, twice=True) for m in smooth))]  # fmt: skip
    found = [share * one + 1 - share for one in each for share in SHARES]
    return np.array(found)


def _forgotten(frequency: Array, memory: float, *, twice: bool = False) -> Array:
    """Power (N,) of noise of variance one that is forgotten as exp(−k/memory), or averaged `twice`
    so."""
    a = np.exp(-1 / memory)
    power = (1 - a**2) / (1 - 2 * a * np.cos(2 * np.pi * frequency) + a**2)
    return np.asarray(power**2 * (1 - a**2) / (1 + a**2) if twice else power)


def _likely(shapes: Array, told: Array, squares: Array, before: Array) -> tuple[Array, Array]:
    """How likely each colour is (K,), as it was `before` (K,), and the variance (K,) of the noise
    that it is then."""
    sizes = np.maximum((1 / shapes) @ squares / told.sum(), 1e-300)
    chance = -0.5 * (told.sum() * np.log(sizes) + np.log(shapes) @ told)
    weight = before * np.exp(chance - chance.max())
    return weight / weight.sum(), sizes


def _freedom(weight: Array, each: Array, own: Array) -> Array:
    """Degrees of freedom (n,) with which Student's t of variance `own` (n,) holds as much as the
    mixture of normal errors of variances `each` (K, n)."""
    from scipy.special import ndtr, stdtrit

    there = own > 0
    found, size = np.full(len(own), MANY), np.sqrt(own[there])
    deviation = np.sqrt(np.maximum(each[:, there], 1e-300))
    low, high = np.zeros_like(size), 10 * deviation.max(axis=0)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        less = weight @ (2 * ndtr(middle / deviation) - 1) < HELD
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    few, many = np.full_like(size, FEWEST), np.full_like(size, MANY)
    for _ in range(HALVINGS):
        middle = np.sqrt(few * many)
        further = stdtrit(middle, (1 + HELD) / 2) * size > high
        few, many = np.where(further, middle, few), np.where(further, many, middle)
    found[there] = few
    return found
