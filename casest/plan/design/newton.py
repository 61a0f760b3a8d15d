"""Weights of few candidates by Newton's method: quadratic programs on the simplex.

Multiplicative steps come near the optimum quickly, and slowly to it; these end there. Of a maximum
of variances the program has one more unknown, and its multipliers say what share each has in it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.plan.design.criteria import Criterion, Largest, Volume, inverse

#: Steps, halvings of each, fall of Φ (as a share of what a slope promises at first) at the end.
STEPS, HALVINGS, ENOUGH = 25, 25, 1e-10
#: Combinations of a maximum that are looked at in one step.
NEAR = 40
#: Added to the Hessian's diagonal, as a share of its largest: candidates that are alike.
RIDGE = 1e-9


def newton(
    criterion: Criterion, known: Array, factors: Array, weights: Array, total: float, steps: int
) -> tuple[Array, Array]:
    """Weights (m,) after some steps, and the weight L (n, n) of the last slope."""
    C = _covariance(known, factors, total * weights)
    L, value = criterion.weight(C), criterion.value(C)
    for _ in range(steps):
        found = _step(criterion, factors, weights, total, C, L)
        if found is None:
            break
        step, L_next = found
        length, gained = 1.0, False
        for _ in range(HALVINGS):
            trial = np.maximum(weights + length * step, 0.0)
            trial /= trial.sum()
            C_trial = _covariance(known, factors, total * trial)
            there = criterion.value(C_trial)
            if there < value - ENOUGH * abs(value):
                gained = True
                break
            length /= 2
        if not gained:
            return weights, L_next
        weights, C, value = trial, C_trial, there
        L = L_next if isinstance(criterion, Largest) else criterion.weight(C)
    return weights, L


def _covariance(known: Array, factors: Array, weights: Array) -> Array:
    rows = (np.sqrt(weights)[:, None, None] * factors).reshape(-1, factors.shape[2])
    return inverse(known + rows.T @ rows)


def _step(
    criterion: Criterion, factors: Array, weights: Array, total: float, C: Array, L: Array
) -> tuple[Array, Array] | None:
    """The step of the quadratic program, and the weight that its multipliers give."""
    m = len(weights)
    H = _hessian(criterion, factors, total, C, L)
    if isinstance(criterion, Largest):
        return _step_of_largest(criterion, factors, weights, total, C, H)
    S = C @ L @ C
    slope = -total * np.sum((factors @ S) * factors, axis=(1, 2))
    size = np.abs(slope).max()
    found = _solved(H / size, slope / size, np.ones((1, m)), [0.0], [0.0], -weights, m)
    return None if found is None else (found[0], L)


def _hessian(criterion: Criterion, factors: Array, total: float, C: Array, L: Array) -> Array:
    """∂²Φ of weights, (m, m), for this L."""
    m, k, n = factors.shape
    rows = factors.reshape(-1, n)
    near = rows @ C @ rows.T
    other = near if isinstance(criterion, Volume) else 2 * (rows @ (C @ L @ C) @ rows.T)
    product = (near * other).reshape(m, k, m, k).sum(axis=(1, 3))
    H = total**2 * product
    return np.asarray(H + RIDGE * np.diag(H).max() * np.eye(m))


def _step_of_largest(
    criterion: Largest, factors: Array, weights: Array, total: float, C: Array, H: Array
) -> tuple[Array, Array] | None:
    """Unknowns are the step and the largest variance; those far below it do not count."""
    variances, m = criterion.variances(C), len(weights)
    size = variances.max()
    near = np.argsort(-variances)[:NEAR]
    near = near[variances[near] > 0.5 * size]
    slopes = -total * np.sum((factors @ (C @ criterion.K[:, near])) ** 2, axis=1).T / size
    A = np.vstack([np.append(np.ones(m), 0.0), np.column_stack([slopes, -np.ones(len(near))])])
    low = np.append(0.0, np.full(len(near), -np.inf))
    high = np.append(0.0, -variances[near] / size)
    Q = np.zeros((m + 1, m + 1))
    Q[:m, :m] = H / size
    Q[m, m] = RIDGE
    g = np.append(np.zeros(m), 1.0)
    found = _solved(Q, g, A, low, high, np.append(-weights, -np.inf), m)
    if found is None:
        return None
    shares = np.maximum(found[1][1:], 0.0)
    if not shares.sum() > 0:
        return None
    K = criterion.K[:, near]
    return found[0], np.asarray((K * (shares / shares.sum())) @ K.T)


def _solved(
    H: Array, g: Array, A: Array, low: Any, high: Any, least: Array, m: int
) -> tuple[Array, Array] | None:
    """The first m unknowns of a quadratic program, and its multipliers; None without a solution."""
    program = _program(len(g), len(A))
    found = program(
        h=ca.DM(H), g=ca.DM(g), a=ca.DM(A), lba=ca.DM(low), uba=ca.DM(high), lbx=ca.DM(least)
    )
    x = np.array(found["x"]).ravel()[:m]
    if not np.isfinite(x).all() or not program.stats()["success"]:
        return None
    return x, np.array(found["lam_a"]).ravel()


@lru_cache(maxsize=64)
def _program(unknowns: int, rows: int) -> Any:
    shape = {"h": ca.Sparsity.dense(unknowns, unknowns), "a": ca.Sparsity.dense(rows, unknowns)}
    quiet = {
        "print_iter": False,
        "print_header": False,
        "print_info": False,
        "error_on_fail": False,
    }
    return ca.conic("weights", "qrqp", shape, quiet)
