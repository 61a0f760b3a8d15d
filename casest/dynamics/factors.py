"""Covariances as P = U·D·Uᵀ, U unit upper triangular and D diagonal, in CasADi's symbols.

Variances are sums of positive terms here, so that they stay positive, and a state known to 1e6
beside one known to 1e-6 loses no digits: the difference P − KCP of the plain form has none left.
A reading: G. Bierman, Factorization Methods for Discrete Sequential Estimation (1977), V.3; a step
in time: weighted Gram-Schmidt (C. Thornton, 1976).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

#: U and D.
Factors = tuple[Any, Any]


def over(a: Any, b: Any) -> Any:
    """a/b, and nothing where b is: what is certain teaches nothing.

    Not by if_else, which CasADi draws out of every product that follows: a branch each."""
    return a * (b > 0) / (b + (b <= 0))


def multiplied(factors: Factors) -> Any:
    """U·D·Uᵀ."""
    U, D = factors
    upper = ca.triu(U @ ca.diag(D) @ U.T)
    return ca.densify(upper + ca.triu(upper, False).T)


def variance(factors: Factors, c: Any) -> Any:
    """cᵀPc."""
    U, D = factors
    return ca.dot(D, (U.T @ c) ** 2)


def std(factors: Factors) -> Any:
    """Roots of P's diagonal."""
    U, D = factors
    return ca.densify(ca.sqrt(ca.sum2((U * U) @ ca.diag(D))))


def factored(P: Any) -> Factors:
    """U and D of a covariance; what rounding makes negative in D is zero."""
    n = P.size1()
    U, D, left = ca.SX.eye(n), ca.SX.zeros(n), ca.SX(P)
    for j in range(n - 1, -1, -1):
        D[j] = ca.fmax(left[j, j], 0)
        own = [over(left[i, j], D[j]) for i in range(j)]
        for i in range(j):
            U[i, j] = own[i]
            for k in range(i + 1):
                left[k, i] -= own[k] * (own[i] * D[j])
    return U, D


def orthogonal(rows: Any, weights: Any) -> Factors:
    """U and D of rows·diag(weights)·rowsᵀ."""
    n = rows.size1()
    U, D = ca.SX.eye(n), ca.SX.zeros(n)
    left = [rows[i, :] for i in range(n)]
    for j in range(n - 1, -1, -1):
        heavy = left[j].T * weights
        D[j] = ca.dot(left[j].T, heavy)
        for i in range(j):
            U[i, j] = over(ca.dot(left[i].T, heavy), D[j])
            left[i] = left[i] - U[i, j] * left[j]
    return U, D


def moved(factors: Factors, Phi: Any, noise: Factors) -> Factors:
    """After a step: U and D of ΦPΦᵀ + Q."""
    (U, D), (Uq, Dq) = factors, noise
    return orthogonal(ca.horzcat(Phi @ U, Uq), ca.vertcat(D, Dq))


def read(factors: Factors, c: Any, variance: Any, weight: Any = 1) -> tuple[Factors, Any]:
    """After one scalar reading with gradient c: U and D, and the gain.

    Its variance is `variance`/`weight`: of no weight it says nothing.
    """
    found, gain, _ = read_with(factors, c, variance, weight)
    return found, gain


def read_with(factors: Factors, c: Any, variance: Any, weight: Any = 1) -> tuple[Factors, Any, Any]:
    """The same with the innovation's variance, times `weight`."""
    U, D = factors
    n = D.numel()
    f = U.T @ c
    g, f = D * f, weight * f
    after_U, after_D, gain = ca.SX(U), ca.SX.zeros(n), ca.SX.zeros(n)
    before, one_over = variance, None
    for j in range(n):
        s = before + f[j] * g[j]
        for i in range(j):
            after_U[i, j] = U[i, j] - gain[i] * (f[j] * one_over)
            gain[i] += U[i, j] * g[j]
        gain[j] = g[j]
        last, before, one_over = before, s, 1 / s  # a division takes as long as many products
        after_D[j] = D[j] * (last * one_over)
    return (after_U, after_D), gain * (weight * one_over), before


def packed(x: Any, factors: Factors) -> Any:
    """x, D, and the columns of U above its diagonal."""
    U, D = factors
    above = [U[:j, j] for j in range(1, D.numel())]
    return ca.vertcat(*[ca.densify(part) for part in (x, D, *above)])


def unpacked(both: Any, n: int) -> tuple[Any, Factors]:
    """x, U and D of what `packed` put together."""
    U, place = ca.SX.eye(n), 2 * n
    for j in range(1, n):
        U[:j, j] = both[place : place + j]
        place += j
    return both[:n], (U, both[n : 2 * n])


def size(n: int) -> int:
    """How many numbers `packed` makes of n states."""
    return 2 * n + n * (n - 1) // 2
