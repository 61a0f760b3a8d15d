"""Score tests in whitened innovations: is there an effect, how large, could it have been seen?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.motion.sensitivity import Sensitivity
from casest.effects.moving import Candidate

#: Directions in which a typical size would be worth less than this many squared standard
#: deviations are not tested.
WORTH = 1.0
#: Stretches whose scatter checks the significance.
STRETCHES = 40


@dataclass(frozen=True)
class Score:
    """What one pass says of a candidate: first-order numbers, their std, significance.

    `gain`: how far twice the log-likelihood would rise; `information` (p, p) of its numbers;
    `moves` (n, p): median effect of each on the states.
    """

    candidate: Candidate
    step: Array
    std: Array
    gain: float
    p_value: float
    information: Array
    moves: Array


def stretches(count: int, parts: int = STRETCHES) -> NDArray[np.int_]:
    """The stretch of each of `count` samples, from 0."""
    return np.arange(count) * parts // count


def scores(found: Sensitivity, tried: list[Candidate]) -> list[Score]:
    """Every candidate's, the most significant first."""
    part = stretches(len(found.z))
    judged = [
        _score(candidate, found.z, found.H[:, :, where], found.moves[:, where], part)
        for candidate, where in zip(tried, found.columns, strict=True)
    ]
    return sorted(judged, key=lambda s: (s.p_value, -s.gain))


def _score(candidate: Candidate, z: Array, H: Array, moves: Array, part: NDArray[np.int_]) -> Score:
    M, b = by_stretch(z, H, part)
    total, whole = b.sum(axis=0), M.sum(axis=0)
    kept = _worth(whole, candidate.typical)
    inner = kept.T @ whole @ kept
    step = kept @ np.linalg.solve(inner, kept.T @ total) if kept.shape[1] else 0 * total
    p_value = _p_value(kept.T @ total, inner, (b - M @ step) @ kept, kept.shape[1])
    with np.errstate(all="ignore"):
        std = np.sqrt(np.diag(np.linalg.pinv(whole, hermitian=True)))
    return Score(candidate, step, std, float(total @ step), p_value, whole, moves)


def by_stretch(z: Array, H: Array, part: NDArray[np.int_]) -> tuple[Array, Array]:
    """Information (J, p, p) and gradient (J, p) of every stretch."""
    first = np.flatnonzero(np.diff(part, prepend=-1))
    M = np.add.reduceat(H.transpose(0, 2, 1) @ H, first)
    return M, np.add.reduceat(np.einsum("kij,ki->kj", H, z), first)


def _worth(information: Array, typical: float) -> Array:
    """Directions (p, r) in which a typical size could be noticed at all."""
    values, vectors = np.linalg.eigh(information * typical**2)
    return vectors[:, values > WORTH]


def _p_value(total: Array, information: Array, rest: Array, rank: int) -> float:
    """The larger of two: by the model's own noise, and by the scatter from stretch to stretch."""
    if rank == 0:
        return 1.0
    from scipy.special import chdtrc, fdtrc

    own = float(chdtrc(rank, total @ np.linalg.solve(information, total)))
    count = len(rest)
    scatter = rest.T @ rest
    squared = (count - rank) / rank * float(total @ np.linalg.solve(scatter, total)) / count
    return max(own, float(fdtrc(rank, count - rank, squared * count / (count - 1))))
