"""On which axes an effect is something: the others stay as declared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.levels import SURVIVES
from casest.effects.on_axes import axis_name
from casest.estimate.calibrate import Estimate
from casest.leastsquares.problem import Point, Problem

#: A parameter within so many standard deviations of null is nothing.
NOTHING = 2.0
#: For each way to leave axes away: unknowns fewer, squares more.
Ways = tuple[tuple[int, float], ...]


def living_axes(score: Score, model: Model) -> list[int] | None:
    """Axes on which the effect changes anything of its own; None for all, or if it has no axes.

    Where the declared parameters imitate it on all axes together (a delay: a phase), as many axes
    as are left to be determined, the plainest ones.
    """
    own = score.candidate.parameters(score.candidate.added_to(model))
    size = axes_of(own)
    if not size or len(score.survives) != size * len(own):
        return None
    alive = score.survives.reshape(len(own), size).max(axis=0) > SURVIVES
    if len(own) == 1 and score.freedom < alive.sum():
        alive = np.isin(np.arange(size), pivots(score.information, score.freedom))
    return in_part(alive)


def pivots(information: Array, count: int) -> list[int]:
    """Unknowns that are determined beside each other: the largest pivots of Cholesky's factor."""
    left, chosen = information.copy(), []
    for _ in range(count):
        k = int(np.argmax(np.diag(left)))
        chosen.append(k)
        left -= np.outer(left[:, k], left[k]) / left[k, k]
    return chosen


def significant_axes(candidate: Candidate, estimate: Estimate) -> list[int] | None:
    """Axes on which any parameter of the effect is beyond NOTHING standard deviations.

    None where all are, or where the effect is no matter of axes.
    """
    own = [p for p in candidate.parameters(estimate.model) if p.shape.dims]
    size = axes_of(own)
    if not size:
        return None
    z = np.zeros(size)
    for p in own:
        with np.errstate(all="ignore"):
            z = np.maximum(z, np.abs(estimate.values[p.name] / estimate.std[p.name]))
    return in_part(z > NOTHING)


def axes_of(own: Sequence[Parameter]) -> int:
    """How many axes the parameters have, one number each; 0 where that is no matter of axes."""
    vectors = all(p.shape.kind == "array" and len(p.shape.dims) == 1 for p in own)
    sizes = {p.shape.size for p in own}
    per_run = any(p.scope == "run" for p in own)
    return 0 if not vectors or per_run or len(sizes) != 1 else next(iter(sizes))


def in_part(kept: Any) -> list[int] | None:
    """Where it is true, unless that is everywhere or nowhere."""
    return [int(i) for i in np.flatnonzero(kept)] if 0 < np.sum(kept) < len(kept) else None


def narrowed(
    values: Mapping[str, Array], candidate: Candidate, model: Model, kept: list[int]
) -> dict[str, Array]:
    """Values of the restricted effect's unknowns, from those of the whole one in the model."""
    own = model.unknowns_of(candidate.label)
    found: dict[str, Array] = {}
    for name, value in values.items():
        if name not in own or np.ndim(value) != 1:
            found[name] = value
            continue
        for i in kept:
            found[f"{name}_{axis_name(i, len(value))}"] = np.asarray(value[i])
    return found


def lighter(problem: Problem, point: Point, own: Sequence[Parameter], noise: float) -> Ways:
    """What some axes of an effect less would save and cost: unknowns, and squares in σ² (Wald)."""
    axes = _unknowns_by_axis(problem, own)
    if len(axes) < 2:
        return ()
    matrix = problem.normal(point).matrix
    scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    covariance = noise**2 * np.linalg.pinv(matrix / np.outer(scale, scale), hermitian=True)
    x, ways = point.x * scale, []
    for count in range(1, len(axes)):
        for left in combinations(axes.values(), count):
            k = [i for axis in left for i in axis]
            weight = np.linalg.pinv(covariance[np.ix_(k, k)], hermitian=True)
            ways.append((len(k), float(x[k] @ weight @ x[k])))
    return tuple(ways)


def without_dead(score: Score, problem: Problem, point: Point, own: Sequence[Parameter]) -> Score:
    """The score without the axes on which the fitted effect changes nothing.

    A limit that was looked for on all axes may end where only some of them reach it.
    """
    axes = _unknowns_by_axis(problem, own)
    slopes = np.diag(problem.normal(point).matrix)
    dead = [name for name, unknowns in axes.items() if not np.any(slopes[unknowns])]
    size = axes_of(score.candidate.parameters(score.candidate.added_to(_bare(problem.model))))
    if not dead or len(dead) == len(axes) or not size:
        return score
    survives = score.survives.reshape(-1, size).copy()
    survives[:, [k for k in range(size) if axis_name(k, size) in dead]] = 0.0
    return replace(score, survives=survives.ravel())


def _bare(model: Model) -> Model:
    return replace(model, effects=model.effects[:-1])


def _unknowns_by_axis(problem: Problem, own: Sequence[Parameter]) -> dict[str, list[int]]:
    """Which unknowns of an effect belong to each axis, by its name."""
    axes: dict[str, list[int]] = {}
    for slot in problem.slots:
        p = slot.parameter
        if p.name not in {q.name for q in own}:
            continue
        if axes_of([p]):
            for i in range(p.shape.size):
                axes.setdefault(axis_name(i, p.shape.size), []).append(slot.x.start + i)
        elif "_" in p.name.rpartition(".")[2] and not p.shape.dims:  # on one axis already
            axes.setdefault(p.name.rpartition("_")[2], []).append(slot.x.start)
    return axes
