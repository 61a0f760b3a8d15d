"""What follows from fits side by side, and which of them are looked at further."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from casest.declaration.shapes import Array
from casest.fleet.fit import Fits, Flags, Places, padded
from casest.fleet.linear import cholesky, inverse, lengths


class Local(NamedTuple):
    """Fits with what follows from them: lengths of J's columns (n, W); in units of those the
    Cholesky factor of JᵀJ and (JᵀJ)⁻¹ (n, n, W); σ (W,), and σ or rounding, whichever is larger
    (W,)."""

    fits: Fits
    scale: Array
    factor: Array
    inverse: Array
    sigma: Array
    noise: Array

    def some(self, k: Places) -> Local:
        """Those of the sensors at these places."""
        return Local(self.fits.some(k), *(part[..., k] for part in self[1:]))


def local(fits: Fits, count: Array) -> tuple[Local, Array]:
    """What follows from fits with so many residuals (W,) each, and their degrees of freedom."""
    scale = lengths(fits.matrix)
    factor = cholesky(fits.matrix)
    factor /= scale[:, None]
    freedom = count - len(scale)
    sigma = np.sqrt(2 * fits.cost / np.where(freedom > 0, freedom, np.nan))
    noise = np.maximum(np.where(np.isfinite(sigma), sigma, 0.0), rounding(fits, count))
    return Local(fits, scale, factor, inverse(factor), sigma, noise), freedom


def rounding(fits: Fits, count: Array) -> Array:
    """Rounding error of one residual, from the sizes of what is added up in it, (W,)."""
    reach = np.einsum("iis,is->s", fits.matrix, fits.x**2) * len(fits.x) / count
    return np.asarray(4 * np.finfo(float).eps * np.sqrt(reach) + 1e-300)


def groups(chosen: Flags) -> list[Places]:
    """The chosen places in one group that NumPy handles alike, if there are any."""
    k = np.flatnonzero(chosen)
    return [padded(k)] if k.size else []
