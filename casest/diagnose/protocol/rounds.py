"""The search: rounds of ranking and choosing, then elimination and rivals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.choosing import with_the_best
from casest.diagnose.protocol.elimination import eliminated, on_all_axes
from casest.diagnose.protocol.ranking import ranked
from casest.diagnose.protocol.rivals import with_rivals
from casest.diagnose.protocol.state import F, State
from casest.diagnose.protocol.subject import Subject


def search(
    subject: Subject[F],
    fit: F,
    say: Callable[[str], None] = lambda _: None,
    begun: State[F] | None = None,
) -> State[F]:
    """Add what is missing, one cause or a pair at a time, until nothing is confirmed any more."""
    state = State(fit) if begun is None else replace(begun, fit=fit)
    for _ in range(LEVELS.rounds):
        ranking = ranked(subject, state.fit)
        state = replace(state, first=state.first or ranking, last=ranking, open=(), torn=())
        bigger = with_the_best(subject, state, ranking, say)
        if len(bigger.kept) == len(state.kept):
            state = bigger
            break
        state = bigger
    else:
        state = replace(state, last=ranked(subject, state.fit))
    left = eliminated(subject, on_all_axes(subject, state, needed=True))
    if subject.linear(left.fit).series:  # poses are few: each unknown costs
        left = on_all_axes(subject, left, needed=False)
    if len(left.kept) < len(state.kept):
        left = replace(left, last=ranked(subject, left.fit))
    return with_rivals(subject, left)
