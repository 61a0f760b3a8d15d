"""Measurements that cost differently: the best that a budget buys.

Weights in units of cost make it a design of a total again: a candidate's information for one unit
of cost is its own over its cost, and the tangent bounds what any design of that cost can do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.plan.design.continuous import continuous
from casest.plan.design.criteria import Criterion, inverse
from casest.plan.design.exact import in_order
from casest.plan.planning import Planned, Task

#: Passes of exchanges; gain below which none is made; a purse that is empty.
PASSES, GAIN, EMPTY = 20, 1e-9, 1e-9
#: Candidates that are tried in place of others; different ones up to which pairs are given up.
TRIED, FEW = 6, 10


def bought(given: Task, criterion: Criterion, cost: Array, budget: float) -> Planned:
    """Candidates of at most this cost (N,) together, each as often as it is worth.

    UsageError where they do not determine the unknowns.
    """
    if not budget >= cost.min():
        raise UsageError(
            f"--budget {budget:g}: the cheapest of {len(cost)} candidates costs {cost.min():g}"
        )
    per_cost = given.factors / np.sqrt(cost)[:, None, None]
    floor = continuous(criterion, given.start, per_cost, budget).floor
    chosen = _exchanged(given, criterion, cost, budget, _filled(given, criterion, cost, budget, []))
    if given.covariance(chosen) is None:
        rank = np.linalg.matrix_rank(given.information(chosen), hermitian=True)
        raise UsageError(
            f"--budget {budget:g}: its {len(chosen)} measurements determine {rank} of "
            f"{len(given.scale)} unknowns: a larger one"
        )
    chosen = in_order(criterion, given.start, given.factors, chosen)
    steps = tuple(given.covariance(chosen[:k]) for k in range(len(chosen) + 1))
    value = criterion.value(inverse(given.start + _sum(given, chosen)))
    return Planned(tuple(chosen), steps, criterion.ratio(floor, value, len(given.scale)))


def _filled(
    given: Task, criterion: Criterion, cost: Array, budget: float, chosen: Sequence[int]
) -> list[int]:
    """More candidates, each time the one that gains most for its cost, while they can be paid."""
    chosen, left = list(chosen), budget - float(cost[list(chosen)].sum())
    M = given.start + _sum(given, chosen)
    while (can := cost <= left + EMPTY * budget).any():
        C = inverse(M)
        gain = (criterion.value(C) - criterion.after(C, given.factors)) / cost
        best = int(np.argmax(np.where(can, gain, -np.inf)))
        chosen.append(best)
        left -= float(cost[best])
        M = M + given.factors[best].T @ given.factors[best]
    return chosen


def _exchanged(
    given: Task, criterion: Criterion, cost: Array, budget: float, chosen: list[int]
) -> list[int]:
    """Neither one of them nor, of few, two can be given up for others that gain more."""
    value = _value(given, criterion, chosen)
    for _ in range(PASSES):
        before = value
        different = list(dict.fromkeys(chosen))
        pairs = combinations_with_replacement(different, 2) if len(different) <= FEW else ()
        for old in [*((one,) for one in different), *pairs]:
            if any(chosen.count(i) < old.count(i) for i in old):
                continue
            for trial in _instead(given, criterion, cost, budget, chosen, old):
                there = _value(given, criterion, trial)
                if there < value - GAIN * max(1.0, abs(value)):
                    chosen, value = trial, there
                    break
        if not value < before:
            break
    return chosen


def _instead(
    given: Task,
    criterion: Criterion,
    cost: Array,
    budget: float,
    chosen: Sequence[int],
    old: Sequence[int],
) -> Iterator[list[int]]:
    """What the cost of some of them buys: beginning with each of the most valuable ones."""
    others = list(chosen)
    for i in old:
        others.remove(i)
    left = budget - float(cost[others].sum())
    after = criterion.after(inverse(given.start + _sum(given, others)), given.factors)
    after = np.where(cost <= left + EMPTY * budget, after, np.inf)
    for first in np.argsort(after)[:TRIED]:
        if np.isfinite(after[first]):
            yield _filled(given, criterion, cost, budget, [*others, int(first)])
    yield _filled(given, criterion, cost, budget, others)


def _value(given: Task, criterion: Criterion, chosen: Sequence[int]) -> float:
    return criterion.value(inverse(given.start + _sum(given, chosen)))


def _sum(given: Task, chosen: Sequence[int]) -> Array:
    own = given.factors[list(chosen)].reshape(-1, len(given.scale))
    return np.asarray(own.T @ own)
