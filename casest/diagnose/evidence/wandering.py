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
    X, W = likelihood.declared, likelihood.by_frequency(course)
    without, R = likelihood.beside(), likelihood.residual
    S = without.spectrum
    for last in [False] * ROUNDS + [True]:
        root = 1 / np.sqrt(S)
        Q, _ = np.linalg.qr(X * root[:, None])
        whole, r = W * root[:, None], R * root
        beside, r = whole - Q @ (Q.T @ whole), r - Q @ (Q.T @ r)
        values, vectors = np.linalg.eigh(beside.T @ beside)
        values = np.maximum(values, 0.0)
        along = vectors.T @ (beside.T @ r)
        spread = np.maximum(np.linalg.eigvalsh(whole.T @ whole), 0.0)
        sizes = SIZES * (float(r @ r) / max(float(spread.sum()), 1e-300))
        costs = [
            float(np.log1p(a * spread).sum() - (along**2 * a / (1 + a * values)).sum())
            for a in sizes
        ]
        a, cost = sizes[int(np.argmin(costs))], min(costs)
        if last:
            break
        kept = a / (1 + a * values)
        left = r - beside @ (vectors @ (along * kept))
        taken = np.einsum("ij,ij->i", Q, Q)
        taken += np.einsum("ij,ij->i", beside @ (vectors * kept), beside @ vectors)
        S = likelihood.spectrum(left / root, 1 - taken)
    price = float(np.log(max(len(R) - X.shape[1], 2)))
    return min(without.cost, float(np.log(S).sum() + r @ r) + cost + price)
