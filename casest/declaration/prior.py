"""What is known of unknowns before these data: an earlier calibration, as normal as its fit was, or
what a declaration says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casest.declaration.shapes import Array


@dataclass(frozen=True)
class Prior:
    """Values of parameters, by name, with the covariance of their coordinates one after the other.

    `values` are flat, `covariance` (k, k); `sigma` is the noise of a residual that the earlier fit
    had, by which data and prior are weighed where none is stated, None where nobody says it;
    `source` names the result. Of a parameter that each run has for itself the same is known in
    every run, independently of all else.
    """

    names: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]
    shapes: tuple[tuple[int, ...], ...]
    covariance: tuple[tuple[float, ...], ...]
    sigma: float | None
    source: str

    @property
    def by_name(self) -> dict[str, Array]:
        """Values with their shapes."""
        of = zip(self.names, self.values, self.shapes, strict=True)
        return {name: np.array(value).reshape(shape) for name, value, shape in of}

    def without(self, name: str, coordinates: int | None = None) -> Prior | None:
        """What is known of the others; None where there are none. `coordinates` of the one that
        goes, where it has fewer than numbers."""
        kept = [i for i, own in enumerate(self.names) if own != name]
        if len(kept) == len(self.names):
            return self
        if not kept:
            return None
        first = sum(map(len, self.values[: self.names.index(name)]))
        width = len(self.values[self.names.index(name)]) if coordinates is None else coordinates
        gone = range(first, first + width)
        rows = [i for i in range(len(self.covariance)) if i not in gone]
        return replace(
            self,
            names=tuple(self.names[i] for i in kept),
            values=tuple(self.values[i] for i in kept),
            shapes=tuple(self.shapes[i] for i in kept),
            covariance=tuple(tuple(self.covariance[i][j] for j in rows) for i in rows),
        )

    def beside(self, declared: Prior | None) -> Prior:
        """Both, of which this one says what the other says too; they know nothing of each other."""
        for name in self.names:
            declared = None if declared is None else declared.without(name)
        if declared is None:
            return self
        return replace(
            self,
            names=(*self.names, *declared.names),
            values=(*self.values, *declared.values),
            shapes=(*self.shapes, *declared.shapes),
            covariance=_block_diagonal(self.covariance, declared.covariance),
            sigma=self.sigma if declared.sigma is None else declared.sigma,
            source=f"{self.source} and {declared.source}",
        )


def root(covariance: Array) -> Array:
    """R (k, k) with RᵀR the inverse of the covariance."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    kept = np.maximum(values, 1e-15 * values.max(initial=0.0))
    return np.asarray((vectors / np.sqrt(kept)).T / std)


def _block_diagonal(
    first: tuple[tuple[float, ...], ...], second: tuple[tuple[float, ...], ...]
) -> tuple[tuple[float, ...], ...]:
    before, after = (0.0,) * len(first), (0.0,) * len(second)
    return (*((*row, *after) for row in first), *((*before, *row) for row in second))
