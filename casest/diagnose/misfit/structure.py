"""Is a residual a function of something? Neighbours in its order are alike then.

Rows are put in the order of a variable and averaged over blocks; the squared differences of
neighbouring means against their variance (J. von Neumann, 1941) are 1 on average for what follows
nothing. Of a table's single rows, whose noise may be larger at one end and have any tails, the
products of neighbours are summed, against their own squares: that is normal whatever the sizes are,
and says nothing of fewer than PRODUCTS rows, which are asked by that ratio as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.variables import Variable

#: Means at least, as many as are wanted, and rows in each of a series, whose noise may have a
#: colour. Of eight means no order is unlikely enough.
FEWEST, WANTED, SHORTEST = 8, 24, 4
#: Rows of a table at least, each of which is measured by itself; and from which on products of so
#: few can be unlikely. Of fewer von Neumann's ratio is asked: beside noise that grows in proportion
#: along the order it says so in one to three of a thousand tables.
FEW_ROWS, PRODUCTS = 12, 30


@dataclass(frozen=True)
class Structure:
    """What the residual follows, the share of its variance that does, and the chance of as much."""

    name: str
    share: float
    p_value: float


def structures(
    residuals: Sequence[Array], variables: Sequence[Variable], *, table: bool = False
) -> list[Structure]:
    """Of every variable, the least likely first; residuals (N, m) of each run, clipped.

    Rows of a `table` are looked at one by one: means of so few blocks are never unlikely.
    """
    r = np.concatenate(residuals)
    found = []
    for variable in variables:
        x = np.concatenate(variable.values)
        if variable.turns:
            x = np.mod(x, 2 * np.pi)
        ordered = r[np.argsort(x, kind="stable")]
        found.append(_structure(variable.name, ordered, len(variables), table))
    return sorted((f for f in found if f is not None), key=lambda f: f.p_value)


def _structure(name: str, r: Array, tried: int, table: bool) -> Structure | None:
    """What rows (N, m) in the order of a variable say, one by one or in means of several."""
    from scipy.special import ndtr

    size = max(SHORTEST, min(LEVELS.block, len(r) // WANTED), len(r) // LEVELS.blocks)
    size = 1 if table else size
    count = len(r) // size
    if count < (FEW_ROWS if table else FEWEST):
        return None
    means = r[: count * size].reshape(count, size, -1).mean(axis=1)
    steps = np.mean(np.diff(means, axis=0) ** 2, axis=0) / 2
    variance = np.maximum(means.var(axis=0, ddof=1), 1e-300)
    z = _of_products(means) if count >= PRODUCTS and table else _of_ratios(steps / variance, count)
    share = float(np.maximum(variance - steps, 0).sum() / max(r.var(axis=0).sum(), 1e-300))
    return Structure(name, share, float(min(1.0, ndtr(-z.max()) * len(z) * tried)))


def _of_products(rows: Array) -> Array:
    """Normal where rows (N, m) follow nothing, whatever their sizes are; (m,)."""
    away = rows - rows.mean(axis=0)
    products = away[1:] * away[:-1]
    return np.asarray(products.sum(axis=0) / np.sqrt(np.maximum((products**2).sum(axis=0), 1e-300)))


def _of_ratios(ratio: Array, count: int) -> Array:
    """Von Neumann's ratios of so many means of one size, as standard normals."""
    return np.asarray((1 - ratio) / np.sqrt((count - 2) / (count**2 - 1.0)))
