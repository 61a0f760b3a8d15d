"""Solutions that are one and the same function of the inputs under other names.

sin(wx + p) with −w and π − p, two equal terms exchanged: no data tell them apart, for there is
nothing to tell. An alias, which agrees on these rows only, is another solution.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import reached_signals
from casest.leastsquares.problem import Point, Problem
from casest.solve.outcome import Outcome

#: Length of the difference of two predictions, in standard deviations of the noise.
SAME = 0.1
#: And root mean square as a share of the readings, where there is no noise.
EXACT = 1e-7


def between_rows(problem: Problem, seed: int = 0) -> Problem:
    """The problem with its inputs moved off the rows, by up to the mean distance of two.

    Differential equations are read at times between the rows.
    """
    model, rng = problem.model, np.random.default_rng(seed)
    if model.traced.integrates:
        return Problem(model, tuple(_later(run, rng) for run in problem.runs))
    assert model.traced.predicted is not None
    read = reached_signals(model, model.traced, model.traced.predicted) - {model.traced.measured}
    runs = []
    for run in problem.runs:
        moved = dict(run.signals)
        for name in read:
            values = np.asarray(run.signals[name], dtype=float)
            gap = np.ptp(values, axis=0) / max(len(run), 1)
            moved[name] = values + gap * rng.uniform(-1, 1, values.shape)
        runs.append(replace(run, signals=moved))
    return Problem(model, tuple(runs))


def _later(run: Run, rng: np.random.Generator) -> Run:
    """The run with every row but the last at some time before the next."""
    time = np.asarray(run.time, float)
    gaps = np.diff(time, append=time[-1])
    return replace(
        run, time=time + rng.uniform(0.1, 0.9, len(time)) * gaps, whole=None, places=None
    )


def same_on(where: Problem, a: Point, b: Point, limit: float) -> bool:
    """Do two points predict the same there, to a limit (root mean square)?"""
    pairs = zip(where.residuals(a), where.residuals(b), strict=True)
    away = np.concatenate([(p - q).ravel() for p, q in pairs])
    away = away[np.isfinite(away)]
    return bool(away.size and np.sqrt(np.mean(away**2)) <= limit)


def limit_of(problem: Problem, best: Outcome) -> float:
    """Below this (root mean square) two predictions of all rows are the same solution's."""
    measured = problem.model.traced.readings
    readings = np.concatenate(
        [run.signals[name].ravel() for run in problem.runs for name in measured]
    )
    count = problem.residual_count
    sigma = np.sqrt(2 * best.cost / max(count - problem.unknowns, 1))
    return float(max(SAME * sigma / np.sqrt(count), EXACT * np.nanstd(readings)))


def roughness(problem: Problem, moved: Problem, point: Point) -> float:
    """How much predictions change from the rows to between them: of aliases, the least is meant."""
    both = zip(_predicted(problem, point), _predicted(moved, point), strict=True)
    return float(sum(np.nansum((p - q) ** 2) for p, q in both))


def _predicted(problem: Problem, point: Point) -> list[Array]:
    return [v[0] for v in problem.evaluate(point, {"p": problem.model.along.predicted})]
