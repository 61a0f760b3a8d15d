"""The loop: fit, look at the residual, add the best candidate, judge it on held-out data, again."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import RANDOM_WALK, TAILS, Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate, Skipped, candidates
from casest.diagnose.candidates.grid import on_grid
from casest.diagnose.candidates.score_test import Score, scores, steadied, widened
from casest.diagnose.closing import Closing
from casest.diagnose.formula.fit import formula_instead, try_formula
from casest.diagnose.noise.noise_model import wander_of
from casest.diagnose.noise.tails import outliers_p_value
from casest.diagnose.selection.acceptance import accepted
from casest.diagnose.selection.backward_elimination import (
    backward_eliminated,
    certified,
    on_all_axes,
)
from casest.diagnose.selection.cross_validation import Folds, rms, undetermined
from casest.diagnose.selection.expected_loss import hangs_on_which, leave_open, note_walk, rivals
from casest.diagnose.selection.found import HELD_OUT_DATA, Found, Undecided
from casest.diagnose.selection.hypothesis_test import CHANCE, hypothesis_test, note_unseen
from casest.diagnose.selection.model_evidence import (
    FALSE_ALARM,
    SMALL,
    STRONG,
    Fitted,
    as_good,
    confirmed_by_flips,
    least_loss_first,
    not_told_apart,
    with_rivals,
)
from casest.diagnose.selection.random_walk import is_random_walk
from casest.diagnose.selection.refit import refitted, whole
from casest.diagnose.selection.state import Step, Work
from casest.diagnose.selection.swap import swapped
from casest.effects import CATALOGUE
from casest.effects.noise import bias_wander
from casest.effects.placing import prepared
from casest.engine.kernel import only_tried
from casest.engine.threads import one_thread
from casest.errors import CasestError, DataError, NotTrusted
from casest.estimate.calibrate import Estimate, attempt
from casest.leastsquares.problem import Point, Problem

#: Columns of the widest model that is evaluated at once.
WIDEST = 120
#: Share of the false alarms allowed for a cause beside one that was added before.
BESIDE = 0.1
#: Rounds at most.
ROUNDS = 8


def close(
    model: Model,
    runs: Sequence[Run],
    *,
    catalogue: Sequence[Effect] = CATALOGUE,
    start: Mapping[str, Any] | None = None,
    known: Collection[str] = (),
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> Closing:
    """Fit, trace the residual to effects of the catalogue, add those that held-out data confirm.

    Where several causes explain the data alike, those that are `known` to be there come first: by
    name, or as `temperature_bias(temp)`. Where nothing can be held out, nothing is added, and
    `refused` says so. Raises NotTrusted, with the refused estimate, where the declared model itself
    has no trustworthy fit.
    """
    before = attempt(model, runs, start=start, seed=seed)
    if not before.certificate.trusted:
        error = NotTrusted("no trustworthy estimate: " + "; ".join(before.certificate.reasons))
        error.estimate = before
        raise error
    with np.errstate(all="ignore"), one_thread(), only_tried():
        try:
            work = Work(before, prepared(model, runs), catalogue, seed, say, known)
        except DataError as error:
            return _as_it_is(before, prepared(model, runs), str(error))
        return _closed(work)


def _as_it_is(before: Estimate, runs: tuple[Run, ...], why: str) -> Closing:
    """The declared model, where nothing can be held out to judge another by."""
    nothing = tuple(np.full((len(run), len(before.model.axes)), np.nan) for run in runs)
    folds = Folds(tuple(np.zeros(len(r), dtype=np.int_) for r in runs),
                  tuple(np.zeros(1, dtype=np.int_) for _ in runs), 0)  # fmt: skip
    refused = (Skipped(HELD_OUT_DATA, why),)
    return Closing(before, before, nothing, nothing, (), (), refused, folds, (), (), runs)


def _closed(work: Work) -> Closing:
    """Run the loop."""
    current = work.crossed(work.fitted(work.before.model, work.before.values))
    if current is None:
        raise NotTrusted("no part of the record can be predicted from the rest of it")
    first, first_scores = current, None
    declared: Fitted | None = None
    ranked: list[Score] = []
    for _ in range(ROUNDS):
        current = _without_outliers(work, current)
        work.walks, work.untrusted, work.undecided = [], [], None  # of this round
        ranked = _ranked(work, current)
        if first_scores is None:
            note_unseen(work, ranked)
        first_scores, declared = first_scores or ranked, declared or current
        better = _better(work, current, ranked)
        if better is None and work.undecided is None:
            better = _hypothesised(work, current, ranked) or try_formula(work, current)
        if better is None:
            better = formula_instead(work, declared, current, partial(_complete, work))
        if better is None:
            break
        current = better
    else:
        ranked = _ranked(work, current)
    last = current
    current = backward_eliminated(work, on_all_axes(work, current))
    if current is last:
        current = swapped(work, current)
    if current is not last:
        ranked = _ranked(work, current)
    current, after = certified(work, current)
    _note_wander(work, current)
    added = {f.candidate.label for f in work.found}
    return Closing(
        work.before,
        after,
        first.held_out,
        current.held_out,
        tuple(work.found),
        tuple(work.skipped),
        tuple(r for r in work.refused if r.name not in added),
        work.folds,
        tuple(ranked),
        tuple(first_scores or ()),
        work.runs,
        current.noise,
        work.undecided,
    )


def _ranked(work: Work, current: Fitted) -> list[Score]:
    """Every candidate's score, the most significant first."""
    found, skipped = candidates(current.model, work.runs, work.catalogue)
    if not work.skipped:
        work.skipped = skipped
    problem = Problem(current.model, work.runs)
    readings = _readings(problem, problem.point(current.values))
    work.original |= {c.label: c for c in found}
    expanded = on_grid(found, work.runs, current.residuals, readings, current.noise)
    ranked: list[Score] = []
    known = work.before.noise.repeats
    for part in _parts(expanded, WIDEST // max(len(current.model.axes), 1)):
        try:
            wide = widened(current.model, work.runs, current.values, part)
            ranked += scores(wide, part, current.noise, work.folds.batches, known)
        except CasestError as error:
            work.refused += [Skipped(c.label, str(error)) for c in part]
    ranked = steadied(ranked)
    return sorted(ranked, key=lambda s: (s.p_value, -s.gain / max(s.inflation, 1.0)))


def _better(work: Work, current: Fitted, ranked: list[Score]) -> Fitted | None:
    """The model with the best candidate that held-out data confirm; None if none does."""
    limit = _limit(ranked, _sternness(work))
    significant = [s for s in ranked if s.p_value <= limit]
    confirmed = confirmed_by_flips(significant, ranked)
    if significant and not confirmed:
        work.refuse(significant[0].candidate, "no more than noise that is not alike everywhere")
    if not confirmed:
        return None
    tried = refitted(work, current, with_rivals(confirmed, ranked), ranked)
    found = _first_accepted(work, current, tried, limit)
    if found is not None or work.undecided is not None:
        return found
    return _two_at_once(work, current, [pair for pair in tried if pair[0].p_value <= limit])


def _hypothesised(work: Work, current: Fitted, ranked: list[Score]) -> Fitted | None:
    """The model with what the user asks for, if the data and held-out data do not deny it."""
    tried, limit = hypothesis_test(work, current, ranked, CHANCE * _sternness(work))
    return _first_accepted(work, current, tried, limit) if tried else None


def _first_accepted(
    work: Work, current: Fitted, tried: list[tuple[Score, Fitted]], limit: float
) -> Fitted | None:
    """The model with the best of those that are significant and that held-out data confirm."""
    for score, fitted in least_loss_first(tried, work.folds, work.known):
        if score.p_value > limit:
            continue  # It may be the cause as well, but speaks for itself too softly.
        best = tried[0]
        if fitted is not best[1] and not not_told_apart(best[1], fitted, best[0], work.folds):
            break  # What explains the data clearly less well is not the cause.
        if is_random_walk(work.runs, current, fitted, score):
            work.refuse(score.candidate, "an offset that walks at random explains it as well")
            note_walk(work, current, score, fitted)
            continue
        passed = accepted(work, current, score, fitted)
        if passed is None:
            continue
        step = Step(current, score, fitted, tried, passed[2] / passed[0].noise ** 2)
        near = as_good(tried, work.folds, STRONG)
        known = score.candidate.among(work.known)
        if step.share < SMALL and not known and hangs_on_which(work, fitted, near):
            leave_open(work, step, near)
            return None
        work.last = None if known else step
        work.keep(*passed, score, rivals(work, fitted, score, tried))
        return passed[0]
    return None


def _two_at_once(work: Work, current: Fitted, tried: list[tuple[Score, Fitted]]) -> Fitted | None:
    """The best that was tried with the best beside it, if both together are confirmed.

    In few poses, what a second cause leaves can hide the gain of the first.
    """
    if not tried:
        return None
    score, first = tried[0]
    if undetermined(Problem(first.model, work.runs), first.values):
        return None
    refused = list(work.refused)
    ranked = _ranked(work, first)
    limit = _limit(ranked, BESIDE)
    beside = [s for s in ranked if s.p_value <= limit]
    best = refitted(work, first, beside, ranked) if beside else []
    both = _first_accepted(work, current, best, limit)
    if both is None:
        work.refused, work.undecided = refused, None
        return None
    alike = rivals(work, first, score, tried)
    candidate, second = whole(work, score, current.model), work.found.pop()
    work.last = None
    work.keep(both, candidate, second.gain, score, alike)
    work.found.append(second)
    label = candidate.label
    work.refused = [r for r in work.refused if r.name not in (label, second.candidate.label)]
    return both


def _without_outliers(work: Work, current: Fitted) -> Fitted:
    """With the effect `outliers` where there are some: they would pull what follows."""
    effect = next((e for e in work.catalogue if e.seen_in == TAILS), None)
    if effect is None or any(a.label == effect.name for a in current.model.effects):
        return current
    problem = Problem(current.model, work.runs)
    levels = _readings(problem, problem.point(current.values))
    p_value = outliers_p_value(current.residuals, work.folds.batches, levels)
    if p_value is None:
        return current
    fitted = work.crossed(work.fitted(current.model.with_effect(effect), current.values))
    if fitted is None or not work.certified(fitted).certificate.trusted:
        return current
    gained = work.gain(current, fitted)[0]
    work.found.append(Found(Candidate(effect), None, p_value, gained))
    work.say(f"{effect.name}: they count less from here on")
    return fitted


def _note_wander(work: Work, current: Fitted) -> None:
    """Say that the offset wanders: a property of the noise, which changes no fit."""
    effect = next((e for e in work.catalogue if e.seen_in == RANDOM_WALK), None)
    p_value = wander_of(work.runs, current.residuals)
    if p_value is None and work.walks and work.undecided is None:
        # It is no noise either, by which the offset would be known to wander.
        names = [name for walk in work.walks for name in walk.names]
        share = max(walk.share for walk in work.walks)
        work.undecided = Undecided((*dict.fromkeys(names), (effect or bias_wander).name), share)
    if effect is not None and p_value is not None:
        work.found.append(Found(Candidate(effect), None, p_value, 0.0))


def _readings(problem: Problem, point: Point) -> list[Array] | None:
    """What the model predicts, (N, m) per run; None for an implicit model."""
    predicted = problem.model.traced.predicted
    if predicted is None or problem.sequential:
        return None
    return [v[0][:, :, 0] for v in problem.evaluate(point, {"p": predicted})]


def _parts(found: Sequence[Candidate], size: int) -> list[list[Candidate]]:
    return [list(found[k : k + size]) for k in range(0, len(found), size)]


def _complete(work: Work, fitted: Fitted) -> bool:
    """Would nothing be significant beside it?"""
    ranked = _ranked(work, fitted)
    return all(s.p_value > _limit(ranked, BESIDE) for s in ranked)


def _sternness(work: Work) -> float:
    """Share of the usual chance that a cause may have.

    What was added before was chosen by the same data, and may be only nearly right: a cause beside
    it must be the clearer.
    """
    return BESIDE if any(f.names for f in work.found) else 1.0


def _limit(ranked: Sequence[Score], share: float = 1.0) -> float:
    """The p-value up to which a candidate is significant, beside all others."""
    return share * FALSE_ALARM / max(len({s.candidate.label for s in ranked}), 1)


__all__ = ["Closing", "Found", "close", "rms"]
