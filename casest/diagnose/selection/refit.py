"""Refit: the most promising candidates refitted, the best explanation first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.declaration.model import Model
from casest.diagnose.candidates.axes import lighter, living_axes
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.grid import at_grid_value, freed_again, grid_value, strides, within
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.selection.expected_loss import apart
from casest.diagnose.selection.model_evidence import (
    Fitted,
    as_promising,
    best_of_each,
    by_evidence,
    cost_of,
)
from casest.diagnose.selection.state import Work
from casest.effects.on_axes import restricted
from casest.errors import CasestError
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import weighted

#: Candidates that are refitted in a round, and those that score as well as the best of them.
REFITTED, MORE = 6, 4
#: Steps of one size that a level or moment may take from where the grid found it; rivals of the
#: best take them too, where they leave at most this share of what it explains.
STRIDES, NEAR = 6, 0.3
#: Steps in a row that explain less, and end the search: between few poses the noise makes valleys.
WORSE = 2


def refitted(
    work: Work, current: Fitted, significant: Sequence[Score], ranked: Sequence[Score]
) -> list[tuple[Score, Fitted]]:
    """The most promising candidates refitted, the best explanation first.

    With them those that may explain as much without being significant: they are not told apart.
    """
    best = best_of_each(significant, current)
    tried = _refitted(work, current, best[:REFITTED])
    if not tried:
        return []
    winner, labels = tried[0][0], {s.candidate.label for s in best}
    rest = [s for s in ranked if s.candidate.label not in labels]
    near = best[REFITTED:] + best_of_each(rest, current)
    near = [s for s in near if s.freedom and as_promising(s, winner)]
    tried += _refitted(work, current, near[:MORE])
    return by_evidence(tried)


def _refitted(work: Work, current: Fitted, chosen: Sequence[Score]) -> list[tuple[Score, Fitted]]:
    tried = [(score, joined(work, current, score)) for score in chosen]
    found = by_evidence([(score, fitted) for score, fitted in tried if fitted is not None])
    if not found:
        return []
    best = found[0] = _sharpened(work, current, *found[0])
    far = NEAR * (cost_of(current) - cost_of(best[1]))
    return [best] + [
        _sharpened(work, current, *pair) if cost_of(pair[1]) - cost_of(best[1]) < far else pair
        for pair in found[1:]
    ]


def _sharpened(work: Work, current: Fitted, score: Score, fitted: Fitted) -> tuple[Score, Fitted]:
    """With the best level or moment near the one that was found: the grid is coarse."""
    held = grid_value(score.candidate)
    if held is None:
        return score, fitted
    name, kind, value = held
    best, steps = (score, fitted), strides(kind, value, work.runs)
    for step in steps:
        for way in (-1, 1):
            at, worse = value, 0
            for _ in range(STRIDES):
                at += way * step
                if not within(kind, at, work.runs, len(current.model.axes)):
                    break
                moved = at_grid_value(score, name, at)
                found = joined(work, current, moved)
                if found is not None and cost_of(found) < cost_of(best[1]):
                    best, value, worse = (moved, found), at, 0
                    continue
                worse += 1
                if worse == WORSE:
                    break
    return best


def joined(work: Work, current: Fitted, score: Score) -> Fitted | None:
    """The model refitted with a candidate, from its first-order step."""
    try:
        candidate = whole(work, score, current.model)
        model = candidate.added_to(current.model)
        problem = Problem(model, work.runs)
        start = problem.point(current.values)
        moved = _stepped(problem, start, candidate, score)
        best = min((start, moved), key=lambda p: _finite(problem.cost(p)))
        fitted = work.fitted(model, problem.values(best))
    except (CasestError, np.linalg.LinAlgError) as error:
        work.refuse(score.candidate, f"its refit fails: {error}")
        return None
    if fitted is None:
        work.refuse(score.candidate, "its refit fails: the residual is not finite")
        return None
    return _weighed(work, current, fitted, candidate)


def _weighed(work: Work, current: Fitted, fitted: Fitted, candidate: Candidate) -> Fitted:
    """With what could be left away of the candidate, and what it does to the others."""
    problem = weighted(Problem(fitted.model, work.runs), fitted.values)
    own = candidate.parameters(fitted.model)
    less = lighter(problem, problem.point(fitted.values), own, fitted.noise)
    moved = apart(work, current, fitted.values, current.values) / fitted.noise**2
    return replace(fitted, lighter=less, moved=moved)


def whole(work: Work, score: Score, model: Model) -> Candidate:
    """The candidate with its profile unknown again, on the axes where it does anything."""
    candidate = freed_again(score.candidate, work.original[score.candidate.label])
    if candidate.effect is None:
        return candidate
    kept = living_axes(score, model)
    if kept is None:
        return candidate
    effect = restricted(candidate.effect, kept, model)
    return replace(candidate, effect=effect, traced=None)


def _finite(cost: float) -> float:
    return cost if np.isfinite(cost) else np.inf


def _stepped(problem: Problem, start: Point, candidate: Candidate, score: Score) -> Point:
    """The start moved by the score's first-order step in the candidate's own unknowns."""
    own = {p.name for p in candidate.parameters(problem.model)} - _frequencies(candidate)
    x, used = start.x.copy(), 0
    for slot in problem.slots:
        if slot.parameter.name in own:
            width = slot.x.stop - slot.x.start
            if used + width <= len(score.step):
                x[slot.x] = x[slot.x] + score.step[used : used + width]
                used += width
    # What the declared parameters had taken over goes back.
    return Point(problem.inside(x), start.references)


def _frequencies(candidate: Candidate) -> set[str]:
    """Its unknowns that were held when it was scored, and are free again."""
    profile = candidate.effect.profile if candidate.effect else ()
    return {f"{candidate.label}.{name}" for name, kind in profile if kind == "frequency"}
