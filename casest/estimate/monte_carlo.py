"""Is the propagation of uncertainty to first order valid? Monte Carlo decides (JCGM 101:2008).

Blocks of trials are added until the results have stabilised (7.9): twice the standard deviations
of the mean, of the standard uncertainty and of both ends of the 95 % interval, from block to block,
lie below a fifth of the numerical tolerance (8.2). First order is validated where both ends of its
interval are within that tolerance of the trials' (8.1).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.profile_likelihood import half_width
from casest.estimate.trials import Refits, Trials

#: Trials of a block: as many as JCGM 101, 7.2.2 and 7.9.4 ask for at 95 %.
BLOCK = 10_000
#: Trials in all, whatever the time.
MOST = 2_000_000
#: Part of the tolerance to which the trials' own results must be known (8.2).
FINER = 5
#: Share of trials without a minimum from which on the fit itself is in question.
LOST = 1e-3
#: Ends of a symmetric 95 % interval.
ENDS = (0.025, 0.975)


@dataclass(frozen=True)
class FirstOrder:
    """What is to be validated of q numbers: names, values (q,), standard uncertainties (q,) and
    half widths of the 95 % intervals (q,)."""

    names: tuple[str, ...]
    values: Array
    std: Array
    half: Array


@dataclass(frozen=True)
class Validation:
    """Of q numbers: mean, standard deviation, interval (q, 2) of the trials; `tolerance` (q,);
    distances of the interval's ends from those of first order (q, 2), and how well these are known
    (q, 2: twice their standard deviation). `lost`: trials that found no minimum; `stable`: did all
    results settle before time or trials ran out?"""

    first: FirstOrder
    trials: int
    lost: int
    seconds: float
    stable: bool
    mean: Array
    std: Array
    interval: Array
    tolerance: Array
    apart: Array
    known_to: Array

    @property
    def validated(self) -> list[bool | None]:
        """Of each number; None where the trials could not tell."""
        if self.lost > LOST * self.trials:
            return [False] * len(self.mean)
        return [self._verdict(i) for i in range(len(self.mean))]

    def _verdict(self, i: int) -> bool | None:
        allowed, apart, known = self.tolerance[i], self.apart[i], self.known_to[i]
        if self.stable or (apart + known <= allowed).all():
            return bool((apart <= allowed).all())
        return False if (apart - known > allowed).any() else None


def tolerance(std: Array, digits: int) -> Array:
    """Half a unit of the last of so many digits of each standard uncertainty (7.9.2)."""
    with np.errstate(divide="ignore"):
        place = np.floor(np.log10(std)) - (digits - 1)
    return np.where(std > 0, 0.5 * 10.0**place, 0.0)


def validate(
    refits: Refits,
    first: FirstOrder,
    outcomes: Callable[[Trials, np.random.Generator], Array],
    *,
    digits: int = 1,
    limit: float = 60.0,
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> Validation:
    """Trials until the results have stabilised, or for `limit` seconds.

    `outcomes` makes of trials the numbers (T, q) that are compared with `first`. `digits` of the
    standard uncertainty count as significant.
    """
    began, rng = time.perf_counter(), np.random.default_rng(seed)
    blocks, lost, size = list[Array](), 0, _piece(refits)
    allowed = tolerance(first.std, digits)
    while True:
        pieces = list[Array]()
        while sum(len(piece) for piece in pieces) < BLOCK:
            found = refits.run(size, rng)
            lost += int(np.sum(~found.settled))
            pieces.append(outcomes(found, rng)[found.settled])
            late = time.perf_counter() - began > limit
            if late or not found.settled.any():
                break
        blocks.append(np.concatenate(pieces))
        count = sum(map(len, blocks))
        say(f"{count:,} trials")
        if late or count >= MOST or not len(blocks[-1]):
            break
        if len(blocks) > 1 and (_known_to(blocks) <= allowed[:, None] / FINER).all():
            return _told(first, blocks, lost, time.perf_counter() - began, allowed, stable=True)
    return _told(first, blocks, lost, time.perf_counter() - began, allowed, stable=False)


def _piece(refits: Refits) -> int:
    """Trials between two looks at the clock: about a million samples."""
    samples = sum(map(len, refits.problem.runs))
    return max(10, min(BLOCK, math.ceil(1_000_000 / samples)))


def _summary(values: Array) -> Array:
    """Mean, standard deviation and both ends of the 95 % interval of each number, (q, 4)."""
    ends = np.quantile(values, ENDS, axis=0)
    return np.stack([values.mean(axis=0), values.std(axis=0, ddof=1), *ends], axis=1)


def _known_to(blocks: Sequence[Array]) -> Array:
    """Twice the standard deviation of each summary over the blocks, (q, 4) (7.9.4)."""
    if len(blocks) < 4:  # of a few blocks that would be chance: parts of them
        whole = np.concatenate(blocks)
        blocks = np.array_split(whole, min(20, max(len(whole) // 200, 2)))
    each = np.stack([_summary(block) for block in blocks])
    return np.asarray(2 * each.std(axis=0, ddof=1) / np.sqrt(len(each)))


def _told(
    first: FirstOrder,
    blocks: Sequence[Array],
    lost: int,
    seconds: float,
    allowed: Array,
    stable: bool,
) -> Validation:
    whole = np.concatenate(blocks)
    if len(whole) < 2:
        whole = np.full((2, len(first.names)), np.nan)
        known = np.full((len(first.names), 4), np.inf)
    else:
        known = _known_to(blocks)
    found = _summary(whole)
    reach = first.values[:, None] + np.outer(first.half, [-1.0, 1.0])
    return Validation(
        first,
        sum(map(len, blocks)) + lost,
        lost,
        seconds,
        stable,
        found[:, 0],
        found[:, 1],
        found[:, 2:],
        allowed,
        np.abs(found[:, 2:] - reach),
        known[:, 2:],
    )


def halves(std: Array, freedom: Array) -> Array:
    """Half widths of 95 % intervals from standard uncertainties and degrees of freedom (G.3)."""
    most = 1_000_000
    return np.array([s * half_width(int(min(f, most))) for s, f in zip(std, freedom, strict=True)])
