"""Measurements each of which can be made once, such as readings at the times of one run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.plan.design.continuous import slopes
from casest.plan.design.criteria import Criterion, inverse

#: Passes of exchanges.
PASSES = 10


def distinct(
    criterion: Criterion, known: Array, factors: Sequence[Array], count: int, worst: bool
) -> list[int]:
    """`count` different candidates, none of which another one should replace.

    factors: of each possible beginning, (N, m, f).
    """
    chosen: list[int] = []
    informations = [known.copy() for _ in factors]
    while len(chosen) < count:
        best = int(np.argmin(_after(criterion, informations, factors, chosen, worst)))
        chosen.append(best)
        informations = [M + _square(F[best]) for M, F in zip(informations, factors, strict=True)]
    for _ in range(PASSES):
        gained = False
        for place, old in enumerate(chosen):
            without = [M - _square(F[old]) for M, F in zip(informations, factors, strict=True)]
            others = chosen[:place] + chosen[place + 1 :]
            after = _after(criterion, without, factors, others, worst)
            best = int(np.argmin(after))
            if best != old and after[best] < after[old] - 1e-9:
                chosen[place], gained = best, True
                informations = [M + _square(F[best]) for M, F in zip(without, factors, strict=True)]
        if not gained:
            break
    return sorted(chosen)


def _after(
    criterion: Criterion,
    informations: Sequence[Array],
    factors: Sequence[Array],
    taken: Sequence[int],
    worst: bool,
) -> Array:
    """What each candidate would make of it, infinite where it is taken."""
    every = np.array([
        criterion.after(inverse(M), F) for M, F in zip(informations, factors, strict=True)
    ])  # fmt: skip
    found = every.max(axis=0) if worst else every.mean(axis=0)
    found[list(taken)] = np.inf
    return np.asarray(found)


def floor_of(criterion: Criterion, C: Array, factors: Array, chosen: Sequence[int]) -> float:
    """The least Φ that as many different candidates can have: the tangent at C, that of `chosen`.

    None can be made more than once, so that the steepest ones are what could be gained at most.
    """
    s = slopes(C, criterion.weight(C), factors)
    gain = float(np.sort(s)[-len(chosen) :].sum() - s[list(chosen)].sum())
    return criterion.base(C, criterion.weight(C)) - gain


def _square(F: Array) -> Array:
    return np.asarray(F.T @ F)
