"""Differential equations fitted to the beginning of their records first, then to more and more.

Over a short time even a wrong trajectory is near the right one, and a cost has one valley; what is
learnt there is enough to follow the next part of the record (Voss, Timmer & Kurths 2004, "initial
value" with a growing horizon).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from casest.leastsquares.flow import GivenUp, for_seconds, left
from casest.leastsquares.problem import Point, Problem
from casest.solve.outcome import Outcome
from casest.solve.trust_region import LITTLE, slight, trust_region

#: What this way is called.
ALONG = "growing horizon"
#: Each part of the record over the one before; rows of the first for each unknown; its share of
#: the record at least.
GROWTH, ROWS, LEAST = 1.4, 3, 0.01
#: Steps on each part but the last, and gain over cost that is not worth a step.
STEPS, GAIN = 30, 1e-6
#: Gain, in those that are slight, which is about a tenth of a part's standard deviations: no nearer
#: can it say where the next begins.
ROUGHLY = 1e4
#: Processor time after which it is given up.
SECONDS = 300.0


def grown(problem: Problem, start: Point, tolerance: float = 0.0) -> Outcome:
    """Where a trust region ends that has followed the records from their beginnings.

    `tolerance` as there: with one the last digits are left to who wants them, and those of parts.

    Where equations are so stiff that this takes longer than SECONDS, the best point until then.
    """
    began, point, count = time.perf_counter(), start, 0
    try:
        with for_seconds(SECONDS):
            for part in _parts(problem):
                gain = max(GAIN, ROUGHLY * slight(part)) if tolerance else GAIN
                found = trust_region(part, point, max_iterations=STEPS, tolerance=gain,
                                     wary=count == 0)  # fmt: skip
                count += found.iterations
                if np.isfinite(found.cost):
                    point = found.point
            found = trust_region(
                problem, point, max_iterations=100, tolerance=tolerance, damping=LITTLE
            )
    except GivenUp:
        if left() <= 0:  # the time of all ways together is over
            raise
        cost = problem.cost(point)
        found = Outcome("", point, cost, 0, 1, False, f"given up after {SECONDS:g} s", 0.0)
    return replace(
        found,
        solver=ALONG,
        iterations=found.iterations + count,
        seconds=time.perf_counter() - began,
    )


def _parts(problem: Problem) -> Iterator[Problem]:
    """The problem on longer and longer beginnings of its runs, all but the whole."""
    longest = max(map(len, problem.runs))
    needed = ROWS * max(len(problem.seen(r)[0]) for r in range(len(problem.runs)))
    rows = max(needed / len(problem.model.axes), LEAST * longest)
    while rows < longest:
        yield problem.beginning(int(np.ceil(rows)))
        rows *= GROWTH
