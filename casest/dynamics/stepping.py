"""One step of the filter in CasADi's symbols, run over a record by the engine.

A step of nine states is a few thousand operations: in NumPy the calls alone take longer.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics import factors
from casest.dynamics.samples import AtSamples
from casest.engine import Recursion

Pattern = tuple[tuple[int, int], ...]


def reach(A: Any) -> Pattern:
    """Which entries of Φ can differ from zero, given the pattern of A: (row, column)."""
    return _reached(A.size1(), entries(A))


@lru_cache(maxsize=64)
def _reached(n: int, pattern: Pattern) -> Pattern:
    found = np.eye(n, dtype=bool)
    found[tuple(np.array(pattern, int).reshape(-1, 2).T)] = True
    for _ in range(n):
        found = found @ found
    return tuple((int(i), int(j)) for i, j in np.argwhere(found))


def entries(matrix: Any) -> Pattern:
    """Which entries of a matrix of expressions are not zero for good: (row, column)."""
    rows, columns = matrix.sparsity().get_triplet()
    return tuple(zip(map(int, rows), map(int, columns), strict=True))


def upper(n: int) -> Pattern:
    """On and above the diagonal, row by row: what a covariance is handed over as."""
    return tuple((i, j) for i in range(n) for j in range(i, n))


def picked(matrices: Array, pattern: Pattern) -> Array:
    """Entries of matrices (N, …, …), as they are handed over, (N, k)."""
    columns = matrices.shape[2]
    rows = matrices.reshape(len(matrices), matrices.shape[1] * columns)
    if pattern == tuple(np.ndindex(matrices.shape[1:])):
        return rows
    return rows[:, [i * columns + j for i, j in pattern]]


def _matrix(name: str, shape: tuple[int, int], pattern: Pattern) -> tuple[Any, Any]:
    """Symbols for the entries of a pattern, and the matrix of them."""
    symbols, matrix = ca.SX.sym(name, len(pattern)), ca.SX(*shape)
    for k, (i, j) in enumerate(pattern):
        matrix[i, j] = symbols[k]
    return symbols, matrix


def _step_of(n: int, m: int, of_Phi: Pattern, of_C: Pattern) -> tuple[list[Any], list[Any]]:
    """Symbols for what a step is given, and Φ, forced step, factors of Q, C, R and y of them."""
    (Phi, own_Phi), (C, own_C) = _matrix("Phi", (n, n), of_Phi), _matrix("C", (m, n), of_C)
    noise, (U, D) = ca.SX.sym("noise", len(upper(n))), (ca.SX.eye(n), ca.SX(n, 1))
    for k, (i, j) in enumerate(upper(n)):
        if i == j:
            D[i] = noise[k]
        else:
            U[i, j] = noise[k]
    u, R, y = ca.SX.sym("u", n), ca.SX.sym("R", m), ca.SX.sym("y", m)
    return [Phi, u, noise, C, R, y], [own_Phi, u, (U, D), own_C, R, y]


#: What a step gives beside the state after it: nothing; states and covariances, after the reading
#: alone or before it too; what is shown of them, states with standard deviations.
Give = Literal["end", "after", "all", "brief"]


@lru_cache(maxsize=16)
def kalman_step(n: int, m: int, of_Phi: Pattern, of_C: Pattern, give: Give = "all") -> Recursion:
    """(state; Φ, forced step, Q, C, diagonal of R, y of a sample) -> state, and what is asked for.

    Of Φ and C the entries of their patterns are given, of Q its `noise_factors`.

    state: x with the factors of P. Readings are
    taken one component after the other, which needs no inverse (their noise is independent).
    after: x and P after the reading; all: and before it. brief: x and std after the reading;
    innovations, the std expected of them, and νᵀS⁻¹ν.
    """
    both = ca.SX.sym("both", factors.size(n))
    x, (U, D) = factors.unpacked(both, n)
    numbers, (Phi, u, noise, C, R, y) = _step_of(n, m, of_Phi, of_C)
    before_x, before = Phi @ x + u, factors.moved((U, D), Phi, noise)
    after_x, after, squares = before_x, before, ca.SX(0)
    for i in range(m):
        c = C[i, :].T
        innovation = y[i] - ca.dot(c, after_x)
        after, gain, variance = factors.read_with(after, c, R[i])
        after_x = after_x + gain * innovation
        squares += factors.over(innovation**2, variance)
    outputs = [factors.packed(after_x, after)]
    if give in ("after", "all"):
        outputs.append(packed(after_x, factors.multiplied(after)))
    if give == "all":
        outputs.append(packed(before_x, factors.multiplied(before)))
    if give == "brief":
        expected = [ca.sqrt(factors.variance(before, C[i, :].T) + R[i]) for i in range(m)]
        outputs.append(ca.vertcat(after_x, factors.std(after)))
        outputs.append(ca.vertcat(y - C @ before_x, *expected, squares))
    outputs = [ca.densify(e) for e in outputs]
    return Recursion(ca.Function("step", [both, *numbers], outputs))


@lru_cache(maxsize=16)
def told_step(n: int, m: int, of_Phi: Pattern, of_C: Pattern) -> Recursion:
    """(what is read after a sample; numbers) -> what is read after the sample before it.

    What later readings say of a sample are n readings of it, with gradients B, weights and values.
    A step back is the filter's with Φᵀ, readings and noise having changed their parts; the values
    go along as one more row. numbers: Φ, forced step and Q of the step; C, R and y of the sample
    after it, as in `kalman_step`.
    """
    later = ca.SX.sym("later", n * n + 2 * n)
    order, (B, weight, value) = _causes_first(n, of_Phi), _told(later, n, of_Phi)
    numbers, (Phi, u, (Uq, Dq), C, R, y) = _step_of(n, m, of_Phi, of_C)
    rows = ca.vertcat(ca.horzcat(value.T, y.T), ca.horzcat(B, C.T[order, :]))
    told = factors.orthogonal(rows, ca.vertcat(weight, 1 / R))
    for j in range(n):
        told, _ = factors.read(told, ca.vertcat(0, Uq[order, j]), 1, Dq[j])
    U, weight = told[0][1:, 1:], told[1][1:]
    B, value = Phi.T[order, order] @ U, told[0][0, 1:].T - U.T @ u[order]
    back = ca.vertcat(*[ca.vec(ca.densify(e)) for e in (B, weight, value)])
    return Recursion(ca.Function("step", [later, *numbers], [back]))


@lru_cache(maxsize=16)
def noise_factors(n: int) -> AtSamples:
    """Entries of Q on and above the diagonal -> those of its U, with D in the place of the ones."""
    Q, matrix = _matrix("Q", (n, n), upper(n))
    return AtSamples(Q, [own_factors(matrix)])


def own_factors(Q: Any) -> Any:
    """U of Q above the diagonal, and D on it, row by row."""
    U, D = factors.factored(Q)
    return ca.densify(ca.vertcat(*[D[i] if i == j else U[i, j] for i, j in upper(Q.size1())]))


@lru_cache(maxsize=16)
def both_ways(n: int, of_Phi: Pattern, brief: bool) -> AtSamples:
    """(what is read after a sample, x and the factors of P of the filter at it) -> x and P by all
    readings, or in `brief` x and std.

    The filter's state takes what it is told like readings of its own (two filters: Mayne 1966;
    Fraser & Potter 1969).
    """
    later, own = ca.SX.sym("later", n * n + 2 * n), ca.SX.sym("own", factors.size(n))
    B, weight, value = _told(later, n, of_Phi)
    B = B[np.argsort(_causes_first(n, of_Phi)).tolist(), :]
    x, found = factors.unpacked(own, n)
    for j in range(n):
        found, gain = factors.read(found, B[:, j], 1, weight[j])
        x = x + gain * (value[j] - ca.dot(B[:, j], x))
    shown = factors.std(found) if brief else factors.multiplied(found)
    return AtSamples(ca.vertcat(later, own), [x, shown])


def _causes_first(n: int, of_Phi: Pattern) -> list[int]:
    """States in an order in which Φᵀ is upper triangular, as far as it can be: each before those
    that it moves, so that little has to be made triangular again."""
    moves = np.bincount([j for _, j in of_Phi], minlength=n)
    return [int(i) for i in np.argsort(-moves, kind="stable")]


def _told(later: Any, n: int, of_Phi: Pattern) -> tuple[Any, Any, Any]:
    """Gradients (n, n), states in the order of `_causes_first`, weights and values of what is read
    after a sample."""
    there, order = np.zeros((n, n), bool), _causes_first(n, of_Phi)
    there[tuple(np.array(of_Phi, int).reshape(-1, 2).T)] = True
    B = ca.SX(n, n)
    for i, j in np.argwhere(there.T[np.ix_(order, order)] @ np.triu(np.ones((n, n), bool))):
        B[int(i), int(j)] = later[int(j * n + i)]
    return B, later[-2 * n : -n], later[-n:]


def packed(x: Any, P: Any) -> Any:
    """x and P column by column."""
    return ca.vertcat(ca.densify(x), ca.vec(ca.densify(P)))


def unpacked(both: Array, n: int) -> tuple[Array, Array]:
    """x (N, n) and P (N, n, n), symmetric, of what `packed` put together."""
    return both[:, :n], both[:, n:].reshape(len(both), n, n)
