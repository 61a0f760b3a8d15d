"""A fit with noise added to what its model reads beside the reading: an input is recorded too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.slopes import slopes
from casest.diagnose.evidence.input_noise import LITTLE
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import Trial
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.of_inputs import noise_like, noise_of_inputs, with_noise
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.rows import Rows
from casest.errors import CasestError
from casest.leastsquares.problem import Point, Problem

#: Draws of noise at most: of few rows one says little of its size.
DRAWS = 8
Draw = tuple[Linear, Mapping[int, Array]]


def jittered(rows: Rows, fit: Fit, trials: Sequence[Trial]) -> list[list[Draw]]:
    """For each input a few draws: the linear problem, and the trials' columns by their identity,
    where the input has LITTLE more of as much noise as would be all of the residual's.

    Of an implicit model each signal may be the one with the noise.
    """
    rng = np.random.default_rng(0)
    return [
        [_draw(rows, fit, trials, name, size, rng) for _ in range(_count(rows))]
        for name, size in _inputs(rows, fit)
    ]


def in_refit(rows: Rows, before: Fit, after: Fit) -> list[list[tuple[float, Array, Array, Array]]]:
    """For each input draws of LITTLE noise and of all: how much, and what it adds to the residuals
    (N, m) of the two fits, and of the first where its unknowns are as in the second."""
    rng, found = np.random.default_rng(0), []
    moved = replace(before, values={**before.values, **before.model.among(after.values)})
    problems = [problem_of(fit, rows.runs) for fit in (before, after, moved)]
    quiet = [problem.residuals(point) for problem, point in problems]
    for name, noise in _inputs(rows, before):
        draws = []
        for size in (LITTLE, 1.0) * _count(rows):
            runs = with_noise(rows.runs, name, noise_like(rows.runs, name, size * noise, rng))
            added = (_added(rows, *p, runs, r) for p, r in zip(problems, quiet, strict=True))
            more, less, plain = added
            draws.append((size, more, less, plain))
        found.append(draws)
    return found


def _count(rows: Rows) -> int:
    return int(np.clip(-(-2 * LEVELS.series // sum(map(len, rows.index))), 1, DRAWS))


def _added(
    rows: Rows, problem: Problem, point: Point, runs: tuple[Run, ...], quiet: Sequence[Array]
) -> Array:
    """What noisy runs add to the weighted residuals (N, m) of a fit, `quiet` without that noise."""
    noisy = Problem(problem.model, runs).residuals(point)
    change = [n - r for n, r in zip(noisy, quiet, strict=True)]
    if problem.weights is not None:
        change = [c * np.sqrt(w) for c, w in zip(change, problem.weights, strict=True)]
    return rows.of(change)


def _inputs(rows: Rows, fit: Fit) -> Iterator[tuple[str, float]]:
    """Inputs, and the noise of each that would be all of the residual's."""
    linear, ends = rows.linear(fit), np.cumsum([0, *map(len, rows.index)]).tolist()
    spans = linear.spans or [slice(a, b) for a, b in pairwise(ends)]
    return noise_of_inputs(*problem_of(fit, rows.runs), linear.residual, spans, rows.of)


def _draw(
    rows: Rows,
    fit: Fit,
    trials: Sequence[Trial],
    name: str,
    size: float,
    rng: np.random.Generator,
) -> Draw:
    runs = with_noise(rows.runs, name, noise_like(rows.runs, name, LITTLE * size, rng))
    whole, _ = problem_of(fit, rows.runs)
    problem = Problem(fit.model, runs)
    if whole.weights is not None:
        problem = problem.with_weights(whole.weights)
    point = problem.point(fit.values)
    residual, J, _ = rows.slopes(problem, point)
    linear = replace(rows.linear(fit), residual=residual, slopes=J)
    found = {
        id(what): columns
        for what, columns in slopes(problem, point, [t.what for t in trials], rows.index)
        if not isinstance(columns, CasestError)
    }
    return linear, {id(t): found[id(t.what)] for t in trials if id(t.what) in found}
