"""Solutions that are one and the same function of the inputs under other names.

sin(wx + p) with −w and π − p, two equal terms exchanged: no data tell them apart, for there is
nothing to tell. An alias, which agrees on these rows only, is another solution.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casest.declaration.tracing import reached_signals
from casest.leastsquares.problem import Point, Problem

#: Difference of two predictions between the rows, in standard deviations of the noise.
SAME = 0.1
#: And as a share of the readings, where there is no noise.
EXACT = 1e-6


def between_rows(problem: Problem, seed: int = 0) -> Problem:
    """The problem with its inputs moved off the rows, by up to the mean distance of two."""
    model, rng = problem.model, np.random.default_rng(seed)
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


def same_function(problem: Problem, moved: Problem, a: Point, b: Point, sigma: float) -> bool:
    """Do two points predict the same, on the rows and between them?"""
    measured = problem.model.traced.measured
    readings = np.concatenate([run.signals[measured].ravel() for run in problem.runs])
    limit = max(SAME * sigma, EXACT * float(np.std(readings)))
    for where in (problem, moved):
        away = np.concatenate(
            [(p - q).ravel() for p, q in zip(where.residuals(a), where.residuals(b), strict=True)]
        )
        away = away[np.isfinite(away)]
        if not away.size or np.sqrt(np.mean(away**2)) > limit:
            return False
    return True
