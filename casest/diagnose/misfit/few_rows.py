"""Is most of what a table leaves in a few of its rows, which the others speak against?

A fit of few rows bends towards one that is off, and that row no longer stands out. So those few are
looked for that leave the others the least squares (P. Rousseeuw 1984), near the fit; the chance is
that of the F test of their own shifts, times the number of ways to choose them: a bound for normal
noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index
from casest.diagnose.levels import LEVELS

#: Rows at least, such rows at most, and as a share of all.
FEWEST, MOST_ROWS, SHARE = 6, 5, 0.25
#: Starts of the search, each of as many rows as determine the unknowns, and steps of each.
STARTS, STEPS = 50, 20


@dataclass(frozen=True)
class FewRows:
    """The rows, their share of the squares, the chance, and the others' standard deviation."""

    rows: Index
    share: float
    p_value: float
    sigma: float


def few_rows(residual: Array, slopes: Array, rounding: float = 0.0) -> FewRows | None:
    """Of residuals (N, m) and their slopes (N, m, p); None where no few rows hold most of it, or
    noise may have done that, which is at least what `rounding` makes (a standard deviation)."""
    from scipy.special import fdtrc

    rows, axes = residual.shape
    live = np.linalg.norm(slopes.reshape(-1, slopes.shape[2]), axis=0) > 0
    J, most = slopes[:, :, live], min(MOST_ROWS, int(SHARE * rows))
    freedom = residual.size - J.shape[2]
    if rows < FEWEST or freedom < 1:
        return None
    least = _left(residual, J, np.arange(rows))[1]
    whole, best = least, None
    for k in range(1, most + 1):
        rest = freedom - axes * k
        if rest < 2:
            break
        kept = _least(residual, J, rows - k)
        before, least = least, _left(residual, J, kept)[1]
        noise = least / rest + rounding**2
        one = (before - least) / axes / max(noise, 1e-300)
        if best is not None and float(fdtrc(axes, rest, one)) * (rows - k) > LEVELS.chance:
            break  # one more is the furthest of the others, as one of them is
        F = (whole - least) / (axes * k) / max(noise, 1e-300)
        chance = min(1.0, float(fdtrc(axes * k, rest, F)) * comb(rows, k) * most)
        share = 1 - least / max(whole, 1e-300)
        if share > LEVELS.most and chance < LEVELS.misfit:
            gone = np.setdiff1d(np.arange(rows), kept)
            best = FewRows(gone, share, chance, float(np.sqrt(least / rest)))
    return best


def _left(residual: Array, J: Array, kept: Index) -> tuple[Array, float]:
    """What a fit to some rows leaves of each (N, m), and its sum of squares in these."""
    flat = J[kept].reshape(-1, J.shape[2])
    size = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    step = np.linalg.lstsq(flat / size, residual[kept].ravel(), rcond=1e-12)[0] / size
    after = residual - J @ step
    return after, float(np.sum(after[kept] ** 2))


def _least(residual: Array, J: Array, count: int) -> Index:
    """So many rows whose own fit leaves them the least squares, by steps that only fall."""
    rng, rows = np.random.default_rng(0), len(residual)
    few = min(count, J.shape[2] // residual.shape[1] + 1)
    found: tuple[float, Index] = (np.inf, np.arange(count))
    starts = [np.arange(rows), *(rng.permutation(rows)[:few] for _ in range(STARTS))]
    for chosen in starts:
        squares = np.inf
        for _ in range(STEPS):
            after, _ = _left(residual, J, chosen)
            nearest = np.sort(np.argsort(np.sum(after**2, axis=1), kind="stable")[:count])
            now = _left(residual, J, nearest)[1]
            if now >= squares:
                break
            chosen, squares = nearest, now
        found = min(found, (squares, chosen), key=lambda f: f[0])
    return found[1]
