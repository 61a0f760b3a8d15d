"""Are innovations white? What is predictable in them is a misfit, or noise with a colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array

#: Bands of lags, as shares of the longest that is looked at; each one counts alike.
LAGS = (1, 2, 4, 8, 16, 32, 64, 128, 256)


@dataclass(frozen=True)
class Whiteness:
    """Significance of what whitened innovations tell of later ones, and where it lives.

    `share` of their variance that a linear prediction from the bands explains, `lag` (samples) of
    the band that says most.
    """

    p_value: float
    share: float
    lag: int


def whiteness(z: Array) -> Whiteness:
    """Of z (N, m), white with unit variance if the filter is right.

    The mean of the last 1, 2, 4 … samples of a component foretells nothing of its next one: a
    regression on those means explains no more than its share of chance.
    """
    from scipy.special import chdtrc

    sums = np.cumsum(np.vstack([np.zeros((1, z.shape[1])), z]), axis=0)
    lags = [lag for lag in LAGS if lag < len(z) // 20]
    first = lags[-1] if lags else 1
    explained = np.zeros(len(lags))
    total = 0.0
    for component, summed in zip(z.T, sums.T, strict=True):
        past = np.array([(summed[first:-1] - summed[first - lag : -1 - lag]) for lag in lags])
        products = past @ component[first:]
        total += float(products @ np.linalg.solve(past @ past.T, products))
        explained += products**2 / np.sum(past**2, axis=1)
    count = len(lags) * z.shape[1]
    p_value = float(chdtrc(count, total))
    share = max(0.0, (total - count) / z[first:].size)
    return Whiteness(p_value, share, int(lags[int(np.argmax(explained))]))
