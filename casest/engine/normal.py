"""Least-squares sums over all samples, from a replay of residual and Jacobian.

In every function `replay` has the outputs r (m×1, dense) and J (m×n, any sparsity), in this
order (n may be less than the number of parameters: some only describe charts); `samples` (N, k),
`weights` (N, m) or None for ones. Non-finite values
are not an error: they appear in the results. A weight of zero does not hide them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from casest.engine.replay import BLOCK, Floats, Replay
from casest.errors import CasestError

_RESIDUAL = 0  # which output
_JACOBIAN = 1
# OpenBLAS has a kernel for products of up to a million multiplications. With few columns it is two
# to three times faster than syrk, which does half the work but is made for large matrices. It adds
# one sample after the other, so short pieces also keep rounding errors from piling up.
_PIECE = 1024
_FEW_COLUMNS = 24


class Normal(NamedTuple):
    """Cost and normal equations: ½ Σ w r², Jᵀ W r (n,) and Jᵀ W J (n, n)."""

    cost: float
    gradient: Floats
    matrix: Floats


class _Component(NamedTuple):
    """One residual's share of a block of values: its nonzeros of J, then the residual itself."""

    rows: slice  # of the block
    columns: NDArray[np.intp]  # of [J r]; the last is n


def cost(
    replay: Replay, parameters: Floats, samples: Floats, weights: Floats | None = None
) -> float:
    """½ Σ w r² over all samples; the Jacobian, if there is one, is not computed."""
    m = _count_residuals(replay)
    parameters, samples = replay.check(parameters, samples)
    weights = _check_weights(weights, len(samples), m)
    plan = replay.plan([(_RESIDUAL, i) for i in range(m)])
    total = 0.0
    with np.errstate(all="ignore"):
        for span, r in plan.blocks(parameters, samples):
            wr = r if weights is None else weights[span].T * r
            total += float(np.einsum("ij,ij->", wr, r))
    return 0.5 * total


def normal_equations(
    replay: Replay, parameters: Floats, samples: Floats, weights: Floats | None = None
) -> Normal:
    """½ Σ w r², Jᵀ W r and Jᵀ W J, accumulated by block in constant memory."""
    components = _components(replay)
    n = replay.shapes[_JACOBIAN][1]
    sums = [np.zeros((len(c.columns),) * 2) for c in components]
    with np.errstate(all="ignore"):
        for block, w in _weighted_blocks(replay, components, parameters, samples, weights):
            for i, (component, total) in enumerate(zip(components, sums, strict=True)):
                _add_products(total, block[component.rows], None if w is None else w[:, i])
    whole = np.zeros((n + 1, n + 1))
    for component, total in zip(components, sums, strict=True):
        whole[np.ix_(component.columns, component.columns)] += total
    matrix = whole[:n, :n]
    # Both halves were computed, each with its own rounding: make them agree to the last digit.
    return Normal(0.5 * float(whole[n, n]), whole[:n, n].copy(), 0.5 * (matrix + matrix.T))


def _add_products(total: Floats, a: Floats, w: Floats | None) -> None:
    """Add a W aᵀ to `total` (q, q); its last row may be left out but for the last entry."""
    left = a if w is None else a * w
    q, length = a.shape
    if q > _FEW_COLUMNS:
        total += left @ a.T  # syrk, if both are the same array
        return
    for start in range(0, length, _PIECE):
        piece = slice(start, start + _PIECE)
        total[:-1] += left[:-1, piece] @ a[:, piece].T
    total[-1, -1] += left[-1] @ a[-1]


def triangular_factor(
    replay: Replay, parameters: Floats, samples: Floats, weights: Floats | None = None
) -> Floats:
    """Upper triangular R (n+1, n+1) with RᵀR = [J r]ᵀ W [J r], weights not negative.

    Sequential Householder QR: R of each block stacked under the R so far. It does not square the
    condition number of J, as the normal equations do. Signs of the rows are arbitrary.
    """
    components = _components(replay)
    n = replay.shapes[_JACOBIAN][1]
    factor = np.zeros((n + 1, n + 1))
    with np.errstate(all="ignore"):
        for block, w in _weighted_blocks(replay, components, parameters, samples, weights):
            length = block.shape[1]
            stack = np.zeros((n + 1 + length * len(components), n + 1))
            stack[: n + 1] = factor
            for i, component in enumerate(components):
                a = block[component.rows]
                start = n + 1 + i * length
                stack[start : start + length, component.columns] = (
                    a.T if w is None else (a * np.sqrt(w[:, i])).T
                )
            # NumPy's annotations do not know that this mode returns an array.
            factor = cast(Floats, np.linalg.qr(stack, mode="r"))
    return factor


def rows(replay: Replay, parameters: Floats, samples: Floats) -> tuple[Floats, Floats]:
    """Residuals (N, m) and Jacobians (N, m, n) of every sample."""
    _components(replay)
    values = replay(parameters, samples)
    return values[_RESIDUAL][:, :, 0], values[_JACOBIAN]


def _weighted_blocks(
    replay: Replay,
    components: list[_Component],
    parameters: Floats,
    samples: Floats,
    weights: Floats | None,
    block: int = BLOCK,
) -> Iterator[tuple[Floats, Floats | None]]:
    """Yield per block the values, in the components' order, and the weights (in block, m)."""
    parameters, samples = replay.check(parameters, samples)
    weights = _check_weights(weights, len(samples), len(components))
    plan = replay.plan(_entries(replay))
    for span, values in plan.blocks(parameters, samples, block):
        yield values, None if weights is None else weights[span]


def _entries(replay: Replay) -> list[tuple[int, int]]:
    """All entries of J and r, those of one component side by side: BLAS then needs no copy."""
    row, _ = replay.sparsity[_JACOBIAN]
    entries = []
    for i in range(replay.shapes[_RESIDUAL][0]):
        entries += [(_JACOBIAN, int(j)) for j in np.flatnonzero(row == i)]
        entries.append((_RESIDUAL, i))
    return entries


def _components(replay: Replay) -> list[_Component]:
    m = _count_residuals(replay)
    if len(replay.shapes) < 2 or replay.shapes[_JACOBIAN][0] != m:
        raise CasestError(
            f"function {replay.name!r} has outputs of shape {replay.shapes}:"
            f" the second must be the Jacobian, ({m}, n)"
        )
    n = replay.shapes[_JACOBIAN][1]
    row, column = replay.sparsity[_JACOBIAN]
    components = []
    start = 0
    for i in range(m):
        columns = np.append(column[row == i], n)
        components.append(_Component(slice(start, start + len(columns)), columns))
        start += len(columns)
    return components


def _count_residuals(replay: Replay) -> int:
    m, columns = replay.shapes[_RESIDUAL]
    if columns != 1 or len(replay.sparsity[_RESIDUAL][0]) != m:
        raise CasestError(
            f"the first output of function {replay.name!r} is not a dense column of residuals:"
            " apply casadi.densify"
        )
    return m


def _check_weights(weights: Floats | None, n_samples: int, m: int) -> Floats | None:
    if weights is None:
        return None
    weights = np.asanyarray(weights)
    if weights.shape != (n_samples, m):
        raise CasestError(
            f"weights have the shape {weights.shape}: give ({n_samples}, {m}),"
            " one per sample and residual"
        )
    return weights
