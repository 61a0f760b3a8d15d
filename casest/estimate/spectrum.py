"""The noise's spectrum as a smooth curve: what a record that is not long says of coloured noise.

The logarithm of the spectrum is a polynomial in the logarithm of the frequency, fitted to the
cosine transform of the residual by Whittle's likelihood (P. Whittle, 1953): five numbers that cover
white, autoregressive, pink and wandering noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array

Index = NDArray[np.int_]

#: Bands of frequencies over which powers are put together before the curve is fitted.
BANDS = 40
#: Frequencies in the first band; within it the spectrum is taken as flat.
FIRST = 8
#: In the first band a spectrum falls as it does from there to so many times its frequency, ...
BEYOND = 16
#: ... by this power of the frequency at most: that of a walk.
STEEPEST = 2.0
#: Order of the curve.
ORDER = 4
#: The least share of a band that the fit must have left to be asked.
LEFT = 0.1


class Stretch(NamedTuple):
    """Evenly sampled residuals (N, m) of one run, with the Jacobian (N, m, k) of unknowns `x`."""

    x: Any
    residual: Array
    jacobian: Array


class Powers(NamedTuple):
    """Power (N,) over frequency (N,), in cycles per sample; `left`: what the fit leaves of each."""

    frequency: Array
    power: Array
    left: Array


class Part(NamedTuple):
    """One axis of a stretch by frequency: its powers, and the Jacobian (N, k) of unknowns `x`."""

    axis: int
    x: Any
    powers: Powers
    jacobian: Array


def band_edges(count: float, *, finer: int = 1) -> Index:
    """Where bands of so many frequencies begin, evenly over their logarithm beyond the first one.

    `finer`: into how many each is cut, and the first one into its frequencies.
    """
    bands = finer * (BANDS - 1) + 1
    edges = np.unique(np.round(np.geomspace(FIRST, max(count, FIRST), bands)).astype(int))
    first = np.arange(FIRST) if finer > 1 else np.arange(1)
    return np.concatenate([first[first < count], edges[edges < count]])


def by_frequency(stretch: Stretch, bread: Array) -> Iterator[Part]:
    """The cosine transform of each axis of a stretch; `bread` (n, n) is (JᵀJ)⁻¹ of the problem."""
    from scipy.fft import dct

    count, axes = stretch.residual.shape
    frequency = (np.arange(count) + 0.5) / (2 * count)
    residual = dct(stretch.residual, axis=0, norm="ortho")
    jacobian = dct(stretch.jacobian, axis=0, norm="ortho")
    inner = bread[np.ix_(stretch.x, stretch.x)]
    for k in range(axes):
        J = jacobian[:, k]
        left = np.clip(1 - np.einsum("fa,fa->f", J @ inner, J), 0, 1)
        yield Part(k, stretch.x, Powers(frequency, residual[:, k] ** 2, left), J)


class Bands:
    """Frequencies (N,) in cycles per sample, put together in bands once for all curves.

    `many` (N,): how many frequencies each stands for, whose powers come in one sum.
    """

    def __init__(self, frequency: Array, many: Array | None = None) -> None:
        order = np.argsort(frequency, kind="stable")
        log = np.log(frequency[order])
        many = np.ones(len(log)) if many is None else many[order]
        # Of one stretch they are in order: no copies then.
        self._order: Any = slice(None) if np.all(np.diff(frequency) >= 0) else order
        before = np.cumsum(many)
        # A band begins where so many frequencies are before it.
        edges = np.searchsorted(before, band_edges(before[-1])[1:]) + 1
        self._edges = np.unique(np.concatenate([[0], edges[edges < len(log)]]))
        self._size = np.add.reduceat(many, self._edges)
        self._log = np.log(frequency)
        middle = np.add.reduceat(log * many, self._edges) / self._size
        # Flat to the first band's end: nothing holds a curve between its middle and there.
        first = int(np.searchsorted(before, min(FIRST, before[-1])))
        middle[0] = max(float(log[first]), middle[0])
        self._middle = middle
        self._first = np.flatnonzero(self._log < middle[0])
        self._slow = self._log[self._first] - middle[0]
        self._beyond = np.flatnonzero(middle < middle[0] + np.log(BEYOND))[1:]

    def curves(self, power: Array, left: Array) -> Array:
        """The most likely smooth spectra (N, m) of powers (N, m), of which a fit left a share."""
        shape = np.exp(-np.outer(self._slow, self._falls(power, left)))
        power = power.copy()
        power[self._first] /= shape
        found = self._flat(power, left)
        found[self._first] *= shape
        return found

    def _falls(self, power: Array, left: Array) -> Array:
        """The powers (m,) of the frequency by which these fall beyond the first band."""
        if len(self._beyond) < 3:
            return np.zeros(power.shape[1])
        mean, count, _ = self._banded(power, left)
        line = np.stack([np.ones(len(self._beyond)), self._middle[self._beyond]], axis=1)
        mean = np.maximum(mean[self._beyond], 1e-300)
        slope = _most_likely(line, mean, count[self._beyond])[1]
        return np.asarray(np.clip(-slope, 0.0, STEEPEST))

    def _flat(self, power: Array, left: Array) -> Array:
        """Those that are flat in the first band."""
        mean, count, told = self._banded(power, left)
        if told.all():
            shapes, there = self._shapes
            return np.asarray(np.exp(there @ _most_likely(shapes, mean, count)))
        each = [self.smooth(power[:, k], left[:, k])(self._log) for k in range(power.shape[1])]
        return np.stack(each, axis=1)

    def smooth(self, power: Array, left: Array) -> Callable[[Array], Array]:
        """That of powers (N,) of one axis, as a function of the logarithm of the frequency."""
        mean, count, told = self._banded(power[:, None], left[:, None])
        told = told[:, 0]
        if not told.any():
            return lambda log: np.full(np.shape(log), 1e-300)
        shapes = Shapes(self._middle[told])
        (curve,) = _most_likely(shapes(self._middle[told]), mean[told], count[told]).T
        return lambda log: np.exp(shapes(log) @ curve)

    def _banded(self, power: Array, left: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Mean power and number of frequencies of each band (B, m), and what tells something."""
        count = np.add.reduceat(left[self._order], self._edges, axis=0)
        sums = np.add.reduceat(power[self._order], self._edges, axis=0)
        mean = sums / np.maximum(count, 1e-300)
        return mean, count, (count > LEFT * self._size[:, None]) & (mean > 0)

    @cached_property
    def _shapes(self) -> tuple[Array, Array]:
        """Those of all bands, there and at all frequencies."""
        shapes = Shapes(self._middle)
        return shapes(self._middle), shapes(self._log)


class Shapes:
    """Legendre's polynomials over the range of some logarithms of frequencies."""

    def __init__(self, middle: Array) -> None:
        self._low, self._high = float(middle.min()), float(middle.max())
        self._order = min(ORDER, len(middle) - 1)

    def __call__(self, log: Array) -> Array:
        """(N, k) at these logarithms (N,); beyond the range as at its end."""
        place = 2 * (log - self._low) / max(self._high - self._low, 1e-300) - 1
        return np.asarray(np.polynomial.legendre.legvander(np.clip(place, -1, 1), self._order))


def noise_spectrum(parts: Sequence[Powers]) -> Callable[[Array], Array]:
    """Power over frequency (cycles per sample), by Whittle's likelihood of the parts' powers."""
    f, power, left = (np.concatenate(column) for column in zip(*parts, strict=True))
    smooth = Bands(f).smooth(power, left)
    return lambda frequency: smooth(np.log(frequency))


class Certainty:
    """How well a curve is known that so many samples show: by what Whittle's likelihood tells.

    A power of one frequency has two degrees of freedom less one, so tells ½ of its logarithm.
    """

    def __init__(self, count: int) -> None:
        bands = Bands((np.arange(count) + 0.5) / (2 * count))
        self._shapes = Shapes(bands._middle)
        there = self._shapes(bands._middle)
        self._covariance = np.linalg.inv(0.5 * (there.T * bands._size) @ there)
        self._mean = bands._size @ there / bands._size.sum()

    def variances(self, log: Array, weights: Array) -> Array:
        """Variance (n,) of the logarithm of the power, against its mean over all frequencies, where
        weights (N, n) of frequencies (N,) by their logarithm see it."""
        share = weights / np.maximum(weights.sum(axis=0), 1e-300)
        seen = share.T @ self._shapes(log) - self._mean
        return np.asarray(np.einsum("nk,kl,nl->n", seen, self._covariance, seen))


def _most_likely(shapes: Array, mean: Array, count: Array) -> Array:
    """Least Σ count·(log S + mean/S), log S = shapes·b: Newton's method on a convex function.

    For several means and counts (B, m) at once, each by itself: b is (k, m).
    """
    mean, count = mean.T, count.T
    small = 1e-9 * np.eye(shapes.shape[1])
    told = shapes.T @ (count[:, :, None] * shapes) + small
    b: Array = np.linalg.solve(told, ((count * np.log(mean)) @ shapes)[:, :, None]).astype(float)

    def at(b: Array) -> tuple[Array, Array]:
        """The cost, and the means as shares of the curve."""
        z = np.clip(b[:, :, 0] @ shapes.T, -700, 700)
        share = mean * np.exp(-z)
        return (count * (z + share)).sum(axis=1), share

    (here, share), length = at(b), np.ones(len(b))
    for _ in range(50):
        gradient = (count * (1 - share)) @ shapes
        hessian = shapes.T @ ((count * share)[:, :, None] * shapes)
        # Of one power that dwarfs all others one direction is told: so much of another is known.
        hessian = hessian + np.trace(hessian, axis1=1, axis2=2)[:, None, None] * small + small
        step, length[:] = np.linalg.solve(hessian, gradient[:, :, None]), 1.0
        after, share = at(b - step)
        while (longer := ~(after <= here) & (length > 1e-6)).any():
            length[longer] /= 2
            after, share = at(b - length[:, None, None] * step)
        b, before, here = b - length[:, None, None] * step, here, after
        if (before - here < 1e-4).all():
            break
    return np.asarray(b[:, :, 0].T)
