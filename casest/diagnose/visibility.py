"""What data can show of an effect: what the declared parameters leave of it, and how they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import Trial


@dataclass(frozen=True)
class Visible:
    """Of one candidate with q unknowns beside n declared ones.

    survives (q,): share of each that the declared ones leave; bias (n, q): their shift by one unit
    of it; information (q, q) under the noise as it is.
    """

    candidate: Candidate
    survives: Array
    bias: Array
    information: Array


def visible(linear: Linear, trials: Sequence[Trial]) -> tuple[Visible, ...]:
    """Of every trial, by least squares weighted with the noise's spectrum."""
    likelihood = Likelihood(linear)
    root = 1 / np.sqrt(likelihood.beside().spectrum)[:, None]
    J = likelihood.by_frequency(linear.beside) * root
    size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    A = np.linalg.pinv((J / size).T @ (J / size), rcond=1e-10, hermitian=True)
    return tuple(_of(t, J / size, size, A, likelihood, root) for t in trials)


def _of(
    trial: Trial, J: Array, size: Array, A: Array, likelihood: Likelihood, root: Array
) -> Visible:
    G = likelihood.by_frequency(trial.columns) * root
    absorbed = A @ (J.T @ G)
    left = G - J @ absorbed
    length = np.maximum(np.linalg.norm(G, axis=0), 1e-300)
    survives = np.linalg.norm(left, axis=0) / length
    return Visible(trial.what, survives, absorbed / size[:, None], left.T @ left)
