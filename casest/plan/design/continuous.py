"""The best design if a measurement could be made half a time, and how far any design is from it.

Multiplicative steps (Silvey, Titterington & Torsney 1978; Yu 2010), Newton's method on the few
candidates that matter, and the tangent of a convex function as certificate (Kiefer & Wolfowitz
1960): no design of the same total is better than the tangent at this one says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.data.run import Index
from casest.declaration.shapes import Array
from casest.plan.design.criteria import Criterion, Largest, Longest, Volume, inverse
from casest.plan.design.newton import newton

#: Share of the standard deviations by which a certified design may be worse than the best.
CLOSE = 3e-3
#: From this share on multiplicative steps do; below it Newton's method ends them.
SHARP = 1e-3
#: Rounds in which more candidates are let in, steps in each, candidates let in at once.
ROUNDS, STEPS, LET_IN = 30, 12, 40
#: Multiplicative steps in a round, where there is no Newton's method.
MORE_STEPS = 150
#: Weight below which a candidate is dropped, as a share of the largest.
DROPPED = 1e-7


@dataclass(frozen=True)
class Continuous:
    """Weights (N,) that add up to one, Φ there, and the least Φ that any weights can have."""

    weights: Array
    value: float
    floor: float


def information(known: Array, factors: Array, weights: Array) -> Array:
    """M (n, n): what is known, and each candidate as often as its weight says."""
    n = factors.shape[2]
    rows = (np.sqrt(weights)[:, None, None] * factors).reshape(-1, n)
    return np.asarray(known + rows.T @ rows)


def slopes(C: Array, L: Array, factors: Array) -> Array:
    """By how much Φ falls with each candidate, (N,), to first order; L as of `Criterion.weight`."""
    S = C @ L @ C
    return np.asarray(np.sum((factors @ S) * factors, axis=(1, 2)))


def steepness(criterion: Criterion, C: Array, factors: Array) -> Array:
    """The same with the criterion's own weight; of few combinations without its n×n matrices."""
    if isinstance(criterion, Largest):
        return np.asarray(np.sum((factors @ (C @ criterion.root(C))) ** 2, axis=(1, 2)))
    return slopes(C, criterion.weight(C), factors)


def certified(
    criterion: Criterion, known: Array, factors: Array, weights: Array, total: float
) -> tuple[float, float]:
    """Φ of the weights, and the least Φ of any with this total."""
    C = inverse(information(known, factors, total * weights))
    L = criterion.weight(C)
    s = total * slopes(C, L, factors)
    return criterion.value(C), criterion.base(C, L) - float(s.max() - weights @ s)


def continuous(
    criterion: Criterion, known: Array, factors: Array, total: float, close: float = CLOSE
) -> Continuous:
    """The best weights of candidates (N, k, n), of which `total` are made."""
    N, n = len(factors), factors.shape[2]
    weights = np.full(N, 1 / N)
    weights = _steps(criterion, known, factors, weights, total, 12)
    active = _strongest(weights, 4 * n)
    floor = -np.inf
    for _ in range(ROUNDS):
        few, L = weights[active] / weights[active].sum(), None
        if close > SHARP or isinstance(criterion, Longest):
            few, L = _steps(criterion, known, factors[active], few, total, MORE_STEPS), None
        else:
            few, L = newton(criterion, known, factors[active], few, total, STEPS)
        weights = np.zeros(N)
        weights[active] = few
        C = inverse(information(known, factors, total * weights))
        L = criterion.weight(C) if L is None else L
        s = total * slopes(C, L, factors)
        value, mean = criterion.value(C), float(weights @ s)
        floor = max(floor, criterion.base(C, L) - float(s.max() - mean))
        best = Continuous(weights, value, floor)
        if criterion.ratio(floor, value, n) > 1 - close:
            break
        kept = weights > DROPPED * weights.max()
        better = np.argsort(-s)[:LET_IN]
        better = better[(s[better] > mean) & ~kept[better]]
        share = 0.02 / max(len(better), 1)
        weights = np.where(kept, weights, 0.0)
        weights[better] = share
        weights /= weights.sum()
        active = np.flatnonzero(weights).astype(np.int_)
    return best


def _steps(
    criterion: Criterion, known: Array, factors: Array, weights: Array, total: float, count: int
) -> Array:
    """Weights after some multiplicative steps; a step that does not gain is shortened."""
    power = 1.0 if isinstance(criterion, Volume) else 0.5
    C = inverse(information(known, factors, total * weights))
    value = criterion.value(C)
    for _ in range(count):
        s = np.maximum(steepness(criterion, C, factors), 0.0)
        ratio = s / (weights @ s)
        while power > 1e-3:
            trial = weights * ratio**power
            trial /= trial.sum()
            C_trial = inverse(information(known, factors, total * trial))
            if (there := criterion.value(C_trial)) <= value:
                break
            power /= 2
        else:
            break
        weights, C, value = trial, C_trial, there
    return weights


def _strongest(weights: Array, count: int) -> Index:
    return np.asarray(np.sort(np.argsort(-weights)[:count]))
