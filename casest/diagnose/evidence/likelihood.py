"""How likely a residual is beside some columns, its noise estimated together with them.

The cosine transform of coloured noise is nearly independent from frequency to frequency, with the
spectrum as its variance, and −2 log L = Σ log S + R²/S (P. Whittle, 1953). The spectrum is a smooth
curve, fitted to what these very columns leave, with the power given back that the fit takes from
each frequency: estimated from a residual that still holds the cause, it would count the cause as
noise; without the leverage, smooth columns would win in noise of any colour. Poses and tables have
white noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index, Linear, alike, robust_sd
from casest.diagnose.levels import LEVELS
from casest.estimate.spectrum import Bands

#: Rounds in which coefficients and spectrum follow each other: more change nothing.
REWEIGHTED = 2
#: Share of the power at a frequency that a fit leaves, at least.
LEFT = 0.05


@dataclass(frozen=True)
class Explained:
    """−2 log L beside some columns; the spectrum S and what is left (N·m,), by frequency.

    `values`: of the orthonormal declared unknowns, then of the columns (p + k,).
    """

    cost: float
    spectrum: Array
    left: Array
    values: Array


class Likelihood:
    """A linear problem by frequency; `cut` (N, m) is taken from its residual: what is far out.

    Of two fits the same must be cut: what one explains and the other does not is far out of the
    other alone.
    """

    def __init__(self, linear: Linear, cut: Array | None = None) -> None:
        self.linear = linear
        self.shape = linear.residual.shape
        self.cut = far_out(linear.residual) if cut is None and linear.series else cut

    @cached_property
    def _bands(self) -> Bands:
        frequency = np.empty(self.shape[0])
        for span in self.linear.spans:
            n = span.stop - span.start
            frequency[span] = (np.arange(n) + 0.5) / (2 * n)
        means = self._means
        frequency[means] = (np.arange(len(means)) + 0.5) / (2 * self.shape[0])
        return Bands(frequency)

    @cached_property
    def _means(self) -> Index:
        """Where the means of stretches are, if these are many: what is slow goes on from pose to
        pose, and their means are a series as well."""
        spans = self.linear.spans
        return np.array([s.start for s in spans if len(spans) >= LEVELS.stretches], int)

    @cached_property
    def declared(self) -> Array:
        """Orthonormal columns (N·m, p) of the unknowns."""
        return self.by_frequency(self.linear.basis.reshape(*self.shape, -1))

    @cached_property
    def residual(self) -> Array:
        """(N·m,), without what is cut."""
        r = self.linear.residual
        return self.by_frequency((r if self.cut is None else r - self.cut)[:, :, None])[:, 0]

    def by_frequency(self, columns: Array) -> Array:
        """(N, m, k) as (N·m, k): each stretch by its cosines, and the means of many by theirs."""
        from scipy.fft import dct

        if self.linear.coloured:
            flat = columns.reshape(len(columns), -1)
            told = flat.any(axis=0)  # what acts on one axis is nothing on the others
            flat, found = flat[:, told], np.zeros(columns.shape)
            for span in self.linear.spans:
                flat[span] = dct(flat[span], axis=0, norm="ortho")
            if len(self._means):
                flat[self._means] = dct(flat[self._means], axis=0, norm="ortho")
            found.reshape(flat.shape[0], -1)[:, told] = flat
            columns = found
        return columns.reshape(columns.shape[0] * columns.shape[1], -1)

    def in_time(self, columns: Array) -> Array:
        """(N·m, k) as (N, m, k) again."""
        from scipy.fft import idct

        columns = columns.reshape(*self.shape, -1)
        if not self.linear.coloured:
            return columns
        columns, found = columns.copy(), np.empty(columns.shape)
        if len(self._means):
            columns[self._means] = idct(columns[self._means], axis=0, norm="ortho")
        for span in self.linear.spans:
            found[span] = idct(columns[span], axis=0, norm="ortho")
        return found

    def beyond(self, columns: Array) -> Array:
        """Orthonormal (N·m, k) of what columns (N, m, q) do that the unknowns cannot."""
        left = self.remainder(columns)
        return np.asarray(left @ self.orthonormal(left))

    def remainder(self, columns: Array) -> Array:
        """(N·m, q): columns (N, m, q), each of length one, without what the unknowns can do."""
        flat = columns.reshape(self.residual.size, -1)
        size = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
        flat = self.by_frequency((flat / size).reshape(*self.shape, -1))
        Q = self.declared
        left = flat - Q @ (Q.T @ flat)
        left -= Q @ (Q.T @ left)
        return np.asarray(left)

    def orthonormal(self, left: Array) -> Array:
        """(q, k): combinations of such remainders that are orthonormal, where enough is left."""
        values, vectors = np.linalg.eigh(left.T @ left)
        kept = values > max(self.linear.least**2, 1e-8 * values.max(initial=0.0))
        return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))

    def beside(
        self, columns: Sequence[Array] = (), start: Array | None = None, rounds: int = REWEIGHTED
    ) -> Explained:
        """The residual beside the unknowns and orthonormal columns (N·m, k) each."""
        X = np.concatenate([self.declared, *columns], axis=1)
        R, S = self.residual, start
        if S is None:
            S, rounds = np.ones_like(R), rounds + 1
        if not self.linear.coloured:
            values = X.T @ R if not columns else np.linalg.lstsq(X, R, rcond=None)[0]
            left = R - X @ values
            power = max(float(left @ left) / len(R), 1e-300)
            return Explained(len(R) * np.log(power), np.full_like(R, power), left, values)
        for _ in range(rounds):
            root = 1 / np.sqrt(S)
            Xw = X * root[:, None]
            values, taken = _solved(Xw, R * root)
            left = R - X @ values
            S = self.spectrum(left, 1 - taken)
        return Explained(float(np.sum(np.log(S) + left**2 / S)), S, left, values)

    def spectrum(self, left: Array, free: Array) -> Array:
        """Of every axis, from what is left and the share that the fit leaves free."""
        power, free = (left**2).reshape(self.shape), np.clip(free, LEFT, 1).reshape(self.shape)
        return self._bands.curves(power, free).ravel()

    def course(self, explained: Explained, columns: Sequence[Array]) -> Array:
        """What unknowns and columns explain, (N, m) in time."""
        X = np.concatenate([self.declared, *columns], axis=1)
        return self.in_time((X @ explained.values)[:, None])[:, :, 0]


def far_out(residual: Array) -> Array:
    """(N, m): what residuals have beyond some robust standard deviations from their middle.

    Beside a course that coloured noise leaves free to be anywhere on average, they have one.
    """
    far, middle = LEVELS.clip * robust_sd(residual), np.median(residual, axis=0)
    return np.asarray(residual - np.clip(residual, middle - far, middle + far))


def beside_a_colour(likelihood: Likelihood) -> float:
    """−2 log L where the noise has a spectrum of its own, and no more."""
    return likelihood.beside().cost


def rises(
    less: Linear, fits: Sequence[Linear], of: Callable[[Likelihood], float] = beside_a_colour
) -> list[float]:
    """2 log of the likelihood of each fit over that of one with less in it; each has its own noise.

    What the fit with the least noise leaves far out is cut from all of them. `of`: −2 log L.
    """
    less, *fits = alike([less, *fits])
    best = min(fits, key=lambda x: float(np.sum(np.log(robust_sd(x.residual)))))

    def cost(linear: Linear) -> float:
        alike = linear.residual.shape == best.residual.shape  # rows that moved in time are others
        cut = far_out(best.residual) if alike and linear.series else None
        return of(Likelihood(linear, cut))

    none = cost(less)
    return [none - cost(fit) for fit in fits]


def _solved(X: Array, y: Array) -> tuple[Array, NDArray[Any]]:
    """Least squares, and the leverage of each row."""
    A = X.T @ X
    size = np.sqrt(np.maximum(np.diag(A), 1e-300))
    inverse = np.linalg.inv(A / np.outer(size, size) + 1e-12 * np.eye(len(A)))
    inverse /= np.outer(size, size)
    return inverse @ (X.T @ y), np.einsum("ij,ij->i", X @ inverse, X)
