"""The Riccati equation of the Kalman-Bucy filter: Ṗ = AP + PAᵀ + Ξ − PCᵀΘ⁻¹CP.

Integrated as a fraction of linear systems: with [X; Y]˙ = [[A, Ξ], [CᵀΘ⁻¹C, −Aᵀ]]·[X; Y] and
P = XY⁻¹ every step is one matrix exponential. P stays symmetric and positive however stiff the
equation is, where Runge-Kutta on P itself loses digits or overflows (Davison & Maki 1973; Schiff &
Shnider 1999).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.transition import Linearised, magnus_blocks
from casest.errors import DataError


def riccati(model: Dynamics, system: Linearised, start: Array | None = None) -> Array:
    """P at every sample, (N, n, n), from the covariance at the first (default: the model's).

    Raises DataError where the start is no covariance.
    """
    from scipy.linalg.lapack import dgesv

    P = np.asarray(model.start_covariance if start is None else start, float)
    check_covariance(P, "the covariance at the beginning")
    n = model.size
    found = np.empty((len(system.time), n, n))
    found[0] = P
    both = np.empty((2 * n, n))
    top, bottom = both[:n].T, both[n:].T
    for later, step in zip(found[1:], chain.from_iterable(_blocks(model, system)), strict=True):
        np.dot(step[:, :n], P, out=both)
        both += step[:, n:]
        # The rows of [X; Y] are the columns that LAPACK wants: P = XY⁻¹ = (Y⁻ᵀXᵀ)ᵀ.
        half = dgesv(bottom, top, 1, 1)[2]
        P = np.add(half, half.T, out=later)
        P *= 0.5
    return found


def _blocks(model: Dynamics, system: Linearised) -> Iterator[Array]:
    """Transition of [X; Y] over every step, (…, 2n, 2n), by fourth-order Magnus steps."""
    weight: Array = np.asarray(np.linalg.inv(model.noise), float)
    return magnus_blocks(lambda where: _hamiltonian(model, system, where, weight), system)


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
