"""Hypothesis tests: an effect of the user's own is a hypothesis that was there before the data.

What is asked for is not looked for among all that could be: a chance of 1 % is enough, by the plain
F test of its refit, which in a few poses sees more than a score whose noise the same few poses must
tell. Signs of the noise that are flipped, and held-out data, must confirm it as all else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from casest.declaration.effect import NOISE
from casest.diagnose.candidates.candidates import Skipped
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.selection.model_evidence import (
    Fitted,
    best_of_each,
    confirmed_by_flips,
    cost_of,
)
from casest.diagnose.selection.refit import refitted
from casest.diagnose.selection.state import Work
from casest.effects import shipped
from casest.leastsquares.problem import Problem

#: Chance that any effect that is asked for is called significant where there is none.
CHANCE = 0.01


def hypotheses(work: Work, ranked: Sequence[Score]) -> list[Score]:
    """The user's own effects, and those that he knows to be there."""
    own = {e.name for e in work.catalogue if not shipped(e)} | work.known
    return [s for s in ranked if s.candidate.among(own)]


def hypothesis_test(
    work: Work, current: Fitted, ranked: Sequence[Score], chance: float = CHANCE
) -> tuple[list[tuple[Score, Fitted]], float]:
    """What is asked for, refitted, beside what explains as much; and the p-value it must have.

    Only what is asked for has one: the others are there to be told apart from it. That there is no
    more of an effect than noise would have is noted.
    """
    own = [s for s in hypotheses(work, ranked) if s.freedom]
    confirmed = {s.candidate.label for s in confirmed_by_flips(own, own, chance)}
    labels = {s.candidate.label for s in own}
    limit, tried = chance / max(len(labels), 1), []
    for score, fitted in refitted(work, current, best_of_each(own, current), ranked):
        label, p_value = score.candidate.label, 1.0
        if label in labels:
            p_value = _of_refit(work, current, score, fitted)
            if p_value > limit:
                _refuse_once(
                    work, score, f"no more of it than noise would have (p = {p_value:.2g})"
                )
                p_value = 1.0
            elif label not in confirmed:
                _refuse_once(work, score, "no more than noise that is not alike everywhere")
                p_value = 1.0
        tried.append((replace(score, p_value=p_value), fitted))
    return (tried if confirmed else []), limit


def note_unseen(work: Work, ranked: Sequence[Score]) -> None:
    """Say what the data cannot show of what is asked for, and what does not apply to them."""
    for label in {s.candidate.label: None for s in hypotheses(work, ranked)}:
        scores = [s for s in ranked if s.candidate.label == label]
        if not any(s.freedom for s in scores):
            work.refuse(scores[0].candidate, "these data cannot show it")
    of_noise = {e.name for e in work.catalogue if e.on == NOISE}
    seen = {name for s in ranked for name in (s.candidate.name, s.candidate.label)}
    for name in sorted(work.known - of_noise - seen):
        reasons = [s.reason for s in work.skipped if name in (s.name, s.name.partition("(")[0])]
        reason = reasons[0] if reasons else "the data have no column that it could follow"
        work.refused.append(Skipped(name, reason))


def _refuse_once(work: Work, score: Score, why: str) -> None:
    """The reason of the first round in which it is asked about."""
    if score.candidate.label not in {r.name for r in work.refused}:
        work.refuse(score.candidate, why)


def _of_refit(work: Work, current: Fitted, score: Score, fitted: Fitted) -> float:
    """The F test's p-value, with the noise's colour and the trials of the profile."""
    from scipy.special import fdtrc

    freedom = Problem(fitted.model, work.runs).residual_count - fitted.unknowns
    more, inflation = fitted.unknowns - current.unknowns, max(score.inflation, 1.0)
    if more < 1 or freedom < 1:
        return 1.0
    noise = inflation * cost_of(fitted) / freedom
    F = max(cost_of(current) - cost_of(fitted), 0.0) / more / noise
    return min(1.0, float(fdtrc(more, freedom / inflation, F)) * score.candidate.trials)
