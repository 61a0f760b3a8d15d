"""How likely a residual is where the sensor's offset may wander, as flicker noise does.

Where the residual is what becomes of an offset by turning with a body (of a length), slow noise of
the offset is slow in no residual: from pose to pose it looks independent, and any slow cause would
be far beyond chance. Here the offset's course is random: cosines along the record whose variances
are one over their number, of a size by the largest likelihood.
"""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.likelihood import Likelihood

#: Rounds in which the course's size and the spectrum of the rest follow each other.
ROUNDS = 3
#: Sizes that are tried: the course's variance over that of the rest.
SIZES = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 57)])


def wandering_cost(likelihood: Likelihood, course: Array) -> float:
    """−2 log L beside the unknowns and a random course, columns (N, m, k) of unit variance each.

    With Schwarz's price of the course's size; without a course where it is not worth that.
    """
    without, W = likelihood.beside(), likelihood.by_frequency(course)
    S = without.spectrum
    for _ in range(ROUNDS):
        _, left, taken = _beside(likelihood, W, S)
        S = likelihood.spectrum(left, 1 - taken)
    cost, _, _ = _beside(likelihood, W, S)
    price = float(np.log(max(len(S) - likelihood.declared.shape[1], 2)))
    return min(without.cost, cost + price)


def _beside(likelihood: Likelihood, W: Array, S: Array) -> tuple[float, Array, Array]:
    """−2 log L with the likeliest size of the course under a spectrum S; what unknowns and course
    leave (N·m,), and the share of each row that they take."""
    root = 1 / np.sqrt(S)
    Q, _ = np.linalg.qr(likelihood.declared * root[:, None])
    whole, r = W * root[:, None], likelihood.residual * root
    beside, r = whole - Q @ (Q.T @ whole), r - Q @ (Q.T @ r)
    values, vectors = np.linalg.eigh(beside.T @ beside)
    values, along = np.maximum(values, 0.0), vectors.T @ (beside.T @ r)
    spread = np.maximum(np.linalg.eigvalsh(whole.T @ whole), 0.0)
    sizes = SIZES[:, None] * (float(r @ r) / max(float(spread.sum()), 1e-300))
    costs = np.log1p(sizes * spread).sum(axis=1)
    costs -= (along**2 * sizes / (1 + sizes * values)).sum(axis=1)
    size = float(sizes[int(np.argmin(costs)), 0])
    kept = size / (1 + size * values)
    left = r - beside @ (vectors @ (along * kept))
    taken = np.einsum("ij,ij->i", Q, Q)
    taken += np.einsum("ij,ij->i", beside @ (vectors * kept), beside @ vectors)
    return float(np.log(S).sum() + r @ r + costs.min()), left / root, taken
