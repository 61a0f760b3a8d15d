"""The cost of residuals that are linear in all unknowns: one look at the samples tells it.

r(x + s) = r(x) + Js with one J everywhere, so JᵀJ = RᵀR everywhere too, and Qᵀr moves by Rs. What
follows of other places has the digits of a look there as long as the residual is more than
rounding, the normal equations are well conditioned, and the step changes residuals by no more than
they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from casest.declaration.shapes import Array
from casest.engine import Normal

#: R (n, n), Qᵀr (n,) and the norm of the rest of r.
Factor = tuple[Array, Array, float]
#: From this condition of the scaled Jacobian on a triangular factor is computed from the rows.
ROUGH = 1e4
#: Fall of the cost, as a factor, up to which it follows from a look elsewhere.
NEAR = 4.0
#: Residual beside what the unknowns contribute to it below which it may be rounding.
ROUNDING = 1e-6


class Look(NamedTuple):
    """What all samples said at unknowns `x` (n,)."""

    x: Array
    normal: Normal
    factor: Factor

    def normal_at(self, x: Array) -> Normal | None:
        """What they say there; None too far away to follow from this."""
        step = x - self.x
        change = self.normal.matrix @ step
        curved = 0.5 * float(step @ change)
        there = self.normal.cost + float(step @ self.normal.gradient) + curved
        if not curved <= self.normal.cost <= NEAR * there:
            return None
        return Normal(there, self.normal.gradient + change, self.normal.matrix)

    def factor_at(self, x: Array) -> Factor:
        """The factor there, as near as the normal equations are told."""
        R, t, rest = self.factor
        return R, t + R @ (x - self.x), rest


def look_at(x: Array, normal: Normal) -> Look | None:
    """A look that tells of other places; None where it has not the digits."""
    size = float(x @ (np.diag(normal.matrix) * x))
    factor = factored(normal) if normal.cost > ROUNDING**2 * size else None
    return None if factor is None else Look(x, normal, factor)


def factored(normal: Normal) -> Factor | None:
    """The factor from normal equations; None where they are too rough."""
    scale = np.sqrt(np.where(np.diag(normal.matrix) > 0, np.diag(normal.matrix), 1.0))
    try:
        lower = np.linalg.cholesky(normal.matrix / np.outer(scale, scale))
        t = np.linalg.solve(lower, normal.gradient / scale)
    except np.linalg.LinAlgError:
        return None
    rest = 2 * normal.cost - float(t @ t)
    # A residual that the Jacobian nearly explains loses its digits in the difference.
    rough = not np.diag(lower).min(initial=1.0) > 1 / ROUGH or not rest > 1e-6 * normal.cost
    return None if rough else (np.asarray(lower.T * scale), np.asarray(t), float(np.sqrt(rest)))
