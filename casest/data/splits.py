"""Folds for held-out tests: interleaved stretches, whole poses, whole bursts; no single samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.errors import DataError, UsageError

_SHORTEST = 2  # samples in a stretch of a time series: neighbours share their noise
_FEW = 2  # blocks per fold below which a few accidental gaps do not decide


def interleaved_blocks(
    run: Run, n_blocks: int = 20, folds: int = 2, seed: int = 0
) -> NDArray[np.int_]:
    """Return the fold of each sample, (N,) from 0 to folds - 1.

    A record without gaps is cut into `n_blocks` stretches of equal length; poses, rest intervals
    and bursts (`run.block`) stay whole. In each group of `folds` neighbours every fold gets one,
    in random order (`seed`), so that no fold is the end of the record (extrapolation is another
    question) and a periodic motion does not line up with the folds.

    Raises UsageError for fewer than two folds, DataError where there are fewer stretches than
    folds.
    """
    if folds < 2 or n_blocks < folds:
        raise UsageError(f"{folds} folds of {n_blocks} blocks: at least 2 folds, a block for each")
    piece = _pieces(run, n_blocks, folds)
    n = int(piece[-1]) + 1 if len(piece) else 0
    if n < folds:
        raise DataError(
            f"{run.name}: {len(run)} samples in {n} stretches cannot be split into {folds} folds; "
            f"give a longer record or more positions"
        )
    rng = np.random.default_rng(seed)
    order = [rng.permutation(folds) for _ in range(-(-n // folds))]
    return np.concatenate(order)[piece].astype(np.int_)


def _pieces(run: Run, n_blocks: int, folds: int) -> NDArray[np.int_]:
    """Return the number of the stretch that each sample belongs to, counted along the record."""
    starts = np.r_[True, run.block[1:] != run.block[:-1]] if len(run) else np.zeros(0, np.bool_)
    whole: NDArray[np.int_] = np.cumsum(starts, dtype=np.int_) - 1
    n_whole = int(starts.sum())
    if n_whole >= _FEW * folds or bool((run.count > 1).any()):
        return whole
    return _subdivided(whole, min(n_blocks, max(len(run) // _SHORTEST, 1)))


def _subdivided(whole: NDArray[np.int_], n_blocks: int) -> NDArray[np.int_]:
    """Cut the stretches into about `n_blocks` pieces of equal length, none across a gap."""
    sizes = np.bincount(whole)
    parts = np.maximum(np.round(sizes * n_blocks / len(whole)), 1).astype(np.int_)
    parts = np.minimum(parts, np.maximum(sizes // _SHORTEST, 1))
    first = np.cumsum(parts) - parts
    pieces = [
        start + np.arange(size) * part // size
        for start, size, part in zip(first, sizes, parts, strict=True)
    ]
    return np.concatenate(pieces)
