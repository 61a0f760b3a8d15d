"""One step of the search: the best cause that held-out parts confirm, or none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf

from casest.diagnose.evidence.held_out import Fall
from casest.diagnose.evidence.score import Evidence, judged
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.confirming import (
    FAR_AWAY,
    falls,
    falls_with,
    holds_out,
    passing,
)
from casest.diagnose.protocol.ranking import pairs, ranked, without_feigned
from casest.diagnose.protocol.refits import (
    NOT_HELD_OUT,
    best_refits,
    refitted,
    shown,
    torn_between,
)
from casest.diagnose.protocol.state import F, Kept, Ranking, Refit, State
from casest.diagnose.protocol.subject import Subject

#: Why one of a pair is not, beside a column of the motion.
FOLLOWED = "what only follows a column explains nearly as much"


def with_the_best(
    subject: Subject[F], state: State[F], ranking: Ranking, say: Callable[[str], None]
) -> State[F]:
    """The state with the best cause that held-out parts confirm; as it is if none is."""
    asked = [e for e in ranking.found if subject.asked(e.trials[0].what)]
    options = [e for e in ranking.causes if ranking.says(e)]
    options += _without_noise(subject, state.fit, ranking, pairs(ranking))
    options.sort(key=lambda e: -e.score)
    formulas = [] if asked else [subject.formula(state.fit, ranking)]
    described = next(iter(_without_noise(subject, state.fit, ranking, formulas)), None)
    beyond = _not_instead(ranking, _beyond_columns(ranking, options))
    left, tried, halving = beyond, list[Evidence](), list[Refit[F]]()
    while True:
        held = asked or passing(ranking, left)
        state, refits = refitted(subject, state, ranking, held)
        if not asked and not tried:
            state, more, halving = shown(subject, state, ranking, refits)
            refits = best_refits(refits, more, ranking.order)
            refits = _best_foretold_first(subject, state, ranking, refits)
        torn = [] if asked else torn_between(refits, ranking)
        if torn:
            return replace(state, open=tuple(r.evidence for r in torn), torn=tuple(torn))
        if described is not None and _describes(subject, described, refits, ranking):
            state, more = refitted(subject, state, ranking, [described])
            refits = [*more, *refits]
        bigger, over = _first_certified(subject, state, ranking, refits, say)
        if len(bigger.kept) > len(state.kept):
            return bigger
        state, tried = bigger, [*tried, *held]
        # A linear promise that no refit keeps: what comes after it.
        left = [] if asked else [e for e in left if not _among(e, held)]
        if over or not held or not (left or asked):
            break
        asked, left = [], left or beyond
    alone = [e for e in options if len(e.trials) == 1 and not _among(e, tried)]
    for evidence in alone[:2]:
        why = NOT_HELD_OUT if _among(evidence, beyond) else FOLLOWED
        state = state.refusing(evidence.trials[0].what, why)
    missing = [e for e in (*options, *ranking.followed) if not state.unlike(e)]
    missing.sort(key=lambda e: -e.score)
    open_ = (*(r.evidence for r in halving), *missing[: LEVELS.contenders])
    return replace(state, open=open_)


def _best_foretold_first(
    subject: Subject[F], state: State[F], ranking: Ranking, refits: list[Refit[F]]
) -> list[Refit[F]]:
    """None comes before one that leaves less than half of what it leaves, wherever it is held out:
    what a steady motion leaves is lines, and to a likelihood these are noise however large."""
    if not ranking.linear.series or len(refits) < 2:
        return refits
    seen = [
        {k: f.ratio for k, f in (r.falls or _falls(subject, state, ranking, r)).items()}
        for r in refits
    ]
    most = {k: LEVELS.most * ratio for k, ratio in seen[0].items()}
    better = [r for r, own in zip(refits, seen, strict=True) if all(own[k] < most[k] for k in most)]
    most_likely = max((r.evidence.score for r in better), default=0.0)
    near = [r for r in better if r.evidence.score > most_likely - LEVELS.strong]
    # Of equal ones the first of the catalogue: what is met more often.
    usual = {id(r): min(ranking.order.get(f, 0) for f in r.evidence.families) for r in near}
    best = min(near, key=lambda r: usual[id(r)], default=refits[0])
    return [best, *[r for r in refits if r is not best]]


def _falls(
    subject: Subject[F], state: State[F], ranking: Ranking, refit: Refit[F]
) -> dict[str, Fall]:
    return falls_with(subject, state, ranking, refit.evidence, refit.fit)


def _among(evidence: Evidence, several: Sequence[Evidence]) -> bool:
    """Is it one of them? Arrays are not compared."""
    return any(evidence is e for e in several)


def _without_noise(
    subject: Subject[F], fit: F, ranking: Ranking, several: Sequence[Evidence | None]
) -> list[Evidence]:
    """Those that say something also without what noise of the inputs may feign."""
    given = [e for e in several if e is not None and ranking.says(e)]
    found = without_feigned(subject, fit, ranking.likelihood, given, ranking.families)
    # What feigns no more than before says what it said.
    both = zip(given, found, strict=True)
    return [e for before, e in both if e.feigned == before.feigned or ranking.says(e)]


def _beyond_columns(ranking: Ranking, options: Sequence[Evidence]) -> list[Evidence]:
    """Without pairs of which what only follows a column can take the place of one: it would explain
    nearly as much."""
    paired = {t.family for e in options if len(e.trials) > 1 for t in e.trials}
    beside = dict.fromkeys(paired, -inf)
    for one in ranking.followed[: LEVELS.nearest]:
        for other in (e for e in ranking.causes if e.trials[0].family in paired):
            both = judged([*one.trials, *other.trials], ranking.likelihood, ranking.none,
                          start=one.explained, families=ranking.families)  # fmt: skip
            if both is not None:
                family = other.trials[0].family
                beside[family] = max(beside[family], both.score)

    def clear(pair: Evidence) -> bool:
        return pair.score > max(beside[f] for f in pair.families) + LEVELS.clear

    return [e for e in options if len(e.trials) == 1 or clear(e)]


def _not_instead(ranking: Ranking, options: Sequence[Evidence]) -> list[Evidence]:
    """Without pairs of which a cause that alone is better than either can take the place of one:
    it comes first, and the other one beside it."""
    alone = {e.families[0]: e for e in options if len(e.trials) == 1}
    together = {frozenset(e.families): e.score for e in options if len(e.trials) > 1}

    def instead(pair: Evidence) -> bool:
        best = max((alone[f].score for f in pair.families if f in alone), default=-inf)
        return any(
            one.score > best
            and family not in pair.families
            and max(together.get(frozenset((family, f)), -inf) for f in pair.families) > pair.score
            and holds_out(falls(ranking, one), ranking.linear)
            for family, one in alone.items()
        )

    return [e for e in options if len(e.trials) == 1 or not instead(e)]


def _first_certified(
    subject: Subject[F],
    state: State[F],
    ranking: Ranking,
    refits: Sequence[Refit[F]],
    say: Callable[[str], None],
) -> tuple[State[F], bool]:
    """The state with the first refit that is proved, if there is one; and is the search over?"""
    for k, refit in enumerate(refits):
        fit = subject.certified(refit.fit)
        if not isinstance(fit, str):
            return _with_kept(subject, state, ranking, replace(refit, fit=fit), say), True
        state = state.refusing(refit.evidence.trials[0].what, fit)
        later = refits[k + 1].evidence.score if k + 1 < len(refits) else 0.0
        if len(refit.evidence.trials) == 1 and refit.evidence.score > later + LEVELS.clear:
            return state, True  # what explains clearly less is not the cause
    return state, False


def _describes(
    subject: Subject[F], formula: Evidence, names: Sequence[Refit[F]], ranking: Ranking
) -> bool:
    """Is a description so much better than causes with a name, wherever it is held out?

    Than the best cause, and what has a name beside that one: terms of a formula may be several
    causes.
    """
    best = max((r.evidence.score for r in names), default=0.0)
    if not ranking.linear.series:  # what a row or a few carry has a name all the same
        best = max([best, *(e.score for e in ranking.causes[:1])])
    if formula.score < best + LEVELS.described or not ranking.says(formula):
        return False
    seen = falls(ranking, formula)
    if any(f.ratio >= 1 or f.t < LEVELS.confirmed for f in seen.values()):
        return False
    if not names:
        return True
    named = falls(ranking, names[0].evidence)
    if any(1 - named[k].ratio > (1 - LEVELS.alike) * (1 - seen[k].ratio) for k in FAR_AWAY):
        return False  # what has a name explains as much
    beside = ranked(subject, names[0].fit).found
    second = max((e.score for e in beside[:1]), default=0.0)
    return formula.score >= best + max(second, 0.0) + LEVELS.described


def _with_kept(
    subject: Subject[F],
    state: State[F],
    ranking: Ranking,
    refit: Refit[F],
    say: Callable[[str], None],
) -> State[F]:
    kept, seen = state.kept, refit.falls
    seen = seen or _falls(subject, state, ranking, refit)
    for trial in refit.evidence.trials:
        say(f"{trial.family}: held-out error falls")
        kept = (*kept, Kept(trial.what, refit.evidence, seen))
    return replace(state, fit=refit.fit, kept=kept)
