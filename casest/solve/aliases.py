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


def folded(problem: Problem, best: Outcome) -> list[Outcome]:
    """The best solution at the slowest rates that predict the same, where its own are others."""
    lower, upper = problem.bounds
    x, turned = best.point.x.copy(), False
    for j, period in periods(problem, best.point).items():
        slow = x[j] - period * np.round(x[j] / period)
        if slow != x[j] and lower[j] <= slow <= upper[j]:
            x[j], turned = slow, True
    if not turned:
        return []
    starts = [Point(x, best.point.references)]
    for j in {j for j, slope in periodic_arguments(problem, best.point) if not np.ptp(slope)}:
        for quarter in (1, 2, 3):
            there = x.copy()
            there[j] += quarter * np.pi / 2
            starts.append(Point(problem.inside(there), best.point.references))
    nearest = min(starts, key=problem.cost)
    return [trust_region(problem, nearest, damping=LITTLE)]


def others(problem: Problem, point: Point) -> list[str]:
    """Rates that predict the same on these rows and lie within the bounds, in words."""
    lower, upper = problem.bounds
    return [
        f"`{problem.names[j]}` ± {period:.6g}"
        for j, period in periods(problem, point).items()
        if lower[j] <= point.x[j] - period or point.x[j] + period <= upper[j]
    ]
