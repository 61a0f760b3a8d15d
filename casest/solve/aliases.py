"""Evenly spaced rows cannot tell a rate from others that turn whole turns more between two rows."""

from __future__ import annotations

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.problem import Point, Problem
from casest.solve.outcome import Outcome
from casest.solve.reach import periodic_arguments
from casest.solve.trust_region import LITTLE, trust_region

#: Rows are even when their distances are multiples of one to this share of it, of which the median
#: distance is no more than twice.
EVEN, HOLES = 1e-6, 2.0


def periods(problem: Problem, point: Point) -> dict[int, float]:
    """For every unknown that sets a rate on even rows: the change of it that no row can see."""
    found = {}
    for j, slope in periodic_arguments(problem, point):
        distance = _even(slope)
        if distance is not None:
            found[j] = 2 * np.pi / distance
    return found


def _even(slope: Array) -> float | None:
    """The distance of which all distances are multiples, where there is one."""
    places = np.unique(slope)
    gaps = np.diff(places)
    gaps = gaps[gaps > EVEN * np.ptp(places)]
    if len(gaps) < 3 or np.ptp(places) <= EVEN * np.abs(places).max():
        return None
    least = float(gaps.min())
    distance = float(np.ptp(places) / np.round(np.ptp(places) / least))
    multiples = (places - places[0]) / distance
    even = np.abs(multiples - np.round(multiples)).max() <= EVEN * multiples[-1]
    return distance if even and np.median(gaps) <= HOLES * distance else None


def folded(problem: Problem, first: Point, best: Outcome) -> list[Outcome]:
    """The best solution at the slowest rates that predict the same, and phases next to the start.

    Empty where it is that already.
    """
    lower, upper = problem.bounds
    x, phases = best.point.x.copy(), []
    rates = periods(problem, best.point)
    for j, slope in periodic_arguments(problem, best.point):
        period, middle = rates.get(j), 0.0
        if np.ptp(slope) <= EVEN * np.abs(slope).max() and slope[0]:
            period, middle = 2 * np.pi / abs(float(slope[0])), float(first.x[j])
            phases.append((j, period))
        if period is not None:
            there = x[j] - period * np.round((x[j] - middle) / period)
            x[j] = there if lower[j] <= there <= upper[j] else x[j]
    if np.array_equal(x, best.point.x):
        return []
    starts = [Point(x, best.point.references)]
    for j, period in phases:  # another rate may begin with another phase
        for quarter in (0.25, 0.5, -0.25):
            turned = x.copy()
            turned[j] += quarter * period
            starts.append(Point(problem.inside(turned), best.point.references))
    nearest = min(starts, key=problem.cost)
    return [trust_region(problem, nearest, damping=LITTLE)]


def without_turns(problem: Problem, point: Point, like: Point) -> Array:
    """Unknowns (n,) with their phases within half a turn of those of another point."""
    x = point.x.copy()
    for j, slope in periodic_arguments(problem, point):
        if np.ptp(slope) <= EVEN * np.abs(slope).max() and slope[0]:
            period = 2 * np.pi / abs(float(slope[0]))
            x[j] -= period * np.round((x[j] - like.x[j]) / period)
    return x


def others(problem: Problem, point: Point) -> list[str]:
    """Rates that predict the same on these rows and lie within the bounds, in words."""
    lower, upper = problem.bounds
    return [
        f"`{problem.names[j]}` ± {period:.6g}"
        for j, period in periods(problem, point).items()
        if "." not in problem.names[j]  # an effect's frequency is that of the line that was seen
        if lower[j] <= point.x[j] - period or point.x[j] + period <= upper[j]
    ]
