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
#: Frequencies in the first band; below it the spectrum is taken as flat.
FIRST = 24
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


def noise_spectrum(parts: Sequence[Powers]) -> Callable[[Array], Array]:
    """Power over frequency (cycles per sample), by Whittle's likelihood of the parts' powers."""
    f, power, left = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(f)
    f, power, left = f[order], power[order], left[order]
    edges = np.unique(np.round(np.geomspace(FIRST, len(f), BANDS)).astype(int))
    edges = np.concatenate([[0], edges[edges < len(f)]])
    count = np.add.reduceat(left, edges)
    mean = np.add.reduceat(power, edges) / np.maximum(count, 1e-300)
    size = np.diff(np.append(edges, len(f)))
    middle = np.add.reduceat(np.log(f), edges) / size
    told = (count > LEFT * size) & (mean > 0)
    low, high = float(middle[told].min()), float(middle[told].max())

    def shapes(log_frequency: Array) -> Array:
        place = np.clip(2 * (log_frequency - low) / max(high - low, 1e-300) - 1, -1, 1)
        return np.asarray(np.polynomial.legendre.legvander(place, ORDER))

    curve = _most_likely(shapes(middle[told]), mean[told], count[told])
    return lambda frequency: np.exp(shapes(np.log(frequency)) @ curve)


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
