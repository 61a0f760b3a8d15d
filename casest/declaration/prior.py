"""What is known of unknowns before these data: an earlier calibration, as normal as its fit was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array


@dataclass(frozen=True)
class Prior:
    """Values of parameters, by name, with the covariance of their coordinates one after the other.

    `values` are flat, `covariance` (k, k); `sigma` is the noise of a residual that the earlier fit
    had, by which data and prior are weighed where none is stated; `source` names the result.
    """

    names: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]
    shapes: tuple[tuple[int, ...], ...]
    covariance: tuple[tuple[float, ...], ...]
    sigma: float
    source: str

    @property
    def by_name(self) -> dict[str, Array]:
        """Values with their shapes."""
        of = zip(self.names, self.values, self.shapes, strict=True)
        return {name: np.array(value).reshape(shape) for name, value, shape in of}

    @property
    def root(self) -> Array:
        """R (k, k) with RᵀR the inverse of the covariance."""
        covariance = np.array(self.covariance)
        std = np.sqrt(np.diag(covariance))
        values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
        kept = np.maximum(values, 1e-15 * values.max(initial=0.0))
        return np.asarray((vectors / np.sqrt(kept)).T / std)
