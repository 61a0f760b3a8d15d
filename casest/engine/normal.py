"""Least-squares sums over all samples, from a replay of residual and Jacobian.

In every function `replay` has the outputs r (m×1, dense) and J (m×n, any sparsity), in this
order (n may be less than the number of parameters: some only describe charts); `samples` (N, k)
or by column, `weights` (N, m) or None for ones. Non-finite values
are not an error: they appear in the results. A weight of zero does not hide them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from casest.engine.kernel import Kernel, kernel_for, kernel_of_sum
from casest.engine.operations import Floats
from casest.engine.replay import BLOCK, Entry, Replay, Samples, once
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
    replay: Replay, parameters: Floats, samples: Samples, weights: Floats | None = None
) -> float:
    """½ Σ w r² over all samples; the Jacobian, if there is one, is not computed."""
    m = _count_residuals(replay)
    parameters, columns = replay.check(parameters, samples)
    weights = _check_weights(weights, len(columns), m)
    kernel = _kernel(replay, len(columns))
    if kernel is not None:
        return 0.5 * kernel.cost(parameters, columns, weights)
    plan = replay.plan([(_RESIDUAL, i) for i in range(m)])
    total = 0.0
    with np.errstate(all="ignore"):
        for span, r in plan.blocks(parameters, columns):
            wr = r if weights is None else weights[span].T * r
            total += float(np.einsum("ij,ij->", wr, r))
    return 0.5 * total


def normal_equations(
    replay: Replay, parameters: Floats, samples: Samples, weights: Floats | None = None
) -> Normal:
    """½ Σ w r², Jᵀ W r and Jᵀ W J, accumulated by block in constant memory."""
    _components(replay)  # checks the shapes
    n = replay.shapes[_JACOBIAN][1]
    kernel = _kernel(replay, len(samples))
    if kernel is not None:
        whole = _compiled_sums(kernel, replay, parameters, samples, weights)
    else:
        with np.errstate(all="ignore"):
            whole = _replayed_sums(replay, parameters, samples, weights)
    return Normal(0.5 * float(whole[n, n]), whole[:n, n].copy(), whole[:n, :n].copy())


def _replayed_sums(
    replay: Replay, parameters: Floats, samples: Samples, weights: Floats | None
) -> Floats:
    """[J r]ᵀ W [J r], (n+1, n+1), from every entry of J on every sample."""
    components = _components(replay)
    sums = [np.zeros((len(c.columns),) * 2) for c in components]
    for block, w in _weighted_blocks(replay, components, parameters, samples, weights):
        for i, (component, total) in enumerate(zip(components, sums, strict=True)):
            _add_products(total, block[component.rows], None if w is None else w[:, i])
    n = replay.shapes[_JACOBIAN][1]
    whole = np.zeros((n + 1, n + 1))
    for component, total in zip(components, sums, strict=True):
        whole[np.ix_(component.columns, component.columns)] += total
    # Both halves of JᵀJ were computed, each with its own rounding: make them agree to the last
    # digit. The residual's own row may be left out.
    whole[:n, :n] = 0.5 * (whole[:n, :n] + whole[:n, :n].T)
    return whole


def summed(replay: Replay, parameters: Floats, samples: Samples) -> Floats:
    """The sum of the first output over all samples, dense: (rows, columns)."""
    parameters, columns = replay.check(parameters, samples)
    kernel = kernel_of_sum(replay, 0, len(columns))
    if kernel is None:
        return replay.sum(parameters, columns)
    total = np.zeros(replay.shapes[0])
    total[replay.sparsity[0]] = kernel.sums(parameters, columns)
    return total


def _kernel(replay: Replay, samples: int) -> Kernel | None:
    """The compiled form, where there is a Jacobian and compiling pays."""
    return kernel_for(replay, _layout, samples) if len(replay.shapes) > 1 else None


def _layout(replay: Replay) -> list[list[Entry]]:
    entries = _entries(replay)
    return [entries[component.rows] for component in _components(replay)]


def _compiled_sums(
    kernel: Kernel,
    replay: Replay,
    parameters: Floats,
    samples: Samples,
    weights: Floats | None,
) -> Floats:
    """The same from the compiled kernel."""
    parameters, columns = replay.check(parameters, samples)
    weights = _check_weights(weights, len(columns), len(_components(replay)))
    packed, n = kernel.products(parameters, columns, weights), replay.shapes[_JACOBIAN][1]
    upper = np.bincount(_places(replay), packed, (n + 1) ** 2).reshape(n + 1, n + 1)
    whole = upper + upper.T
    np.fill_diagonal(whole, np.diag(upper))
    return cast(Floats, whole)


@once
def _places(replay: Replay) -> NDArray[np.intp]:
    """Where in [J r]ᵀ[J r], row by row, each product of the compiled kernel belongs."""
    n, places = replay.shapes[_JACOBIAN][1], []
    for component in _components(replay):
        i, j = np.triu_indices(len(component.columns))
        a, b = component.columns[i], component.columns[j]
        places.append(np.minimum(a, b) * (n + 1) + np.maximum(a, b))
    return np.concatenate(places)


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
    replay: Replay, parameters: Floats, samples: Samples, weights: Floats | None = None
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


def residuals(replay: Replay, parameters: Floats, samples: Samples) -> Floats:
    """Residuals (N, m) of every sample; the Jacobian is not computed."""
    m = _count_residuals(replay)
    parameters, columns = replay.check(parameters, samples)
    kernel = _kernel(replay, len(columns))
    if kernel is not None:
        return kernel.residuals(parameters, columns, m).T
    found = np.empty((len(columns), m))
    for span, r in replay.plan([(_RESIDUAL, i) for i in range(m)]).blocks(parameters, columns):
        found[span] = r.T
    return found


def rows(replay: Replay, parameters: Floats, samples: Samples) -> tuple[Floats, Floats]:
    """Residuals (N, m) and Jacobians (N, m, n) of every sample."""
    components = _components(replay)
    kernel = _kernel(replay, len(samples))
    if kernel is None:
        values = replay(parameters, samples)
        return values[_RESIDUAL][:, :, 0], values[_JACOBIAN]
    parameters, columns = replay.check(parameters, samples)
    m, n = replay.shapes[_JACOBIAN]
    entries = kernel.values(parameters, columns, sum(len(c.columns) for c in components))
    residual, jacobian = np.empty((len(columns), m)), np.zeros((len(columns), m, n))
    for i, component in enumerate(components):
        own = entries[component.rows]
        jacobian[:, i, component.columns[:-1]] = own[:-1].T
        residual[:, i] = own[-1]
    return residual, jacobian


def _weighted_blocks(
    replay: Replay,
    components: list[_Component],
    parameters: Floats,
    samples: Samples,
    weights: Floats | None,
    block: int = BLOCK,
) -> Iterator[tuple[Floats, Floats | None]]:
    """Yield per block the values, in the components' order, and the weights (in block, m)."""
    parameters, columns = replay.check(parameters, samples)
    weights = _check_weights(weights, len(columns), len(components))
    plan = replay.plan(_entries(replay))
    for span, values in plan.blocks(parameters, columns, block):
        yield values, None if weights is None else weights[span]


@once
def _entries(replay: Replay) -> list[tuple[int, int]]:
    """All entries of J and r, those of one component side by side: BLAS then needs no copy."""
    row, _ = replay.sparsity[_JACOBIAN]
    entries = []
    for i in range(replay.shapes[_RESIDUAL][0]):
        entries += [(_JACOBIAN, int(j)) for j in np.flatnonzero(row == i)]
        entries.append((_RESIDUAL, i))
    return entries


@once
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
