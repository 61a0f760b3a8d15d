"""The search: rounds of ranking and choosing, then elimination."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from casest.diagnose.evidence.score import Evidence, Trial
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.choosing import with_the_best
from casest.diagnose.protocol.elimination import eliminated, on_all_axes
from casest.diagnose.protocol.ranking import ranked, ranked_of, refined
from casest.diagnose.protocol.state import F, Ranking, Round, State
from casest.diagnose.protocol.subject import Subject


def search(
    subject: Subject[F],
    fit: F,
    say: Callable[[str], None] = lambda _: None,
    begun: State[F] | None = None,
) -> State[F]:
    """Add what is missing, one cause or a pair at a time, until nothing is confirmed any more.

    From a state without a cause, none of those that it had and that went again: what came with
    another may have kept out what does both.
    """
    state = State(fit) if begun is None else replace(begun, fit=fit, rounds=())
    barred = frozenset[str]() if state.kept else state.gone
    before: State[F] | None = None
    for _ in range(LEVELS.rounds):
        # Else what lies on an axis that was nothing before would look like another cause.
        state = on_all_axes(subject, state, needed=True)
        trials = [t for t in _shown_at_first(subject, state) if t.family not in barred]
        plain = ranked_of(subject.linear(state.fit), trials)
        seen = Round(state.fit, tuple(k.what for k in state.kept), plain)
        state = replace(state, rounds=(*state.rounds, seen))
        ranking = refined(subject, state.fit, plain)
        if before is not None and _small(subject, before, state) and _left(ranking):
            state = _as_before(before, state)
            break
        state = replace(state, first=state.first or ranking, last=ranking, open=())
        before, state = state, with_the_best(subject, state, ranking, say)
        if len(state.kept) == len(before.kept):
            break
    else:
        state = replace(state, last=ranked(subject, state.fit))
    left = eliminated(subject, on_all_axes(subject, state, needed=True))
    if subject.linear(left.fit).series:  # poses are few: each unknown costs
        left = on_all_axes(subject, left, needed=False)
    if len(left.kept) < len(state.kept):
        left = replace(left, last=ranked(subject, left.fit))
    return left


def _shown_at_first(subject: Subject[F], state: State[F]) -> list[Trial]:
    """What could be missing: of what the declared model leaves nothing to see, a cause that was
    added would be all there is to bend, and shows its own shape."""
    several = list(subject.trials(state.fit))
    if state.first is None:
        return several
    there = {e.trials[0].family for e in state.first.found}
    return [t for t in several if t.family in there or subject.asked(t.what)]


def _small(subject: Subject[F], before: State[F], state: State[F]) -> bool:
    """Does what came last explain less of the variance than a misfit that counts, each of them?"""
    last = state.kept[len(before.kept) :]
    if not subject.linear(before.fit).series or any(subject.asked(k.what) for k in last):
        return False
    share = LEVELS.share * len(last)  # a pair explains no more than both of them
    return all(k.falls["pieces"].ratio > 1 - share for k in last)


def _left(ranking: Ranking) -> bool:
    """Is there strong evidence for something still?"""
    return any(ranking.says(e) for e in ranking.found)


def _as_before(before: State[F], state: State[F]) -> State[F]:
    """Without what came last: a small part of a misfit may be anything that goes with it."""
    open_: dict[int, Evidence] = {}
    for kept in state.kept[len(before.kept) :]:
        before = before.refusing(kept.what, "a small part of what is missing: it may be another's")
        open_[id(kept.evidence)] = kept.evidence
    assert before.last is not None
    others = [e for e in before.last.causes if before.last.says(e)]
    torn = (*open_.values(), *(e for e in others if id(e) not in open_))
    return replace(before, open=torn[: LEVELS.contenders])
