"""How much noise recorded inputs may have, by what is quick in them: as much as the residual at
most, which it would be part of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from casest.data.run import Run
from casest.data.stillness import resolution
from casest.declaration.effect import OVER_TIME
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.leastsquares.kinds import noises
from casest.leastsquares.per_sample import slope_in_sample
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import robust_scale

#: Third differences of white noise that say no more than one that stands alone: 1 + 2 Σ ρ².
ALIKE = 1 + 2 * (15**2 + 6**2 + 1) / 20**2
#: Chance that the noise of few rows is less than the bound that is taken; standard errors by which
#: that of many may be more than it seems.
SURE, ABOVE = 0.95, 2.0
#: Share of rows that repeat the one before where an input is held, and part of a step.
HELD, HALF = 0.5, 0.5
#: Third differences that say as much of their spread by its median as one without it (the median
#: deviation's efficiency), and the normal deviate of a lower quarter.
BY_MEDIAN, QUARTER = 0.37, 0.674


def noise_of_inputs(
    problem: Problem,
    point: Point,
    residual: Array,
    spans: Sequence[slice],
    of: Callable[[Sequence[Array]], Array] = np.concatenate,
) -> Iterator[tuple[str, float]]:
    """Inputs, and the noise of each that would be all of the residual's.

    `residual` (N, m) and `spans`: of rows that are looked at, as `of` takes them from all; none of
    models whose inputs are no plain signals of a row each.
    """
    if problem.model.resting or problem.model.along.integrates or noises(problem.model):
        return
    model = at_once(problem.model)
    traced, names = model.along, {s.name for s in model.declared}
    readings = {*traced.readings} if traced.predicted is not None else set()
    plain = Problem(model, problem.runs)
    at = plain.point(model.among(problem.values(point)))
    squares = dict[str, float]()
    for r in range(len(plain.runs)):
        G = slope_in_sample(model)(plain.parameters(at, r), plain.samples[r])[0]
        first = 0
        for s in model.signals:
            own, first = G[:, :, first : first + s.size], first + s.size
            if s.kind == "plain" and s.name != "t" and s.name in names - readings:
                squares[s.name] = squares.get(s.name, 0.0) + float(np.sum(own**2))
    noise = _white(residual, spans, float(np.sqrt(np.mean(residual**2))))
    for name, square in squares.items():
        if np.isfinite(square) and square > 0:
            size = noise * float(np.sqrt(plain.residual_count / square))
            values = of([run.signals[name] for run in plain.runs])
            yield name, min(_white(values, spans, size), most_where_held(values))


def most_where_held(values: Array) -> float:
    """The most noise that values (N, k) may have which repeat in half of the rows: half a step of
    them, since noise of more takes a reading to another step. A command is held to its last digit.
    """
    if len(values) < 2 or not np.all(np.mean(np.diff(values, axis=0) == 0, axis=0) > HELD):
        return np.inf
    return HALF * max(resolution(values[:, k]) for k in range(values.shape[1]))


def at_once(model: Model) -> Model:
    """Without what looks at other samples."""
    return replace(model, effects=tuple(a for a in model.effects if a.kind not in OVER_TIME))


def noise_like(
    runs: Sequence[Run], name: str, size: float, rng: np.random.Generator
) -> tuple[Array, ...]:
    """White noise (N, k) of so much for each run of an input."""
    return tuple(size * rng.standard_normal(run.signals[name].shape) for run in runs)


def with_noise(runs: Sequence[Run], name: str, noise: Sequence[Array]) -> tuple[Run, ...]:
    """The runs with noise added to an input."""
    return tuple(
        replace(run, signals={**run.signals, name: run.signals[name] + more})
        for run, more in zip(runs, noise, strict=True)
    )


def _white(values: Array, spans: Sequence[slice], most: float) -> float:
    """The noise of rows by their third differences, in which what is slower has little part, in the
    calmest quarter of the record: elsewhere a quick motion is in them. Of few rows by all of them.
    As much as it may be.
    """
    from scipy.special import chdtri

    third = [d for span in spans if len(d := np.diff(values[span], 3, axis=0))]
    if sum(map(len, third)) < LEVELS.series:
        squares = np.concatenate(third) ** 2 if third else np.full(1, np.inf)
        noise = np.sqrt(squares.sum() / chdtri(squares.size / ALIKE, SURE) / ALIKE)
    else:
        blocks = [b for d in third for b in np.array_split(d, max(1, len(d) // LEVELS.series))]
        noise = np.quantile([robust_scale([b]) for b in blocks], 0.25)
        one, calm = _error(len(blocks[0])), _error(sum(map(len, third)) / 4)
        noise *= (1 + ABOVE * calm) / (1 - QUARTER * one)
    return min(most, float(noise) / float(np.sqrt(20)))


def _error(count: float) -> float:
    """Of the spread of so many third differences by their median, as a share of it."""
    return float(np.sqrt(ALIKE / (2 * BY_MEDIAN * count)))
