"""Is most of what a table leaves in a few of its rows, which the others speak against?

A fit of few rows bends towards one that is off, and that row no longer stands out. So those few are
looked for that leave the others the least squares (P. Rousseeuw 1984), near the fit; the chance is
that of the F test of their own shifts, times the number of ways to choose them: a bound for normal
noise. It must hold as well where noise grows with something recorded: the others say how. Where
they are just those at the ends of something recorded, it is no fault of theirs that shows: the
model may not reach that far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.variables import Variable

#: Rows at least, such rows at most, and as a share of all.
FEWEST, MOST_ROWS, SHARE = 6, 5, 0.25
#: Starts of the search, each of as many rows as determine the unknowns, and steps of each.
STARTS, STEPS = 50, 20
#: Logarithm of how small a residual counts as at least, in their median: by chance one is nothing.
LEAST = 2.0
#: The same of how far noise may grow beyond the rows that say how.
FURTHEST = 5.0


@dataclass(frozen=True)
class FewRows:
    """The rows, their share of the squares, and the chance."""

    rows: Index
    share: float
    p_value: float


def few_rows(
    residual: Array,
    slopes: Array,
    rounding: float = 0.0,
    variables: Sequence[Variable] = (),
) -> FewRows | None:
    """Of residuals (N, m) and their slopes (N, m, p); None where no few rows hold most of it, or
    noise may have done that, which is at least what `rounding` makes (a standard deviation), and
    may grow with any of the `variables`."""
    found = _few_rows(residual, slopes, rounding)
    if found is None:
        return None
    kept = np.setdiff1d(np.arange(len(residual)), found.rows)
    Q = _orthonormal(slopes, residual.shape)
    after = _left(residual, Q, kept[None])[0][0]
    for variable in variables:
        size = _growing(after, kept, np.concatenate(variable.values))
        sized = _orthonormal(slopes / size[:, None, None], residual.shape)
        chance = _chance(residual / size[:, None], sized, kept, rounding)
        found = replace(found, p_value=max(found.p_value, chance))
    return found if found.p_value < LEVELS.chance else None


def _growing(after: Array, kept: Index, x: Array) -> Array:
    """How large noise is at each row (N,), in its usual size, by what `kept` rows (K,) leave
    (N, m) of a fit to them: as exp(b·x), its logarithm by a line. Of an x that these do not vary
    nothing is known."""
    log = np.log(np.maximum(np.linalg.norm(after[kept], axis=1), 1e-300))
    log = np.maximum(log, np.median(log) - LEAST)
    away = (x - x[kept].mean()) / max(float(np.ptp(x)), 1e-300)
    squares = float(away[kept] @ away[kept])
    b = float(away[kept] @ log) / squares if squares > 1e-18 else 0.0
    return np.asarray(np.exp(np.clip(b * away, -FURTHEST, FURTHEST)))


def _orthonormal(slopes: Array, shape: tuple[int, ...]) -> Array:
    """Of what the unknowns do (N, m, p): those directions of it that there are."""
    flat = slopes.reshape(shape[0] * shape[1], -1)
    length = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    U, size, _ = np.linalg.svd(flat / length, full_matrices=False)
    return np.asarray(U[:, size > 1e-12 * size.max(initial=0.0)].reshape(*shape, -1))


def _chance(residual: Array, Q: Array, kept: Index, rounding: float) -> float:
    """Of the F test of shifts of all rows but those kept, times the ways to choose them."""
    from scipy.special import fdtrc

    rows, axes = residual.shape
    few, most = rows - len(kept), min(MOST_ROWS, int(SHARE * rows))
    whole, least = (float(_left(residual, Q, k[None])[1][0]) for k in (np.arange(rows), kept))
    rest = residual.size - Q.shape[2] - axes * few
    F = (whole - least) / (axes * few) / max(least / rest + rounding**2, 1e-300)
    return min(1.0, float(fdtrc(axes * few, rest, F)) * comb(rows, few) * most)


def _few_rows(residual: Array, slopes: Array, rounding: float) -> FewRows | None:
    """The same of noise that is alike everywhere."""
    from scipy.special import fdtrc

    rows, axes = residual.shape
    most = min(MOST_ROWS, int(SHARE * rows))
    if rows < FEWEST or not np.isfinite(slopes).all():
        return None
    Q = _orthonormal(slopes, residual.shape)
    freedom = residual.size - Q.shape[2]
    if not Q.size or freedom < 1:  # of an estimate that is refused nothing may be determined
        return None
    least = float(_left(residual, Q, np.arange(rows)[None])[1][0])
    whole, best = least, None
    for k in range(1, most + 1):
        rest = freedom - axes * k
        if rest < 2:
            break
        before, (kept, least) = least, _least(residual, Q, rows - k)
        noise = least / rest + rounding**2
        one = (before - least) / axes / max(noise, 1e-300)
        if best is not None and float(fdtrc(axes, rest, one)) * (rows - k) > LEVELS.chance:
            break  # one more is the furthest of the others, as one of them is
        chance = _chance(residual, Q, kept, rounding)
        share = 1 - least / max(whole, 1e-300)
        if share > LEVELS.most and chance < LEVELS.chance:
            best = FewRows(np.setdiff1d(np.arange(rows), kept), share, chance)
    return best


def at_the_ends(rows: Index, variables: Sequence[Variable]) -> str:
    """Which ends of which variable these rows (k,) are, that no others are beyond; empty where
    rows that are chosen at random would be as well, or they are anywhere.

    Of k of N rows k + 1 choices are the outermost: so many at one end, and the rest at the other.
    """
    ranked = [v for v in variables if not v.turns]
    for v in ranked:
        x = np.concatenate(v.values)
        own, others = x[rows], np.delete(x, rows)
        low, high = own < others.min(), own > others.max()
        chance = (len(rows) + 1) / comb(len(x), len(rows)) * len(ranked)
        if np.all(low | high) and chance < LEVELS.chance:
            ends = "both ends" if low.any() and high.any() else "one end"
            return f"{ends} of {'the record' if v.clock else v.name}"
    return ""


def _left(residual: Array, Q: Array, kept: Index) -> tuple[Array, Array]:
    """What fits to several choices of rows (S, n) leave of each row, (S, N, m), and the sums of
    squares (S,) in these; `Q` (N, m, p): what the unknowns do."""
    own = Q[kept].reshape(len(kept), -1, Q.shape[2])
    turned, there = own.transpose(0, 2, 1), residual[kept].reshape(len(kept), -1, 1)
    step = np.linalg.pinv(turned @ own, rcond=1e-12, hermitian=True) @ (turned @ there)
    after = residual - np.einsum("nmp,sp->snm", Q, step[:, :, 0])
    squares = np.sum(after**2, axis=2)
    return after, np.take_along_axis(squares, kept, axis=1).sum(axis=1)


def _least(residual: Array, Q: Array, count: int) -> tuple[Index, float]:
    """So many rows whose own fit leaves them the least squares, by steps that only fall."""
    rng, rows = np.random.default_rng(0), len(residual)
    few = min(count, Q.shape[2] // residual.shape[1] + 1)
    after, _ = _left(residual, Q, np.arange(rows)[None])
    starts = np.array([rng.permutation(rows)[:few] for _ in range(STARTS)])
    after = np.concatenate([after, _left(residual, Q, starts)[0]])
    least = np.full(len(after), np.inf)
    chosen = np.zeros((len(after), count), dtype=int)
    for _ in range(STEPS):
        order = np.argsort(np.sum(after**2, axis=2), axis=1, kind="stable")[:, :count]
        after, squares = _left(residual, Q, order)
        if np.all(squares >= least):
            break
        chosen = np.where((squares < least)[:, None], order, chosen)
        least = np.minimum(squares, least)
    best = int(np.argmin(least))
    return np.sort(chosen[best]), float(least[best])
