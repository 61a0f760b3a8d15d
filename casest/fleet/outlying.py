"""A quick test of each sensor's residual: is the largest one larger than noise makes it?

The largest of M externally studentised residuals tᵢ = rᵢ/(σ₍ᵢ₎·√(1 − hᵢ)), hᵢ the leverage, with
Bonferroni's bound on its chance (Cook & Weisberg, Residuals and Influence in Regression, 1982,
2.2.2): one pose that was knocked, a glitch, a level that was misread. Leverages are computed of
the two samples with the largest residuals alone: the chance that is told is never too small.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri, stdtr

from casest.declaration.shapes import Array
from casest.fleet.fit import Fits, residual_counts
from casest.fleet.linear import cholesky
from casest.fleet.sums import Sensors, Squares

#: Share of a residual that must be left beside its leverage: below, the fit follows the reading.
LEFT = 1e-6


def outlying(squares: Squares, sensors: Sensors, fits: Fits) -> Array:
    """Probability that a sound sensor's largest residual is as large, (W,); 1 at most.

    NaN where a sensor has no two residuals more than unknowns.
    """
    count = residual_counts(squares, sensors)
    freedom = count - len(fits.x)
    with np.errstate(all="ignore"):
        squared, places = squares.largest(fits.x, sensors)
        few = sensors.samples[:, places, np.arange(len(squared))]
        largest = squares.studentised(fits.x, Sensors(few, None), cholesky(fits.matrix))
        own = np.minimum(largest * freedom / squared, freedom * (1 - LEFT))
        t = np.sqrt(own * (freedom - 1) / (freedom - own))
        chance = np.ones(len(t))
        # Student's tails are no lighter than the normal ones: below, the bound says nothing.
        told = ~(t < -ndtri(0.5 / count))
        chance[told] = 2 * count[told] * stdtr(freedom[told] - 1, -t[told])
        chance = np.minimum(1.0, chance)
    return np.asarray(np.where(freedom > 1, chance, np.nan))
