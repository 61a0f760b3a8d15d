"""How differential equations are solved: by ways that do not share each other's valleys.

A cost of integrated equations has many: a trajectory that has lost step fits as badly whichever way
the parameters go. So a fit follows the record from its beginning (`horizon`); the equations as
constraints (`collocation`) are a second way where the record is short, and many beginnings at once
(`shooting`) where what is unstable or chaotic cannot be followed from one; and they begin elsewhere
too where what is known of the noise leaves it open whether something better is left.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.flow import GivenUp, for_seconds, left
from casest.leastsquares.growth import UNSTABLE, growth
from casest.leastsquares.problem import Point, Problem
from casest.solve.collocation import collocated
from casest.solve.horizon import ALONG, grown
from casest.solve.outcome import Outcome
from casest.solve.pace import FASTEST, pace_of, slowed, turning
from casest.solve.shooting import shot
from casest.solve.trust_region import LITTLE, slight, trust_region

#: Rows of all runs up to which collocation is asked in any case.
SHORT = 600
#: Starts of a search, how many are enough where all end alike, and how far they lie: factors of
#: ten, up and down.
STARTS, ENOUGH, DECADES = 16, 6, 1.5
#: Seconds after which a search, another opinion, and IPOPT's part of one are given up, and how many
#: times as much as the way along the record takes, where that is more, up to the longest.
SEARCH, OPINION, COLLOCATED, TIMES, LONGEST = 60.0, 20.0, 4.0, 4.0, 200.0
#: Seconds after which one start of a search is given up, and TIMES as many as those that arrived at
#: the best took, where that is more.
EACH = 0.5
#: Gain of a step that ends a descent of a search, in those that are slight: 0.01 deviations.
NEAR = 100.0
#: Ends whose costs differ by no more than this share are one.
ALIKE = 1e-3


def by_equations(problem: Problem, first: Point) -> tuple[Outcome, ...]:
    """Ways from one start: along the record; from many beginnings where what grows can hardly be
    followed from one; else by collocation where that is quick."""
    found = [grown(problem, first)]
    with suppress(GivenUp), for_seconds(allowed(found, OPINION)):  # else an opinion less
        found += _beside(problem, first, found[0])
    return tuple(found)


def allowed(outcomes: Sequence[Outcome], least: float) -> float:
    """Seconds that may be spent beside the ways along the record among these."""
    usual = max((o.seconds for o in outcomes if o.solver == ALONG), default=0.0)
    return max(least, min(TIMES * usual, LONGEST))


def _beside(problem: Problem, first: Point, along: Outcome) -> list[Outcome]:
    """What other ways lead to, beside that along the record."""
    if max(growth(problem, point) for point in (first, along.point)) > UNSTABLE:
        several = by_shooting(problem, first)
        return [several] if several is not None else []
    short = sum(map(len, problem.runs)) <= SHORT
    return list(by_collocation(problem, first, allowed([along], COLLOCATED))) if short else []


def by_shooting(problem: Problem, first: Point) -> Outcome | None:
    """Where multiple shooting leads, at the optimum of the integrated equations; None where it
    leads nowhere, or the equations are not such."""
    near = shot(problem, first)
    return None if near is None or not np.isfinite(near.cost) else _polished(problem, near)


def by_collocation(problem: Problem, first: Point, seconds: float) -> Iterator[Outcome]:
    """What collocation leads to, at the optimum of the integrated equations, if anywhere."""
    near = collocated(problem, first, seconds)
    if near is None or not np.isfinite(near.cost):
        return
    # What becomes the answer is polished once it is.
    yield _polished(problem, near, slight(problem))


def _polished(problem: Problem, near: Outcome, tolerance: float = 0.0) -> Outcome:
    """The optimum of the integrated equations beside what a way has led to."""
    found = trust_region(problem, near.point, damping=LITTLE, tolerance=tolerance)
    return replace(
        found,
        solver=near.solver,
        iterations=near.iterations + found.iterations,
        seconds=near.seconds + found.seconds,
    )


def from_elsewhere(
    problem: Problem, first: Point, known: Sequence[Outcome], seed: int, seconds: float
) -> tuple[list[Outcome], bool]:
    """Where both ways lead from starts over decades around the first, and: was it given up, the
    seconds being over?

    `known`: where ways have led before. What takes far longer than those that arrived has no end.
    """
    found = list[Outcome]()
    try:
        with for_seconds(seconds):
            for count, start in enumerate(_starts(problem, first, seed), 1):
                found += _ends(problem, start, count, [*known, *found])
                best = min(
                    (*known, *found), key=lambda o: o.cost if np.isfinite(o.cost) else np.inf
                )
                if count == ENOUGH and arrived(best, found) == len(found):
                    break
    except GivenUp:
        return found, True
    return found, False


def _ends(problem: Problem, start: Point, count: int, known: Sequence[Outcome]) -> list[Outcome]:
    """Where a start leads, collocation every fourth of a short record; `known` from before."""
    lowest = min((o.cost for o in known if np.isfinite(o.cost)), default=np.inf)
    there = [o for o in known if o.cost <= lowest * (1 + ALIKE)]
    began = time.perf_counter()
    try:
        with for_seconds(max(EACH, TIMES * max((o.seconds for o in there), default=np.inf))):
            if count % 4 == 0 and sum(map(len, problem.runs)) <= SHORT:
                seconds = min(allowed(there, COLLOCATED), max(left(), 1.0))
                return list(by_collocation(problem, start, seconds))
            return [grown(problem, start, NEAR * slight(problem))]
    except GivenUp:
        if left() <= 0:  # the time of all starts together is over
            raise
    seconds = time.perf_counter() - began
    return [Outcome(ALONG, start, np.inf, 0, 0, False, "given up", seconds)]


def arrived(best: Outcome, others: list[Outcome]) -> int:
    """How many of them ended in the valley of the best."""
    return sum(o.cost <= best.cost * (1 + ALIKE) + 1e-300 for o in others)


def _starts(problem: Problem, first: Point, seed: int) -> Iterator[Point]:
    """Every unknown constant multiplied by a power of ten, one that begins at zero moved by as much
    as changes the residual by its own length; where states begin, data say.

    What would turn faster than rows can follow, and than the first does, is slowed as a whole.
    """
    fastest = max(FASTEST, turning(problem, first)) if pace_of(problem.model) else FASTEST
    rng = np.random.default_rng(seed)
    normal = problem.normal(first)
    size = np.sqrt(2 * normal.cost) / np.sqrt(np.maximum(np.diag(normal.matrix), 1e-300))
    for _ in range(STARTS):
        factor = 10 ** rng.uniform(-DECADES, DECADES, problem.unknowns)
        moved: Array = np.where(
            first.x != 0, first.x * factor, size * rng.standard_normal(problem.unknowns)
        )
        start = Point(problem.inside(np.nan_to_num(moved)), first.references)
        yield slowed(problem, start, fastest)
