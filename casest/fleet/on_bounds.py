"""Which unknowns of many sensors lie on a bound, and whether they should: `estimate.on_bounds`."""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.reasons import BEYOND, ON_BOUND, STEP, Code
from casest.fleet.fit import Bounds, Flags, Places
from casest.fleet.linear import whole
from casest.fleet.local import Local, groups, local
from casest.fleet.sums import Sensors, Squares
from casest.fleet.verdicts import Judged


def bounded(
    found: Judged, here: Local, sensors: Sensors, bounds: Bounds, squares: Squares, never: Flags
) -> tuple[Local, Flags]:
    """The fits with the unknowns held that rightly lie on a bound, and which those are, (n, W).

    See `estimate.on_bounds`: there the cost must rise inwards, and the data may ask for little
    beyond; of the unknowns `never` (n,) a bound is no answer. Held, an unknown is coupled to no
    other.
    """
    x, width = here.fits.x, ON_BOUND * here.noise / here.scale
    above = x >= bounds.upper - width
    near = (x <= bounds.lower + width) | above
    held, wrong = np.zeros_like(near), np.zeros_like(near)
    for k in groups(np.asarray(near.any(axis=0))):
        at, some = x[:, k], sensors.some(k)
        slope = squares.pulled(at, some, squares.residuals(at, some))
        inwards = np.where(above[:, k], -slope, slope)
        rows = whole(here.fits.matrix[:, :, k])
        for j, s in enumerate(k):
            on = np.flatnonzero(near[:, s])
            rest = 2 * here.fits.cost[s], found.equations[s] - len(x)
            beyond = _beyond(rows[:, :, j], on, inwards[on, j], here.noise[s], *rest)
            wrong[on, s] = ~(beyond <= BEYOND) | never[on]
            held[on, s] = ~wrong[on, s] & (beyond >= -STEP)
            wrong[on, s] &= beyond >= -STEP
    found.bound[:] = np.argmax(np.where(wrong.any(axis=0), wrong, near), axis=0)
    found.lower[:], found.upper[:] = (
        np.take_along_axis(side, found.bound[None], axis=0)[0] for side in bounds
    )
    found.add(Code.BOUND, np.asarray(wrong.any(axis=0)))
    held &= ~wrong.any(axis=0)
    if not held.any():
        return here, held
    apart = held[:, None] | held
    apart[np.arange(len(x)), np.arange(len(x))] = False
    matrix = np.where(apart, 0.0, here.fits.matrix)
    fits = here.fits._replace(matrix=matrix)
    return local(fits, found.equations.astype(float))[0], held


def _beyond(
    matrix: Array, on: Places, slope: Array, noise: float, squares: float, freedom: float
) -> Array:
    """Standard deviations by which the data ask for values beyond their bounds; negative: inside.

    `matrix` (n, n) is JᵀJ, `slope` that of the cost inwards at the unknowns `on`. What a bound
    costs of the residual's sum of `squares` is no noise.
    """
    free = np.setdiff1d(np.arange(len(matrix)), on).astype(int)
    found = np.empty(len(on))
    for j, i in enumerate(on):
        across = matrix[free, i]
        left = matrix[i, i] - across @ np.linalg.lstsq(matrix[np.ix_(free, free)], across, None)[0]
        pull = slope[j] / np.sqrt(left) if left > 0 else np.inf
        rest = float(np.sqrt(max(squares - pull**2, 0.0) / max(freedom, 1)))
        found[j] = pull / max(min(noise, rest), 1e-3 * noise, 1e-300)
    return found
