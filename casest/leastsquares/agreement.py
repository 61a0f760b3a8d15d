"""Do several runs agree on the parameters that they share?

A run that prefers other values pulls on the pooled fit: its own gradient there is not zero. The
score test needs no refit: with gradient g and matrix H of one run at the pooled optimum, letting it
have values of its own would lower twice its cost by gᵀH⁻¹g, which noise alone makes as large as its
number of shared parameters. (Pedersini compares the scatter of repeated spins with the expected one
in his eqs. 36-37; this is the test of it.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.problem import Point, Problem


@dataclass(frozen=True)
class Scatter:
    """Scatter between runs over that expected from the noise within them (F), and what sticks out.

    `worst` names the unknown and the run that differ most, by `away` standard deviations; `share`:
    of all squares, that runs would take away which had values of their own.
    """

    F: float
    freedom: tuple[float, float]
    p_value: float
    worst: str
    away: float
    share: float


def between_runs(problem: Problem, point: Point, correlated_over: float = 1.0) -> Scatter | None:
    """F test of shared parameters being the same in all runs; None where there is nothing shared.

    Correlated residuals count as fewer. First order: exact for linear models.
    """
    shared = {i for s in problem.slots if s.run is None for i in range(s.x.start, s.x.stop)}
    if len(problem.runs) < 2 or not shared:
        return None
    gains, steps = 0.0, []
    for indices, normal in problem.run_normals(point):
        scale = np.sqrt(np.where(np.diag(normal.matrix) > 0, np.diag(normal.matrix), 1.0))
        inverse = np.linalg.pinv(
            normal.matrix / np.outer(scale, scale), rcond=1e-10, hermitian=True
        )
        step = -inverse @ (normal.gradient / scale)
        gains += float(-step @ (normal.gradient / scale))
        spread = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
        steps.append((indices, step / spread))
    extra = (len(problem.runs) - 1) * len(shared)
    left = problem.residual_count - problem.unknowns - extra
    within = 2 * problem.cost(point) - gains
    if left <= 0 or not within > 0:
        return None
    variance = within / left
    F = gains / extra / variance / correlated_over
    freedom = float(extra), left / correlated_over
    worst, away = _worst(problem, steps, shared, float(np.sqrt(variance * correlated_over)))
    return Scatter(F, freedom, _tail(F, *freedom), worst, away, gains / (gains + within))


def _worst(
    problem: Problem,
    steps: list[tuple[Any, Array]],
    shared: set[int],
    sigma: float,
) -> tuple[str, float]:
    found = [
        (abs(float(z)) / sigma, f"`{problem.names[i]}` in {problem.runs[r].name}")
        for r, (indices, step) in enumerate(steps)
        for i, z in zip(indices, step, strict=True)
        if int(i) in shared
    ]
    away, words = max(found)
    return words, away


def _tail(F: float, first: float, second: float) -> float:
    from scipy.special import fdtrc

    return float(fdtrc(first, second, F))
