"""Which rows carry what a refit adds: in poses, whatever the sizes of their errors, and where
neighbours go together; in a series, whether more than a few do.

The classical F test takes every row's error to be of one size and for itself. A row that is off
alone, noise that is larger at one end, or a sweep in which each reading is off as the one before
it, make an effect of whatever is largest there. So does a burst of noise.
"""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Linear, robust_sd
from casest.diagnose.levels import LEVELS

#: Correlation of neighbours at most: of few rows nobody can tell more from it.
LIKEST = 0.95
#: Standard errors of that correlation from which on it is beyond chance, one-sided 1 %.
BEYOND = 2.33
#: Share of the rows of a series that are few.
FEW = 0.01


def chance_by_row(before: Linear, after: Linear, *, together: bool = False) -> float:
    """The chance of what a refit of poses adds to another.

    Wald's F with the variance that the jackknife gives (HC3; MacKinnon & White 1985), each fit
    linear about itself; `together`: and with what neighbours that are alike make of that variance
    (noise that remembers as ρᵏ). Nothing else may be missing then: it would be alike as well.
    """
    from scipy.special import fdtrc

    q, rest = _freedom(before, after)
    if rest < 1 or q < 1:
        return 1.0
    C = _beyond(before, after)
    added = C.T @ (before.residual - after.residual).ravel()
    moved = _by_each_row(after, C)
    F = float(added @ np.linalg.lstsq(moved.T @ moved, added, rcond=None)[0]) / q
    larger = _by_neighbours(C, len(after.residual), kinship(after)) if together else 1.0
    return float(fdtrc(q, rest, F / larger))


def chance_together(before: Linear, after: Linear, over: float = 1.0) -> float:
    """That of the classical F test, with what neighbours that are alike make of the variance.

    `over`: rows over which they are known to be alike, where there is a better word for it.
    """
    from scipy.special import fdtrc

    q, rest = _freedom(before, after)
    left, fall = (float(np.sum(r**2)) for r in (after.residual, before.residual))
    if rest < 1 or q < 1 or not left > 0:
        return 1.0 if left > 0 else 0.0
    F = max(fall - left, 0.0) / q / (left / rest)
    rho = max(kinship(after), (over - 1) / (over + 1))
    larger = _by_neighbours(_beyond(before, after), len(after.residual), rho)
    return float(fdtrc(q, max(rest / over, 1.0), F / larger))


def _freedom(before: Linear, after: Linear) -> tuple[int, int]:
    """Unknowns that a refit adds, and residuals that are left over."""
    count = after.basis.shape[1]
    return count - before.basis.shape[1], after.residual.size - count


def _beyond(before: Linear, after: Linear) -> Array:
    """Orthonormal columns (N·m, q) of what a refit's unknowns add."""
    beyond = after.basis - before.basis @ (before.basis.T @ after.basis)
    q, _ = _freedom(before, after)
    return np.asarray(np.linalg.svd(beyond, full_matrices=False)[0][:, :q])


def _by_each_row(linear: Linear, C: Array) -> Array:
    """By how much the coefficients of columns C (N·m, q) move where a row is left out, (rows, q).

    A row that the rest says nothing of, and that says something of them, moves them any far.
    """
    rows, axes = linear.residual.shape
    own, e = linear.basis.reshape(rows, axes, -1), linear.residual[:, :, None]
    values, vectors = np.linalg.eigh(np.eye(axes) - own @ own.transpose(0, 2, 1))
    along = (vectors.transpose(0, 2, 1) @ e)[:, :, 0]
    free = values > 1e-9
    along = np.where(free, along / np.where(free, values, 1.0), 1e6 * np.abs(e).max())
    away = vectors @ along[:, :, None]
    return np.asarray(np.einsum("nmq,nm->nq", C.reshape(rows, axes, -1), away[:, :, 0]))


def _by_neighbours(C: Array, rows: int, rho: float) -> float:
    """By which the variance of coefficients of columns C (N·m, q) is larger than that of errors
    each for itself."""
    from scipy.signal import lfilter

    columns = C.reshape(rows, -1)
    before, after = (lfilter([1.0], [1.0, -rho], c, axis=0) for c in (columns, columns[::-1]))
    alike = before + after[::-1] - columns  # Σ ρ^|i − j| of all rows
    return max(1.0, float(np.sum(columns * alike) / C.shape[1]))


def kinship(linear: Linear) -> float:
    """Correlation of neighbouring rows' errors, with what the fit has taken of it given back; not
    below zero."""
    e = linear.residual / np.maximum(linear.deviation, 1e-300)
    e = np.clip(e, -LEVELS.clip, LEVELS.clip)
    rows, axes = e.shape
    own = linear.basis.reshape(rows, axes, -1)
    taken = -np.einsum("nmp,nmp->m", own[1:], own[:-1])  # of white noise: minus what was taken
    products, squares = np.sum(e[1:] * e[:-1], axis=0), np.sum(e**2, axis=0)
    free = rows - np.einsum("nmp,nmp->m", own, own)
    rho = (products - taken * squares / np.maximum(free, 1.0)) / np.maximum(squares, 1e-300)
    mean = float(np.mean(rho))
    return min(mean, LIKEST) if mean * np.sqrt(rows * axes) > BEYOND else 0.0


def carried_by_few(before: Linear, after: Linear) -> bool:
    """Do FEW of the rows of a series hold nearly all that one fit predicts otherwise than another?

    Squares of that: by which those of the residuals fall is noise from row to row.
    """
    moved = np.sum((before.residual - after.residual) ** 2, axis=1)
    most = np.sort(moved)[-max(1, int(np.ceil(FEW * len(moved)))) :]
    return bool(most.sum() > (1 - LEVELS.alike) * moved.sum())


def most_there(before: Array, after: Array) -> float:
    """The most that a refit can be worth, `before` to `after` (N, m), where few rows hold most of
    what it takes and noise is louder in these: 2 log of the likelihood ratio with a size of the
    noise of their own. Infinite where it is not so.

    In a burst of noise the largest readings are on one side somewhere.
    """
    size = np.maximum(robust_sd(after), 1e-300)
    moved = np.sum(((before - after) / size) ** 2, axis=1)
    order = np.argsort(-moved, kind="stable")
    held = np.cumsum(moved[order]) <= (1 - LEVELS.alike) * moved.sum()
    there = order[: max(1, int(held.sum()))]
    if len(there) > LEVELS.most * len(after):
        return np.inf
    left = np.abs(after / size)
    own, elsewhere = left[there], np.delete(left, there, axis=0)
    if _rms(own) <= LEVELS.louder * _rms(elsewhere):
        return np.inf
    ratio = float(np.sum((before[there] / size) ** 2)) / max(float(np.sum(own**2)), 1e-300)
    return own.size * float(np.log(max(ratio, 1.0))) / (1 - LEVELS.alike)


def _rms(left: Array) -> float:
    """Of absolute values, those far out of the most brought near."""
    return float(np.sqrt(np.mean(np.minimum(left, LEVELS.far * np.median(left)) ** 2)))
