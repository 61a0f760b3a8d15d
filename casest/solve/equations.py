"""How differential equations are solved: by ways that do not share each other's valleys.

A cost of integrated equations has many: a trajectory that has lost step fits as badly whichever way
the parameters go. So a fit follows the record from its beginning (`horizon`); the equations as
constraints (`collocation`) are a second way where the record is short, and many beginnings at once
(`shooting`) where what is unstable or chaotic cannot be followed from one; and they begin elsewhere
too where what is known of the noise leaves it open whether something better is left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.growth import UNSTABLE, growth
from casest.leastsquares.problem import Point, Problem
from casest.solve.collocation import collocated
from casest.solve.horizon import grown
from casest.solve.outcome import Outcome
from casest.solve.shooting import shot
from casest.solve.trust_region import LITTLE, trust_region

#: Rows of all runs up to which collocation is asked in any case.
SHORT = 600
#: Starts of a search, how many are enough where all end alike, and how far they lie: factors of
#: ten, up and down.
STARTS, ENOUGH, DECADES = 16, 6, 1.5
#: Ends whose costs differ by no more than this share are one.
ALIKE = 1e-3


def by_equations(problem: Problem, first: Point) -> tuple[Outcome, ...]:
    """Ways from one start: along the record; from many beginnings where what grows can hardly be
    followed from one; else by collocation where that is quick."""
    found = [grown(problem, first)]
    if max(growth(problem, point) for point in (first, found[0].point)) > UNSTABLE:
        several = by_shooting(problem, first)
        return (*found, several) if several is not None else (*found,)
    if sum(map(len, problem.runs)) <= SHORT:
        found += by_collocation(problem, first)
    return tuple(found)


def by_shooting(problem: Problem, first: Point) -> Outcome | None:
    """Where multiple shooting leads, at the optimum of the integrated equations; None where it
    leads nowhere, or the equations are not such."""
    near = shot(problem, first)
    return None if near is None or not np.isfinite(near.cost) else _polished(problem, near)


def by_collocation(problem: Problem, first: Point) -> Iterator[Outcome]:
    """What collocation leads to, at the optimum of the integrated equations, if anywhere."""
    near = collocated(problem, first)
    if near is None or not np.isfinite(near.cost):
        return
    yield _polished(problem, near)


def _polished(problem: Problem, near: Outcome) -> Outcome:
    """The optimum of the integrated equations beside what a way has led to."""
    found = trust_region(problem, near.point, damping=LITTLE)
    return replace(
        found,
        solver=near.solver,
        iterations=near.iterations + found.iterations,
        seconds=near.seconds + found.seconds,
    )


def from_elsewhere(problem: Problem, first: Point, best: Outcome, seed: int) -> list[Outcome]:
    """Where both ways lead from starts over decades around the first."""
    short, found = sum(map(len, problem.runs)) <= SHORT, list[Outcome]()
    for k, start in enumerate(_starts(problem, first, seed)):
        if short and k % 4 == 3:
            found += by_collocation(problem, start)
        else:
            found.append(grown(problem, start))
        if k + 1 == ENOUGH and arrived(best, found) == len(found):
            break
    return found


def arrived(best: Outcome, others: list[Outcome]) -> int:
    """How many of them ended in the valley of the best."""
    return sum(o.cost <= best.cost * (1 + ALIKE) + 1e-300 for o in others)


def _starts(problem: Problem, first: Point, seed: int) -> Iterator[Point]:
    """Every unknown constant multiplied by a power of ten, one that begins at zero moved by as much
    as changes the residual by its own length; where states begin, data say."""
    rng = np.random.default_rng(seed)
    normal = problem.normal(first)
    size = np.sqrt(2 * normal.cost) / np.sqrt(np.maximum(np.diag(normal.matrix), 1e-300))
    for _ in range(STARTS):
        factor = 10 ** rng.uniform(-DECADES, DECADES, problem.unknowns)
        moved: Array = np.where(
            first.x != 0, first.x * factor, size * rng.standard_normal(problem.unknowns)
        )
        yield Point(problem.inside(np.nan_to_num(moved)), first.references)
