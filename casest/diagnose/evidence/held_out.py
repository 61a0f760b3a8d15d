"""Held-out squares: each part of a record foretold by the rest, with columns or without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index, Linear
from casest.diagnose.levels import LEVELS


@dataclass(frozen=True)
class Fall:
    """Of held-out squares: what was gained, what is left, and t from part to part."""

    gained: float
    left: float
    t: float

    @property
    def ratio(self) -> float:
        """Of the squares, after over before."""
        return float(self.left / max(self.left + self.gained, 1e-300))


def foretold(linear: Linear, columns: Sequence[Array], parts: Index) -> Array:
    """Held-out residuals (N, m).

    What the rest of the record leaves open of the columns is taken to be nothing.
    """
    if columns:
        return _foretold(linear, columns, _rows(linear, parts))
    if id(parts) not in linear.foretold:  # each cause is compared with none
        linear.foretold[id(parts)] = parts, _foretold(linear, (), _rows(linear, parts))
    found: Array = linear.foretold[id(parts)][1]
    return found


def share_taken(linear: Linear, column: Array) -> float:
    """Share of held-out squares that a column (N, m) takes away, from piece to piece; else 0."""
    seen = fall(linear, [column[:, :, None]], linear.parts.pieces)
    return max(0.0, 1 - seen.ratio) if seen.t > LEVELS.confirmed else 0.0


def _rows(linear: Linear, parts: Index) -> list[Index]:
    """Of all residuals those of each part."""
    row = np.repeat(parts, linear.residual.shape[1])
    return [np.flatnonzero(row == k) for k in np.unique(parts)]


def _foretold(linear: Linear, columns: Sequence[Array], rows: Sequence[Index]) -> Array:
    p = linear.basis.shape[1]
    X = np.concatenate([linear.basis, *(_flat(c, linear) for c in columns)], axis=1)
    y, seen = linear.residual.ravel(), clipped(linear).ravel()
    several = [(own, X[own]) for own in rows]
    squares = [(part.T @ part, part.T @ seen[own]) for own, part in several]
    A, b, found = sum(s for s, _ in squares), sum(s for _, s in squares), np.empty(len(y))
    for (own, part), (square, product) in zip(several, squares, strict=True):
        rest = A - square
        T = _determined(A, rest, p)
        values = T @ np.linalg.lstsq(T.T @ rest @ T, T.T @ (b - product), 1e-9)[0]
        found[own] = y[own] - part @ values
    return found.reshape(linear.residual.shape)


def _determined(whole: Array, rest: Array, p: int) -> Array:
    """The p unknowns, and of the columns after them the directions that the rest says enough of."""
    if len(whole) == p:
        return np.eye(p)
    here, there = (_beyond(A, p) for A in (whole, rest))
    values, vectors = np.linalg.eigh(here)
    kept = values > 1e-9 * values.max(initial=1e-300)
    root = vectors[:, kept] / np.sqrt(values[kept])
    share, turned = np.linalg.eigh(root.T @ there @ root)
    ways = (root @ turned)[:, share > LEVELS.told]
    found = np.zeros((len(whole), p + ways.shape[1]))
    found[:p, :p] = np.eye(p)
    found[p:, p:] = ways
    return found


def _beyond(A: Array, p: int) -> Array:
    """Information of the columns after p unknowns, beside those."""
    inner = np.linalg.lstsq(A[:p, :p], A[:p, p:], 1e-9)[0] if p else np.zeros((0, len(A)))
    return np.asarray(A[p:, p:] - A[p:, :p] @ inner)


def fall(linear: Linear, columns: Sequence[Array], parts: Index) -> Fall:
    """Of the squares by columns."""
    return fall_of(linear, foretold(linear, [], parts), foretold(linear, columns, parts))


def fall_between(before: Linear, after: Linear, parts: Index) -> Fall:
    """Of the squares from one fit to another, each near its own optimum."""
    return fall_of(before, foretold(before, [], parts), foretold(after, [], parts))


def fall_of(linear: Linear, b: Array, a: Array) -> Fall:
    """Of the squares from errors b to errors a, (N, m) each.

    Were the second ones right, with predictions that differ by δ, the squares would fall by
    Σ(δ² + 2aδ): the error of the fall is that of 2Σaδ, from batch to batch of the record, and not
    below that of white noise. So what is gained in a few places only is a gain as well.
    """
    moved, (b, a) = b - a, _counted(linear, b, a)
    left = float(np.sum(a**2))
    gained = float(np.sum(b**2)) - left
    wide = np.bincount(linear.parts.batches, np.sum(2 * a * moved, axis=1))
    white = 4 * float(np.mean(a**2)) * float(np.sum(moved**2))
    spread = np.sqrt(max(float(np.sum(wide**2)), white))
    return Fall(gained, left, float(gained / max(spread, 1e-300)))


def fall_between_causes(linear: Linear, b: Array, a: Array) -> Fall:
    """Of the squares from errors b of one cause to those of another, a (N, m).

    What a series leaves of both may be more that is missing, no noise: the error is the scatter
    of the fall itself, from stretch to stretch (Q. Vuong, Econometrica 57 (1989) 307). What poses
    leave is white, and what tells two causes apart may be in a few of them.
    """
    if not linear.coloured:
        return fall_of(linear, b, a)
    before, after = (np.sum(e**2, axis=1) for e in _counted(linear, b, a))
    fallen = np.asarray(np.bincount(linear.parts.stretches, before - after), float)
    return Fall(float(fallen.sum()), float(after.sum()), standard_errors(fallen))


def standard_errors(gained: Array) -> float:
    """A sum over parts in its own standard errors."""
    spread = np.sqrt(len(gained)) * np.std(gained, ddof=1) if len(gained) > 1 else np.inf
    return float(gained.sum() / max(spread, 1e-300))


def _counted(linear: Linear, b: Array, a: Array) -> tuple[Array, Array]:
    """Errors (N, m) of two causes, those far out counted as less: what is far from both is
    neither's; what one of them is far from counts in full."""
    if not linear.series:
        return b, a
    moved, nearer = b - a, np.abs(a) < np.abs(b)
    far = LEVELS.far * linear.deviation
    least = np.clip(np.where(nearer, a, b), -far, far)
    return np.where(nearer, least + moved, least), np.where(nearer, least, least - moved)


def clipped(linear: Linear) -> Array:
    """Residuals that fits are made to: those far out brought near."""
    if not linear.series:
        return linear.residual
    far = LEVELS.far * LEVELS.clip * linear.deviation
    return np.clip(linear.residual, -far, far)


def _flat(columns: Array, linear: Linear) -> Array:
    flat = columns.reshape(linear.residual.size, -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300))
