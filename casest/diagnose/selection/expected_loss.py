"""What hangs on which of several causes it is, and what is left open for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.selection.found import Undecided
from casest.diagnose.selection.model_evidence import Fitted, not_told_apart
from casest.diagnose.selection.state import Step, Work
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import weighted

#: Standard deviations by which another cause must move a declared parameter to have it elsewhere.
ELSEWHERE = 2.0


def hangs_on_which(work: Work, fitted: Fitted, near: Sequence[tuple[Score, Fitted]]) -> bool:
    """Would one of the other causes have the declared parameters elsewhere?"""
    return any(
        np.any(np.abs(other.values[n] - fitted.values[n]) > ELSEWHERE * std)
        for _, other in near
        for n, std in work.before.std.items()
        if n in other.values and n in fitted.values
    )


def rivals(
    work: Work, fitted: Fitted, score: Score, tried: Sequence[tuple[Score, Fitted]]
) -> dict[str, dict[str, Array]]:
    """What is not told apart from a fit, and where it would have the declared parameters."""
    return {
        s.candidate.label: shifts(work, fitted, f)
        for s, f in tried
        if f is not fitted and not_told_apart(fitted, f, score, work.folds)
    }


def shifts(work: Work, one: Fitted, other: Fitted) -> dict[str, Array]:
    """From the one to the other: how far each declared parameter goes."""
    names = [p.name for p in work.before.model.parameters]
    both = [n for n in names if n in one.values and n in other.values]
    return {n: other.values[n] - one.values[n] for n in both}


def harms(work: Work, current: Fitted, fitted: Fitted, other: Fitted, times: float = 0.0) -> bool:
    """Would a cause do more harm, were it the other one, than so many times its good?

    Two causes may explain alike and move the parameters in opposite ways. Harm: how much further
    away they are from where the other has them. Good: how far they are moved. Both in squares.
    """
    harm = apart(work, current, fitted.values, other.values)
    harm -= apart(work, current, current.values, other.values)
    return harm > times * apart(work, current, current.values, fitted.values)


def apart(
    work: Work, current: Fitted, one: Mapping[str, Array], other: Mapping[str, Array]
) -> float:
    """Between two places of a model's own parameters: squares of what they predict differently."""
    names = [p.name for p in current.model.parameters]
    problem = weighted(Problem(current.model, work.runs), current.values)

    def predicted(values: Mapping[str, Array]) -> Sequence[Array]:
        own = {n: values[n] for n in names if n in values}
        return problem.residuals(problem.point({**current.values, **own}))

    pairs = zip(predicted(one), predicted(other), strict=True)
    return sum(float(np.sum((a - b) ** 2)) for a, b in pairs)


def leave_open(work: Work, step: Step, near: Sequence[tuple[Score, Fitted]]) -> None:
    """Say that several causes explain alike, and that none is added."""
    own = step.score.candidate
    names = [s.candidate.label for s, fitted in near if fitted is not step.fitted]
    why = f"it may as well be {', '.join(names)}, and the parameters hang on which it is"
    work.refuse(own, why)
    moves = {own.label: shifts(work, step.before, step.fitted)}
    moves |= {s.candidate.label: shifts(work, step.before, fitted) for s, fitted in near}
    work.undecided = Undecided((own.label, *names), step.share, moves)


def note_walk(work: Work, current: Fitted, score: Score, fitted: Fitted) -> None:
    """Keep in mind what held-out data confirm, though a random walk may be the cause as well."""
    crossed = work.crossed(fitted)
    if crossed is not None and work.confirmed(current, crossed):
        share = work.gain(current, crossed)[0] / crossed.noise**2
        work.walks.append(Undecided((score.candidate.label,), share))
