"""The Riccati equation of the Kalman-Bucy filter: Ṗ = AP + PAᵀ + Ξ − PCᵀΘ⁻¹CP.

Over a step it is P → Q + Φ(P⁻¹ + W)⁻¹Φᵀ: readings of information W, then a motion, as a discrete
filter's. (Φ, Q, W) are those of a short part of the step, from the exponential of the Hamiltonian
matrix [[A, Ξ], [CᵀΘ⁻¹C, −Aᵀ]], doubled until it is whole: nothing grows, so that it is right
however stiff the equation is, where the fraction of linear systems overflows (Davison & Maki 1973;
doubling: Anderson 1978). P goes along as factors, and stays positive.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics import factors
from casest.dynamics.between import DOUBLINGS, balance
from casest.dynamics.declare import Dynamics
from casest.dynamics.samples import by_rows
from casest.dynamics.transition import Linearised, exponential, magnus, usual
from casest.engine import Recursion
from casest.errors import DataError

#: Size of the Hamiltonian matrix times the part of a step that its exponential is taken of.
_SHORT = 0.2
_BLOCK = 4096


def riccati(model: Dynamics, system: Linearised, start: Array | None = None) -> Array:
    """P at every sample, (N, n, n), from the covariance at the first (default: the model's).

    Raises DataError where the start is no covariance, or P leaves what numbers hold.
    """
    P = np.asarray(model.start_covariance if start is None else start, float)
    check_covariance(P, "the covariance at the beginning")
    n, count = model.size, len(system.time)
    found = np.empty((count, n, n))
    found[0] = P
    first = ca.Function("f", [], [factors.packed(ca.SX(n, 1), factors.factored(ca.SX(ca.DM(P))))])
    state = np.asarray(first()["o0"], float).ravel()
    for k in range(0, count - 1, _BLOCK):
        where = slice(k, min(k + _BLOCK, count - 1))
        parts = _over_steps(model, system, where)
        states, own = _riccati_step(n)(state, parts)
        state, found[where.start + 1 : where.stop + 1] = states[-1], own.reshape(-1, n, n)
    bad = np.flatnonzero(~np.isfinite(found).all(axis=(1, 2)))
    if bad.size:
        raise DataError(
            f"at t = {system.time[bad[0]]:.9g} s the covariance of {model.name} grows beyond what "
            "numbers hold: leave its fast state out, or give a shorter record"
        )
    return found


@lru_cache(maxsize=8)
def _riccati_step(n: int) -> Recursion:
    """(factors of P; Φ, Q and W of a step) -> (factors of P after it; P)."""
    both = ca.SX.sym("both", factors.size(n))
    x, P = factors.unpacked(both, n)
    Phi, Q, W = (ca.SX.sym(name, n, n) for name in ("Phi", "Q", "W"))
    U, D = factors.factored(W)
    for j in range(n):
        P, _ = factors.read(P, U[:, j], 1, D[j])
    P = factors.moved(P, Phi, factors.factored(Q))
    numbers = [by_rows(e) for e in (Phi, Q, W)]
    outputs = [factors.packed(x, P), ca.vec(factors.multiplied(P))]
    return Recursion(ca.Function("step", [both, *numbers], outputs, {"cse": True}))


def _over_steps(model: Dynamics, system: Linearised, where: slice) -> tuple[Array, Array, Array]:
    """Φ, Q and W of these steps, (…, n, n) each."""
    weight: Array = np.asarray(np.linalg.inv(model.noise_at(usual(system.steps))), float)
    ends = slice(where.start, where.stop + 1)
    n = model.size
    generator = magnus(_hamiltonian(model, system, ends, weight), system.steps[where])
    sizes, norm = balance(np.abs(generator).max(axis=0))
    unit = np.sqrt(sizes[:n] / sizes[n:])  # of the states; of information its inverse
    unit = np.exp2(np.round(np.log2(unit)))
    units = np.concatenate([unit, 1 / unit])
    times = int(np.clip(np.ceil(np.log2(max(norm / _SHORT, 1.0))), 0, DOUBLINGS))
    with np.errstate(all="ignore"):
        Phi, Q, W = _doubled(exponential(generator * (units / units[:, None]) * 0.5**times), times)
    return Phi * unit[:, None] / unit, Q * np.outer(unit, unit), W / np.outer(unit, unit)


def _doubled(short: Array, times: int) -> tuple[Array, Array, Array]:
    n = short.shape[1] // 2
    last = np.asarray(np.linalg.inv(short[:, n:, n:]), float)
    Phi, Q, W = last.transpose(0, 2, 1), short[:, :n, n:] @ last, last @ short[:, n:, :n]
    for _ in range(times):
        both = np.linalg.solve(np.eye(n) + Q @ W, np.concatenate([Phi, Q], axis=2))
        back = Phi.transpose(0, 2, 1)
        W = _even(W + back @ W @ both[:, :, :n])
        Q = _even(Q + Phi @ both[:, :, n:] @ back)
        Phi = Phi @ both[:, :, :n]
    return np.asarray(Phi), _even(Q), _even(W)


def _even(matrices: Array) -> Array:
    return np.asarray(0.5 * (matrices + matrices.transpose(0, 2, 1)))


def _hamiltonian(model: Dynamics, system: Linearised, where: slice, weight: Array) -> Array:
    A, C = system.A[where], system.C[where]
    n = model.size
    both = np.zeros((len(A), 2 * n, 2 * n))
    Xi = system.process[where] if system.process.ndim == 3 else system.process
    both[:, :n, :n], both[:, :n, n:] = A, Xi
    both[:, n:, :n] = C.transpose(0, 2, 1) @ weight @ C
    both[:, n:, n:] = -A.transpose(0, 2, 1)
    return both


def check_covariance(P: Array, what: str) -> None:
    """Refuse what is no covariance, with the eigenvalue that shows it."""
    if not np.all(np.isfinite(P)) or not np.allclose(P, P.T, rtol=1e-9, atol=1e-300):
        raise DataError(f"{what} is not a finite symmetric matrix")
    smallest = float(np.linalg.eigvalsh(P)[0])
    if smallest < -1e-12 * float(np.abs(P).max(initial=0.0)):
        raise DataError(
            f"{what} is not positive: it has the eigenvalue {smallest:.3g}; give variances"
        )
