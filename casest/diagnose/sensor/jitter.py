"""A fit with noise added to what its model reads beside the reading: an input is recorded too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.slopes import slopes
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import Trial
from casest.diagnose.levels import LEVELS
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.rows import Rows, instant
from casest.errors import CasestError
from casest.leastsquares.kinds import noises
from casest.leastsquares.per_sample import slope_in_sample
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import robust_scale

#: Draws of noise at most: of few rows one says little of its size.
DRAWS = 8
#: Third differences of white noise that say no more than one that stands alone: 1 + 2 Σ ρ².
ALIKE = 1 + 2 * (15**2 + 6**2 + 1) / 20**2
#: Chance that the noise of few rows is less than the bound that is taken.
SURE = 0.95
Draw = tuple[Linear, Mapping[int, Array]]


def jittered(rows: Rows, fit: Fit, trials: Sequence[Trial]) -> list[list[Draw]]:
    """For each input a few draws: the linear problem, and the trials' columns by their identity,
    where the input has as much more noise as would be all of the residual's.

    Of an implicit model each signal may be the one with the noise.
    """
    rng = np.random.default_rng(0)
    return [
        [_draw(rows, fit, trials, name, size, rng) for _ in range(_count(rows))]
        for name, size in _inputs(rows, fit)
    ]


def in_refit(rows: Rows, before: Fit, after: Fit) -> list[list[tuple[Array, Array]]]:
    """For each input a few draws: what such noise adds to the residuals (N, m) of the two fits."""
    rng, found = np.random.default_rng(0), []
    for name, size in _inputs(rows, before):
        draws = [
            tuple(_noisier(r, name, size, rng) for r in rows.runs) for _ in range(_count(rows))
        ]
        found.append([(_added(rows, before, runs), _added(rows, after, runs)) for runs in draws])
    return found


def _count(rows: Rows) -> int:
    return int(np.clip(-(-2 * LEVELS.series // sum(map(len, rows.index))), 1, DRAWS))


def _added(rows: Rows, fit: Fit, runs: tuple[Run, ...]) -> Array:
    """What is added to the weighted residuals (N, m) of a fit by other inputs."""
    problem, point = problem_of(fit, rows.runs)
    noisy = Problem(fit.model, runs)
    more = zip(noisy.residuals(point), problem.residuals(point), strict=True)
    change = [n - r for n, r in more]
    if problem.weights is not None:
        change = [c * np.sqrt(w) for c, w in zip(change, problem.weights, strict=True)]
    return rows.of(change)


def _inputs(rows: Rows, fit: Fit) -> Iterator[tuple[str, float]]:
    """Inputs, and the noise of each that would be all of the residual's."""
    model, traced = fit.model, fit.model.along
    if model.resting or traced.integrates or noises(model):
        return
    plain = instant(fit)
    problem, point = problem_of(plain, rows.runs)
    declared = {s.name for s in model.declared}
    readings = {*traced.readings} if traced.predicted is not None else set()
    squares = dict[str, float]()
    for r in range(len(rows.runs)):
        G = slope_in_sample(plain.model)(problem.parameters(point, r), problem.samples[r])[0]
        first = 0
        for s in plain.model.signals:
            own, first = G[:, :, first : first + s.size], first + s.size
            if s.kind == "plain" and s.name != "t" and s.name in declared - readings:
                squares[s.name] = squares.get(s.name, 0.0) + float(np.sum(own**2))
    ends = np.cumsum([0, *map(len, rows.index)]).tolist()
    spans = rows.linear(fit).spans or [slice(a, b) for a, b in pairwise(ends)]
    residual = rows.linear(fit).residual
    noise = _white(residual, spans, float(np.sqrt(np.mean(residual**2))))
    for name, square in squares.items():
        if np.isfinite(square) and square > 0:
            size = noise * float(np.sqrt(problem.residual_count / square))
            given = rows.of([run.signals[name] for run in rows.runs])
            yield name, _white(given, spans, size)


def _white(values: Array, spans: Sequence[slice], most: float) -> float:
    """The noise of rows by their third differences, in which what is slower has little part, in the
    calmest quarter of the record: elsewhere a quick motion is in them. Of few rows by all of them,
    and as much as it may be.
    """
    from scipy.special import chdtri

    third = [d for span in spans if len(d := np.diff(values[span], 3, axis=0))]
    if sum(map(len, third)) < LEVELS.series:
        squares = np.concatenate(third) ** 2 if third else np.full(1, np.inf)
        noise = np.sqrt(squares.sum() / chdtri(squares.size / ALIKE, SURE) / ALIKE)
    else:
        blocks = [b for d in third for b in np.array_split(d, max(1, len(d) // LEVELS.series))]
        noise = np.quantile([robust_scale([b]) for b in blocks], 0.25)
    return min(most, float(noise) / float(np.sqrt(20)))


def _draw(
    rows: Rows,
    fit: Fit,
    trials: Sequence[Trial],
    name: str,
    size: float,
    rng: np.random.Generator,
) -> Draw:
    runs = tuple(_noisier(run, name, size, rng) for run in rows.runs)
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


def _noisier(run: Run, name: str, size: float, rng: np.random.Generator) -> Run:
    values = run.signals[name]
    noise = size * rng.standard_normal(values.shape)
    return replace(run, signals={**run.signals, name: values + noise})
