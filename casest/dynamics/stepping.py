"""One step of the filter in CasADi's symbols, run over a record by its virtual machine.

A step of nine states is a few thousand operations: in NumPy the calls alone take longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.declaring.shapes import Array

#: Steps in one accumulated map.
CHUNK = 500


def _symmetric(matrix: Any) -> Any:
    """The matrix of its upper half: half the operations, and no drift."""
    upper = ca.triu(matrix)
    return ca.densify(upper + ca.triu(matrix, False).T)


def reach(A: Any) -> tuple[tuple[int, int], ...]:
    """Which entries of Φ can differ from zero, given the pattern of A: (row, column)."""
    n = A.size1()
    rows, columns = A.sparsity().get_triplet()
    found = np.eye(n, dtype=bool)
    found[rows, columns] = True
    for _ in range(n):
        found = found @ found
    return tuple((int(i), int(j)) for i, j in np.argwhere(found))


@lru_cache(maxsize=16)
def kalman_step(n: int, m: int, pattern: tuple[tuple[int, int], ...]) -> Any:
    """(state, numbers of one sample) -> (state, also before the reading), CHUNK steps at a time.

    state: x and P column by column; numbers: Φ, forced step, Q, C, diagonal of R, y. Readings are
    taken one component after the other, which needs no inverse (their noise is independent).
    """
    x, P = ca.SX.sym("x", n), ca.SX.sym("P", n, n)
    full, u, Q = ca.SX.sym("Phi", n, n), ca.SX.sym("u", n), ca.SX.sym("Q", n, n)
    Phi = ca.SX(n, n)
    for i, j in pattern:
        Phi[i, j] = full[i, j]
    C, R, y = ca.SX.sym("C", m, n), ca.SX.sym("R", m), ca.SX.sym("y", m)
    before_x = Phi @ x + u
    before_P = Phi @ P @ Phi.T + Q
    before_P = _symmetric(before_P)
    after_x, after_P = before_x, before_P
    for i in range(m):
        c = C[i, :].T
        PC = after_P @ c
        s = ca.dot(c, PC) + R[i]
        after_x = after_x + PC * ((y[i] - ca.dot(c, after_x)) / s)
        # One component at a time this form is as safe as Joseph's: s is a sum of positive terms.
        after_P = _symmetric(after_P - PC @ (PC / s).T)
    numbers = ca.vertcat(*[ca.vec(e) for e in (full, u, Q, C, R, y)])
    state = ca.vertcat(x, ca.vec(P))
    after = ca.vertcat(after_x, ca.vec(after_P))
    before = ca.vertcat(before_x, ca.vec(before_P))
    step = ca.Function("step", [state, numbers], [after, before], {"cse": True})
    return step.mapaccum("steps", CHUNK)


def run_steps(
    steps: Any, x: Array, P: Array, parts: Sequence[Array]
) -> tuple[Array, Array, Array, Array]:
    """x (N, n), P (N, n, n) after every reading, and both before it.

    `parts`: arrays (N, …) of what each step is given, matrices included.
    """
    N, n = len(parts[0]), len(x)
    flat = [p.transpose(0, 2, 1).reshape(N, -1) if p.ndim == 3 else p for p in parts]
    padded = -(-N // CHUNK) * CHUNK
    numbers = np.zeros((padded, sum(f.shape[1] for f in flat)))
    np.concatenate(flat, axis=1, out=numbers[:N])
    numbers[N:] = numbers[N - 1]
    state = np.concatenate([x, P.T.ravel()])
    after, before = (np.empty((padded, len(state))) for _ in range(2))
    # CasADi's matrices are column by column: a row of these arrays is one of its columns.
    buffer, run = steps.buffer()
    for k in range(0, padded, CHUNK):
        span = slice(k, k + CHUNK)
        arrays: Any = (state, numbers[span]), (after[span], before[span])
        for i in range(2):
            buffer.set_arg(i, memoryview(arrays[0][i]))
            buffer.set_res(i, memoryview(arrays[1][i]))
        run()
        state = after[k + CHUNK - 1].copy()
    both = [a[:N] for a in (after, before)]
    matrices = [b[:, n:].reshape(N, n, n).transpose(0, 2, 1) for b in both]
    return both[0][:, :n], matrices[0], both[1][:, :n], matrices[1]
