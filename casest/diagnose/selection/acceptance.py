"""Acceptance: what an effect must pass to stay, and the plainest form in which it does."""

from __future__ import annotations

from dataclasses import replace

from casest.diagnose.candidates.axes import narrowed, significant_axes, without_dead
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.grid import grid_value
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.selection.cross_validation import undetermined
from casest.diagnose.selection.model_evidence import Fitted
from casest.diagnose.selection.refit import joined, whole
from casest.diagnose.selection.state import Work
from casest.effects.on_axes import restricted
from casest.errors import CasestError
from casest.estimate.calibrate import Estimate
from casest.leastsquares.problem import Problem


def accepted(
    work: Work, current: Fitted, score: Score, fitted: Fitted
) -> tuple[Fitted, Candidate, float] | None:
    """The fit without needless axes, its candidate and held-out gain; None if refused."""
    crossed = work.crossed(fitted)
    if crossed is None or not work.confirmed(current, crossed):
        work.refuse(score.candidate, "too small to matter here: held-out data do not confirm it")
        return None
    problem = Problem(crossed.model, work.runs)
    why = undetermined(problem, crossed.values)
    if why:
        own = whole(work, score, current.model).parameters(crossed.model)
        less = without_dead(score, problem, problem.point(crossed.values), own)
        again = None if less is score else joined(work, current, less)
        if again is not None:
            return accepted(work, current, less, again)
    estimate = None if why else work.certified(crossed)
    if estimate is not None and not estimate.certificate.trusted:
        why = estimate.certificate.reasons[0]
    if estimate is None or why:
        work.refuse(score.candidate, f"its fit is refused: {why}")
        work.untrusted.append((score, crossed))
        return None
    crossed = replace(crossed, values=estimate.values)
    plain, candidate = _plainer(work, *pruned(work, crossed, estimate, score))
    return plain, candidate, work.gain(current, plain)[0]


def pruned(
    work: Work, fitted: Fitted, estimate: Estimate, score: Score
) -> tuple[Fitted, Candidate]:
    """Without the axes on which the effect is nothing: an axis with nothing in it stays."""
    base = replace(fitted.model, effects=fitted.model.effects[:-1])
    candidate = whole(work, score, base)
    kept = significant_axes(candidate, estimate)
    if kept is None or candidate.effect is None:
        return fitted, candidate
    effect = restricted(candidate.effect, kept, fitted.model)
    smaller = replace(candidate, effect=effect, traced=None)
    values = narrowed(fitted.values, candidate, fitted.model, kept)
    try:
        again = work.crossed(work.fitted(smaller.added_to(base), values))
    except CasestError:
        return fitted, candidate
    if again is None or work.confirmed(again, fitted):
        return fitted, candidate
    return again, smaller


def _plainer(work: Work, fitted: Fitted, candidate: Candidate) -> tuple[Fitted, Candidate]:
    """In the effect's plain form, where held-out data do not want more.

    What was held at a value of its grid is an unknown then.
    """
    effect = work.original[candidate.label].effect
    if effect is None or not effect.plain:
        return fitted, candidate
    held = grid_value(candidate)
    begun = effect.starting(**{held[0]: held[2]}) if held else effect
    smaller = replace(candidate, effect=begun.holding(**dict(effect.plain)), traced=None)
    base, values = fitted.without(candidate.label)
    try:
        again = work.crossed(work.fitted(smaller.added_to(base), values))
    except CasestError:
        return fitted, candidate
    if again is None or work.confirmed(again, fitted):
        return fitted, candidate
    estimate = work.certified(again)
    if not estimate.certificate.trusted:
        return fitted, candidate
    return replace(again, values=estimate.values), smaller
