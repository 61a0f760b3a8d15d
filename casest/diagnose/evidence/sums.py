"""Sums over narrow bands of frequencies: all that a likelihood asks of columns.

Within a narrow band a spectrum is taken as flat. What least squares beside any spectrum gives then
follows from sums of products of columns over each band, and not from the rows again.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.spectrum import Bands, band_edges

#: Narrow bands: so many for each of those of a smooth curve.
FINER = 2


class Narrow:
    """Rows (N,) by frequency, of several axes each; `flat`: noise is white, all rows are one."""

    def __init__(self, frequency: Array, axes: int, *, flat: bool = False) -> None:
        order = np.argsort(frequency, kind="stable")
        count = len(order)
        # Of one stretch they are in order: no copies then.
        self._order: Any = slice(None) if np.all(np.diff(frequency) >= 0) else order
        starts = np.arange(1) if flat else band_edges(count, finer=FINER)
        self.axes, self._rows, self._starts = axes, count, starts
        self._ends = np.append(starts[1:], count)
        self.size = (self._ends - starts).astype(float)
        self._frequency = np.exp(np.add.reduceat(np.log(frequency[order]), starts) / self.size)
        self._band = np.empty(count, dtype=int)
        self._band[order] = np.repeat(np.arange(len(starts)), self._ends - starts)

    @cached_property
    def _bands(self) -> Bands:
        return Bands(self._frequency, self.size)

    @property
    def count(self) -> Array:
        """Rows of each band and axis (K,)."""
        return np.repeat(self.size, self.axes)

    def of(self, one: Array, other: Array) -> Array:
        """Sums of products (K, a, b) of columns (N·m, a) and (N·m, b): K bands by m axes."""
        a = one.reshape(self._rows, self.axes, one.shape[1])[self._order].transpose(1, 2, 0)
        b = other.reshape(self._rows, self.axes, other.shape[1])[self._order].transpose(1, 0, 2)
        found = np.empty((len(self._starts), self.axes, one.shape[1], other.shape[1]))
        for k, (start, end) in enumerate(zip(self._starts, self._ends, strict=True)):
            np.matmul(a[:, :, start:end], b[:, start:end], out=found[k])
        return found.reshape(len(self.count), *found.shape[2:])

    def along(self, columns: Array, one: Array) -> Array:
        """Sums of products (K, a) of columns (N·m, a) with a single one (N·m,)."""
        shape = (self._rows, self.axes, columns.shape[1])
        products = (columns * one[:, None]).reshape(shape)[self._order]
        found = np.add.reduceat(products, self._starts, axis=0)
        return np.asarray(found.reshape(len(self.count), shape[2]))

    def summed(self, values: Array) -> Array:
        """Over each band (K,), of values at each row and axis (N·m,)."""
        rows = values.reshape(-1, self.axes)[self._order]
        return np.asarray(np.add.reduceat(rows, self._starts, axis=0).ravel())

    def spectrum(self, power: Array, free: Array) -> Array:
        """Of every band and axis (K,), from powers and frequencies that a fit leaves free (K,)."""
        shape = (-1, self.axes)
        return self._bands.curves(power.reshape(shape), free.reshape(shape)).ravel()

    def at_rows(self, spectrum: Array) -> Array:
        """A spectrum (K,) at each row and axis (N·m,)."""
        return np.asarray(spectrum.reshape(-1, self.axes)[self._band].ravel())
