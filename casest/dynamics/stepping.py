"""One step of the filter in CasADi's symbols, run over a record by the engine.

A step of nine states is a few thousand operations: in NumPy the calls alone take longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.engine import Recursion

Pattern = tuple[tuple[int, int], ...]


def symmetric(matrix: Any) -> Any:
    """The matrix of its upper half: half the operations, and no drift."""
    upper = ca.triu(matrix)
    return ca.densify(upper + ca.triu(matrix, False).T)


def reach(A: Any) -> Pattern:
    """Which entries of Φ can differ from zero, given the pattern of A: (row, column)."""
    n = A.size1()
    rows, columns = A.sparsity().get_triplet()
    found = np.eye(n, dtype=bool)
    found[rows, columns] = True
    for _ in range(n):
        found = found @ found
    return tuple((int(i), int(j)) for i, j in np.argwhere(found))


def entries(matrix: Any) -> Pattern:
    """Which entries of a matrix of expressions are not zero for good: (row, column)."""
    rows, columns = matrix.sparsity().get_triplet()
    return tuple(zip(map(int, rows), map(int, columns), strict=True))


def _matrix(name: str, shape: tuple[int, int], pattern: Pattern) -> tuple[Any, Any]:
    """A full matrix of symbols, as it is handed over, and what can differ from zero of it."""
    full, used = ca.SX.sym(name, *shape), ca.SX(*shape)
    for i, j in pattern:
        used[i, j] = full[i, j]
    return full, used


def taken(x: Any, P: Any, c: Any, innovation: Any, s: Any) -> tuple[Any, Any]:
    """State and covariance after one scalar reading with gradient c and variance s."""
    PC = P @ c
    # One component at a time this form is as safe as Joseph's: s is a sum of positive terms.
    return x + PC * (innovation / s), symmetric(P - PC @ (PC / s).T)


@lru_cache(maxsize=16)
def kalman_step(n: int, m: int, of_Phi: Pattern, of_C: Pattern) -> Recursion:
    """(state, numbers of one sample) -> (state, also before the reading).

    state: x and P column by column; numbers: Φ, forced step, Q, C, diagonal of R, y. Readings are
    taken one component after the other, which needs no inverse (their noise is independent).
    """
    x, P = ca.SX.sym("x", n), ca.SX.sym("P", n, n)
    full, Phi = _matrix("Phi", (n, n), of_Phi)
    whole, C = _matrix("C", (m, n), of_C)
    u, Q = ca.SX.sym("u", n), ca.SX.sym("Q", n, n)
    R, y = ca.SX.sym("R", m), ca.SX.sym("y", m)
    before_x = Phi @ x + u
    before_P = symmetric(Phi @ P @ Phi.T + Q)
    after_x, after_P = before_x, before_P
    for i in range(m):
        c = C[i, :].T
        s = ca.dot(c, after_P @ c) + R[i]
        after_x, after_P = taken(after_x, after_P, c, y[i] - ca.dot(c, after_x), s)
    numbers = ca.vertcat(*[ca.vec(e) for e in (full, u, Q, whole, R, y)])
    outputs = [packed(after_x, after_P), packed(before_x, before_P)]
    return Recursion(ca.Function("step", [packed(x, P), numbers], outputs, {"cse": True}))


def packed(x: Any, P: Any) -> Any:
    """x and P column by column."""
    return ca.vertcat(ca.densify(x), ca.vec(ca.densify(P)))


def run_steps(steps: Recursion, state: Array, parts: Sequence[Array]) -> list[Array]:
    """Every output of the steps, (N, …) each.

    `state`: what the first step begins from; `parts`: arrays (N, …) of what each step is given,
    matrices included, in the order of its numbers; (N − 1, …) where the first is given zeros.
    """
    N = max(map(len, parts))
    numbers = np.empty((N, sum(p[0].size for p in parts)))
    place = 0
    for p in parts:
        own = numbers[:, place : place + p[0].size]
        place += p[0].size
        if p.ndim == 3:
            own, p = own.reshape(N, *p.shape[:0:-1]), p.transpose(0, 2, 1)
        own[N - len(p) :] = p
        own[: N - len(p)] = 0.0
    return steps(state, numbers)


def unpacked(both: Array, n: int) -> tuple[Array, Array]:
    """x (N, n) and P (N, n, n), symmetric, of what `packed` put together."""
    return both[:, :n], both[:, n:].reshape(len(both), n, n)
