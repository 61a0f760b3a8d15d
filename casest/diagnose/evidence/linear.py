"""A fit as a linear problem: residuals and slopes, row by row, and the parts that are held out.

Near its optimum a fit is linear in its unknowns: what another column would gain, and how well the
rest of a record foretells a part of it, follow from residuals r and slopes J without a refit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS

Index = NDArray[np.int_]


@dataclass(frozen=True)
class Parts:
    """Three ways to hold a record out, the fold of each row (N,) in each.

    pieces: interleaved, which know their neighbours; stretches: whole parts of the record; regions:
    whole parts of what the sensor met, wherever in the record. `batches` are parts of the record
    whose noises are taken to be independent.
    """

    pieces: Index
    stretches: Index
    regions: Index
    batches: Index

    @property
    def each(self) -> dict[str, Index]:
        """By name."""
        return {"pieces": self.pieces, "stretches": self.stretches, "regions": self.regions}


@dataclass(frozen=True)
class Linear:
    """Residuals (N, m) at a fit and their slopes (N, m, p) in its unknowns.

    `spans` are stretches of evenly spaced rows: their noise may have a colour. Without any, rows
    are poses, or of a table, and their noise is white. `least`: share of a cause's length that must
    survive beside the unknowns. `plateaus`: the number of each row's (N,), where inputs are held.
    `roots` (N, m): what rows are multiplied by, the root of their weights; None: by one. `feigned`
    (N, m, k): what noise of the inputs makes of the residuals; None: nothing. Where it `counts`, a
    cause must explain something beside it.
    """

    residual: Array
    slopes: Array
    spans: tuple[slice, ...]
    parts: Parts
    least: float = LEVELS.survives
    plateaus: Index | None = None
    roots: Array | None = None
    feigned: Array | None = None
    counts: bool = False

    @property
    def beside(self) -> Array:
        """Slopes (N, m, p + k), and what noise of the inputs makes where it counts."""
        if self.feigned is None or not self.counts:
            return self.slopes
        return np.concatenate([self.slopes, self.feigned], axis=2)

    @property
    def root(self) -> Array:
        """What each residual (N, m) is multiplied by."""
        return np.ones_like(self.residual) if self.roots is None else self.roots

    @property
    def coloured(self) -> bool:
        """Is the noise taken to have a colour?"""
        return bool(self.spans)

    @property
    def series(self) -> bool:
        """Are there rows enough for tests from part to part?"""
        return len(self.residual) >= LEVELS.series

    @cached_property
    def deviation(self) -> Array:
        """Robust standard deviation of each axis (m,)."""
        return robust_sd(self.residual)

    @cached_property
    def foretold(self) -> dict[int, Any]:
        """What the unknowns foretell of parts that are held out, by the identity of these."""
        return {}

    @cached_property
    def basis(self) -> Array:
        """Orthonormal (N·m, p) of what the unknowns and noise of the inputs do to the residuals."""
        flat = self.beside.reshape(self.residual.size, -1)
        size = np.linalg.norm(flat, axis=0)
        alive = size > 0
        if not alive.any():
            return np.zeros((self.residual.size, 0))
        Q, R = np.linalg.qr(flat[:, alive] / size[alive])
        U, s, _ = np.linalg.svd(R)
        return np.asarray(Q @ U[:, s > 1e-9 * s[0]])

    def evened(self, size: Array) -> Linear:
        """The problem in the sizes (N,) that the noise has at each row."""
        r, J = self.residual / size[:, None], self.slopes / size[:, None, None]
        noise = None if self.feigned is None else self.feigned / size[:, None, None]
        return replace(self, residual=r, slopes=J, roots=self.root / size[:, None], feigned=noise)

    def without(self, columns: Array, part: Array) -> Linear:
        """The problem as if some unknowns were not there: `columns` (N, m, p − k) are the slopes of
        the others, `part` (N, m) is what the fit took away by them."""
        return replace(self, residual=self.residual + part, slopes=columns)


def alike(fits: Sequence[Linear]) -> list[Linear]:
    """Fits that are compared: where noise of the inputs counts in one it counts in all.

    And to the same rows, without those that one of them has nothing to say of: a lag leaves some
    whose cause nobody recorded. Fits to other rows keep theirs.
    """
    counts = any(fit.counts for fit in fits)
    fits = [fit if fit.counts == counts else replace(fit, counts=counts) for fit in fits]
    if len({fit.residual.shape for fit in fits}) > 1:
        return list(fits)
    silent = [~(fit.residual.any(axis=1) | fit.slopes.any(axis=(1, 2))) for fit in fits]
    gone = np.any(silent, axis=0)
    return [_less(fit, gone & ~own) for fit, own in zip(fits, silent, strict=True)]


def _less(fit: Linear, gone: NDArray[np.bool_]) -> Linear:
    if not gone.any():
        return fit
    parts = [None if x is None else x.copy() for x in (fit.residual, fit.slopes, fit.feigned)]
    for part in (x for x in parts if x is not None):
        part[gone] = 0.0
    residual, slopes, feigned = parts
    assert residual is not None
    assert slopes is not None
    return replace(fit, residual=residual, slopes=slopes, feigned=feigned)


def robust_sd(residual: Array) -> Array:
    """Standard deviation of each axis (m,) by the nearest 95 % of the residuals.

    Not by the nearest half: where a sensor moves now and then, that is its rest alone.
    """
    centred = np.abs(residual - np.median(residual, axis=0))
    return np.asarray(np.quantile(centred, 0.95, axis=0) / 1.96 + 1e-300)


def parts_of(blocks: Index, runs: Index, inputs: Array) -> Parts:
    """Folds of rows in time order; `blocks`, `runs` (N,) their numbers, `inputs` (N, q) what the
    sensor met there.

    Blocks (poses, bursts) stay whole where there are enough of them. Every run is cut alike: what
    belongs to a run alone is foretold by the rest of it.
    """
    count = len(blocks)
    place, size = _place(blocks, runs)
    if count < LEVELS.series:
        single = np.unique(np.stack([runs, place]), axis=1, return_inverse=True)[1].ravel()
        stretches = place * min(LEVELS.stretches, max(count // 3, 2)) // size
        return Parts(single, stretches, _regions(inputs, LEVELS.few_regions), single)
    batches = place * LEVELS.pieces // size
    stretches = place * LEVELS.stretches // size
    regions = _regions(inputs, LEVELS.regions)
    return Parts(batches % LEVELS.folds, stretches, regions, batches + LEVELS.pieces * runs)


def _place(blocks: Index, runs: Index) -> tuple[Index, Index]:
    """Number of each row's unit within its run, and the units of that run: blocks where a run has
    enough of them, else rows."""
    place, size = np.zeros_like(blocks), np.ones_like(blocks)
    for run in np.unique(runs):
        own = np.flatnonzero(runs == run)
        number = np.unique(blocks[own], return_inverse=True)[1]
        if number.max() + 1 < 2 * LEVELS.stretches:
            number = np.arange(len(own))
        place[own], size[own] = number, number.max() + 1
    return place, size


def _regions(inputs: Array, count: int) -> Index:
    """Cells of what the sensor met, by k-means (J. MacQueen, 1967)."""
    from scipy.cluster.vq import kmeans2

    varies = np.ptp(inputs, axis=0) > 1e-9 * np.abs(inputs).max(initial=1e-300)
    if not varies.any():
        return np.arange(len(inputs)) * count // len(inputs)
    x = inputs[:, varies]
    chosen = x[:: max(1, len(x) // 4000)]
    count = min(count, len(np.unique(chosen, axis=0)))
    centres, _ = kmeans2(chosen, count, minit="++", seed=3)
    centres = centres[np.isfinite(centres).all(axis=1)]
    away = ((x[:, None, :] - centres[None]) ** 2).sum(axis=2)
    return np.asarray(away.argmin(axis=1))


def spans_of(blocks: Index, runs: Index) -> tuple[slice, ...]:
    """Stretches of rows of one block of one run."""
    change = np.flatnonzero((np.diff(blocks) != 0) | (np.diff(runs) != 0)) + 1
    edges: Sequence[int] = [0, *change.tolist(), len(blocks)]
    return tuple(slice(a, b) for a, b in pairwise(edges))
