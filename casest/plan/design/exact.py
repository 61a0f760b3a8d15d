"""Whole measurements, exchanged one by one (Fedorov 1972) until none gains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.plan.design.criteria import Criterion, inverse

#: Passes of exchanges; they end by themselves after a few.
PASSES = 20
#: Share of Φ below which an exchange gains nothing.
GAIN = 1e-9


def exchanged(
    criterion: Criterion, known: Array, factors: Array, chosen: Sequence[int]
) -> list[int]:
    """A design of as many measurements, none of which can be exchanged for a better one."""
    chosen = list(chosen)
    M = known + sum((_square(factors[i]) for i in chosen), np.zeros_like(known))
    value = criterion.value(inverse(M))
    for _ in range(PASSES):
        before = value
        for place, old in enumerate(chosen):
            without = M - _square(factors[old])
            after = criterion.after(inverse(without), factors)
            best = int(np.argmin(after))
            if after[best] < value - GAIN * max(1.0, abs(value)):
                chosen[place], M = best, without + _square(factors[best])
                value = criterion.value(inverse(M))
        if not value < before:
            break
    return chosen


def in_order(
    criterion: Criterion, known: Array, factors: Array, chosen: Sequence[int]
) -> list[int]:
    """The same measurements, those first that bring most."""
    left, M, ordered = list(chosen), known, []
    while left:
        after = criterion.after(inverse(M), factors[left])
        best = left.pop(int(np.argmin(after)))
        ordered.append(best)
        M = M + _square(factors[best])
    return ordered


def rounded(weights: Array, count: int) -> list[int]:
    """Whole numbers near the weights (Pukelsheim & Rieder 1992), as a list of candidates."""
    support = np.flatnonzero(weights > 1e-6 * weights.max())
    support = support[np.argsort(-weights[support])][:count]
    share = weights[support] / weights[support].sum()
    numbers = np.maximum(np.ceil((count - 0.5 * len(support)) * share), 1).astype(int)
    while (over := int(numbers.sum()) - count) != 0:
        if over > 0:
            can = numbers > 1
            ranks = np.where(can, (numbers - 1) / share, -np.inf)
            numbers[int(np.argmax(ranks))] -= 1
        else:
            numbers[int(np.argmin(numbers / share))] += 1
    return [int(i) for i, times in zip(support, numbers, strict=True) for _ in range(times)]


def _square(factor: Array) -> Array:
    return np.asarray(factor.T @ factor)
