"""The end of the loop: what if the effect added last is another one, which explains alike?"""

from __future__ import annotations

from collections.abc import Sequence

from casest.diagnose.candidates.score_test import Score
from casest.diagnose.selection.acceptance import accepted
from casest.diagnose.selection.expected_loss import apart, hangs_on_which, harms, leave_open, rivals
from casest.diagnose.selection.model_evidence import (
    NEXT_TO_NOTHING,
    SMALL,
    STRONG,
    Fitted,
    as_good,
    not_told_apart,
)
from casest.diagnose.selection.state import Step, Work

#: Harm of a cause, were it another one, over its good, were it this one, from which on to have more
#: evidence is not enough. In squares: where the other pulls the opposite way as far.
HARM = 3.0
#: A lead in evidence that the wrong one of two causes has in one of a thousand records at most: it
#: scatters with variance 4δ around −δ, and so reaches g with probability Φ(−√g) or less.
SURE = 10.0
#: Share of the squared distance to where a rival has the parameters that must be gone.
NEARER = 0.1


def swapped(work: Work, current: Fitted) -> Fitted:
    """With another effect, or none, in place of the one added last, where that one may do harm.

    Beside causes that are still missing nothing is known of that: it is asked at the end.
    """
    step = work.last
    if step is None or not work.found or work.found[-1].score is not step.score:
        return current
    if step.share >= SMALL:
        other = _of_less_loss(work, step)
        if other is not None:
            return other
    near = _opposed(work, step)
    if not hangs_on_which(work, step.fitted, near):
        return current
    work.found.pop()
    leave_open(work, step, near)
    return step.before


def _of_less_loss(work: Work, step: Step) -> Fitted | None:
    """With a cause that explains alike and brings the parameters nearer whichever of them it is.

    None where the one that was added does, or where there is none such.
    """
    rest = as_good(step.tried, work.folds, SURE)
    harmful = any(harms(work, step.before, step.fitted, other) for _, other in rest)
    if not harmful or not hangs_on_which(work, step.fitted, rest):
        return None
    matter = NEXT_TO_NOTHING * sum(r.size for r in step.fitted.residuals)
    for score, fitted in as_good(step.tried, work.folds, min(SURE, matter)):
        if not all(_nearer(work, step, fitted, other) for _, other in rest if other is not fitted):
            continue
        passed = accepted(work, step.before, score, fitted)
        if passed is None:
            continue
        given = work.found.pop().candidate
        nearer = f"{score.candidate.label} brings the parameters nearer whichever of them it is"
        work.refuse(given, f"it explains alike, but {nearer}")
        work.keep(*passed, score, rivals(work, fitted, score, step.tried))
        return passed[0]
    return None


def _nearer(work: Work, step: Step, fitted: Fitted, other: Fitted) -> bool:
    """Were it the other one, would the parameters still come nearer to the truth?"""
    before = apart(work, step.before, step.before.values, other.values)
    return apart(work, step.before, fitted.values, other.values) <= (1 - NEARER) * before


def _opposed(work: Work, step: Step) -> Sequence[tuple[Score, Fitted]]:
    """Causes of which each, if it is the wrong one, does more harm than none.

    If one pulls far, it need not explain as much: it is enough that the data do not tell the two
    apart. Nor need it pull if the effect explains little.
    """
    alike = [p for p in step.tried if not_told_apart(step.fitted, p[1], step.score, work.folds)]
    if step.share < SMALL:
        return alike
    near = as_good(step.tried, work.folds, STRONG)
    if any(harms(work, step.before, step.fitted, other) for _, other in near):
        return near
    return [p for p in alike if harms(work, step.before, step.fitted, p[1], HARM)]
