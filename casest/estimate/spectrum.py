"""The noise's spectrum as a smooth curve: what a record that is not long says of coloured noise.

The logarithm of the spectrum is a polynomial in the logarithm of the frequency, fitted to the
cosine transform of the residual by Whittle's likelihood (P. Whittle, 1953): five numbers that cover
white, autoregressive, pink and wandering noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from casest.declaration.shapes import Array

#: Bands of frequencies over which powers are put together before the curve is fitted.
BANDS = 40
#: Frequencies in the first band; within it the spectrum is taken as flat.
FIRST = 8
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
    """Frequencies (N,) in cycles per sample, put together in bands once for all curves."""

    def __init__(self, frequency: Array) -> None:
        self._order = np.argsort(frequency, kind="stable")
        log = np.log(frequency[self._order])
        edges = np.unique(np.round(np.geomspace(FIRST, max(len(log), FIRST), BANDS)).astype(int))
        self._edges = np.concatenate([[0], edges[edges < len(log)]])
        self._size = np.diff(np.append(self._edges, len(log)))
        self._middle = np.add.reduceat(log, self._edges) / self._size
        self._log = np.log(frequency)
        self._edge = float(log[min(FIRST, len(log)) - 1])

    def curve(self, power: Array, left: Array) -> Array:
        """The most likely smooth spectrum (N,) of powers (N,), of which a fit left a share each."""
        return self.smooth(power, left)(self._log)

    def smooth(self, power: Array, left: Array) -> Callable[[Array], Array]:
        """The same as a function of the logarithm of the frequency."""
        count = np.add.reduceat(left[self._order], self._edges)
        mean = np.add.reduceat(power[self._order], self._edges) / np.maximum(count, 1e-300)
        told = (count > LEFT * self._size) & (mean > 0)
        if not told.any():
            return lambda log: np.full(np.shape(log), 1e-300)
        middle = self._middle[told]
        # Flat to the first band's end: nothing holds a curve between its middle and there.
        middle = np.where(middle == self._middle[0], max(self._edge, middle[0]), middle)
        low, high = float(middle.min()), float(middle.max())
        order = min(ORDER, int(told.sum()) - 1)

        def shapes(log: Array) -> Array:
            place = np.clip(2 * (log - low) / max(high - low, 1e-300) - 1, -1, 1)
            return np.asarray(np.polynomial.legendre.legvander(place, order))

        curve = _most_likely(shapes(middle), mean[told], count[told])
        return lambda log: np.exp(shapes(log) @ curve)


def noise_spectrum(parts: Sequence[Powers]) -> Callable[[Array], Array]:
    """Power over frequency (cycles per sample), by Whittle's likelihood of the parts' powers."""
    f, power, left = (np.concatenate(column) for column in zip(*parts, strict=True))
    smooth = Bands(f).smooth(power, left)
    return lambda frequency: smooth(np.log(frequency))


def _most_likely(shapes: Array, mean: Array, count: Array) -> Array:
    """Least Σ count·(log S + mean/S), log S = shapes·b: Newton's method on a convex function."""
    root = np.sqrt(count)
    b = np.linalg.lstsq(shapes * root[:, None], np.log(mean) * root, rcond=None)[0]

    def cost(b: Array) -> float:
        z = np.clip(shapes @ b, -700, 700)
        return float(np.sum(count * (z + mean * np.exp(-z))))

    here = cost(b)
    for _ in range(50):
        share = mean * np.exp(-np.clip(shapes @ b, -700, 700))
        gradient = shapes.T @ (count * (1 - share))
        hessian = (shapes.T * (count * share)) @ shapes + 1e-9 * np.eye(len(b))
        step, length = np.linalg.solve(hessian, gradient), 1.0
        while length > 1e-6 and not cost(b - length * step) <= here:
            length /= 2
        b, before, here = b - length * step, here, cost(b - length * step)
        if before - here < 1e-6:
            break
    return np.asarray(b)
