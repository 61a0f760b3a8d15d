"""The loop, for residuals and for innovations: rank, refit, confirm, eliminate.

A `Subject` knows its model: what could be missing there, in which columns it shows, how to refit.
The loop knows nothing of models: it asks which cause explains most, whether what was held out
confirms it, and what cannot be told apart. A state of the search is a value: what is tried and
dropped leaves no trace.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.held_out import (
    Fall,
    fall,
    fall_between,
    squares,
    standard_errors,
)
from casest.diagnose.evidence.likelihood import Explained, Likelihood
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import (
    Evidence,
    Trial,
    again,
    expected_loss,
    judged,
    on_fewer_axes,
    p_value,
    screened,
    whitened,
    worth,
)
from casest.diagnose.levels import LEVELS

F = TypeVar("F")


class Subject(Protocol[F]):
    """What is searched. Fits are values; `what` of a trial is the subject's own."""

    def linear(self, fit: F) -> Linear:
        """The fit as a linear problem."""
        ...

    def trials(self, fit: F) -> Sequence[Trial]:
        """All that could be missing, in its columns; of what has a grid, one for each value."""
        ...

    def shown(self, fit: F) -> Sequence[Trial]:
        """What is refitted whatever its columns promise."""
        ...

    def nearer(self, fit: F, trial: Trial, scale: float) -> Sequence[Trial]:
        """Variants of a trial around its value on a grid."""
        ...

    def on_axes(self, fit: F, trial: Trial, axes: Sequence[int]) -> Trial:
        """The trial on some of its axes only."""
        ...

    def refit(self, fit: F, added: Sequence[Trial]) -> F | str:
        """The fit with these in the model; or why there is none."""
        ...

    def gain(self, fit: F, better: F, evidence: Evidence) -> float:
        """2 log of the likelihood of a refit over that of the fit, each with a noise of its own."""
        ...

    def rise(self, less: F, fit: F) -> float:
        """2 log of the likelihood of a fit over that of one with less in it."""
        ...

    def certified(self, fit: F) -> F | str:
        """The fit, proved; or why it is refused."""
        ...

    def without(self, fit: F, what: Any) -> F | None:
        """The fit without something that was added."""
        ...

    def wider(self, fit: F, what: Any) -> tuple[Any, F] | None:
        """Something that was added on some axes only, and the fit with it on all of them."""
        ...

    def apart(self, fit: F, kept: Kept) -> tuple[Linear, Trial] | None:
        """The linear problem as if a cause were not there, and the cause as a trial of it."""
        ...

    def asked(self, what: Any) -> bool:
        """Did the user say that it is there?"""
        ...

    def label(self, what: Any) -> str:
        """What it is called."""
        ...

    def formula(self, fit: F, ranking: Ranking) -> Evidence | None:
        """The best description outside the catalogue."""
        ...


@dataclass(frozen=True)
class Ranking:
    """Causes by what they are worth, beside one fit; the best of each family, best first."""

    linear: Linear
    likelihood: Likelihood = field(repr=False)
    none: Explained = field(repr=False)
    found: tuple[Evidence, ...]
    families: int
    order: Mapping[str, int] = field(default_factory=dict, repr=False)

    @property
    def causes(self) -> tuple[Evidence, ...]:
        """Those that have a name of their own."""
        return tuple(e for e in self.found if not e.trials[0].describes)

    def enough(self, score: float, gain: float) -> bool:
        """Is it strong evidence, and nearly as much as a course of unknown cause explains?"""
        course = self.description
        if score <= (LEVELS.strong if self.linear.series else 0.0):
            return False
        return course is None or score > course.score or gain > (1 - LEVELS.alike) * course.gain

    @property
    def description(self) -> Evidence | None:
        """The best course of unknown cause, if there is evidence for one."""
        found = [e for e in self.found if e.trials[0].describes and e.score > LEVELS.strong]
        return found[0] if found else None


@dataclass(frozen=True)
class Rival:
    """A cause that is not told apart from one that was added, and the fit with it instead."""

    what: Any
    fit: Any = field(repr=False)


@dataclass(frozen=True)
class Kept:
    """A cause that was added, its evidence when it was, what held-out parts said, its rivals."""

    what: Any
    evidence: Evidence
    falls: dict[str, Fall]
    rivals: tuple[Rival, ...] = ()


@dataclass(frozen=True)
class Refused:
    """What explained much but was not added, and why."""

    what: Any
    why: str


@dataclass(frozen=True)
class State(Generic[F]):
    """A search as it stands: the fit, what it has been given, what was refused.

    `open`: causes of which one is there, but not one to add.
    """

    fit: F
    kept: tuple[Kept, ...] = ()
    refused: tuple[Refused, ...] = ()
    open: tuple[Evidence, ...] = ()
    first: Ranking | None = None
    last: Ranking | None = None

    def refusing(self, what: Any, why: str) -> State[F]:
        """The state with a refusal, which is said once."""
        if any(r.what == what and r.why == why for r in self.refused):
            return self
        return replace(self, refused=(*self.refused, Refused(what, why)))


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
        state = replace(state, first=state.first or ranking, last=ranking, open=())
        bigger = _with_the_best(subject, state, ranking, say)
        if len(bigger.kept) == len(state.kept):
            state = bigger
            break
        state = bigger
    else:
        state = replace(state, last=ranked(subject, state.fit))
    smaller = eliminated(subject, _on_all_axes(subject, state))
    if len(smaller.kept) < len(state.kept):
        smaller = replace(smaller, last=ranked(subject, smaller.fit))
    return with_rivals(subject, smaller)


# -- rank ------------------------------------------------------------------------------------------


def ranked(subject: Subject[F], fit: F) -> Ranking:
    """Every cause beside a fit: the best variants of each family, each with a noise of its own."""
    ranking = ranked_of(subject.linear(fit), list(subject.trials(fit)))
    found = _best_first([_on_its_axes(subject, fit, e, ranking) for e in ranking.found])
    ranking = _about_the_best(replace(ranking, found=found))
    near = [e for e in ranking.causes[: LEVELS.contenders] if e.score > -LEVELS.clear]
    finer = {e.trials[0].family: sharpened(subject, fit, ranking, e) for e in near}
    found = tuple(finer.get(e.trials[0].family, e) for e in ranking.found)
    return replace(ranking, found=_best_first(found))


def ranked_of(linear: Linear, trials: Sequence[Trial]) -> Ranking:
    """The best variant of each family, with a noise of its own."""
    likelihood = Likelihood(linear)
    none = likelihood.beside()
    families = max(len({t.family for t in trials}), 1)
    white = whitened(likelihood, none)
    best: dict[str, tuple[float, Trial]] = {}
    for trial in trials:
        promise = screened(trial, likelihood, white)
        if promise > best.get(trial.family, (-np.inf, trial))[0]:
            best[trial.family] = (promise, trial)
    found = [judged([trial], likelihood, none, families=families) for _, trial in best.values()]
    several = _best_first([e for e in found if e is not None])
    order = {family: k for k, family in enumerate(dict.fromkeys(t.family for t in trials))}
    return Ranking(linear, likelihood, none, several, families, order)


def _best_first(found: Sequence[Evidence]) -> tuple[Evidence, ...]:
    return tuple(sorted(found, key=lambda e: -e.score))


def _on_its_axes(subject: Subject[F], fit: F, evidence: Evidence, ranking: Ranking) -> Evidence:
    """Without the axes that are not worth their price."""
    axes = on_fewer_axes(evidence, ranking.likelihood)
    if axes is None:
        return evidence
    trial = subject.on_axes(fit, evidence.trials[0], axes)
    less = judged([trial], ranking.likelihood, ranking.none, start=evidence.explained,
                  families=ranking.families)  # fmt: skip
    whole = evidence.freedom == evidence.trials[0].columns.shape[2]  # else no size of its own
    return less if less is not None and (less.score > evidence.score or not whole) else evidence


def _about_the_best(ranking: Ranking) -> Ranking:
    """The same with what is far out told from the best course: far from none may be the cause."""
    if not ranking.found or not ranking.linear.series:
        return ranking
    best, families = ranking.found[0], ranking.families
    if best.score < 0:
        return ranking
    course = ranking.likelihood.course(best.explained, [best.basis])
    likelihood = Likelihood(ranking.linear, course)
    likelihood.__dict__["declared"] = ranking.likelihood.declared
    none = likelihood.beside(start=ranking.none.spectrum)
    found = _best_first([again(e, likelihood, none, families, 1) for e in ranking.found])
    return replace(ranking, likelihood=likelihood, none=none, found=found)


def pairs(ranking: Ranking) -> list[Evidence]:
    """The best causes two by two: what neither shows alone."""
    best = ranking.causes[: LEVELS.contenders]
    found = []
    for one, other in combinations(best, 2):
        both = judged(
            [*one.trials, *other.trials],
            ranking.likelihood,
            ranking.none,
            start=one.explained,
            families=ranking.families,
        )
        if both is not None and both.freedom > max(one.freedom, other.freedom):
            found.append(both)
    return sorted(found, key=lambda e: -e.score)


# -- confirm ---------------------------------------------------------------------------------------


def falls(ranking: Ranking, evidence: Evidence) -> dict[str, Fall]:
    """What the columns of a cause do to each kind of held-out squares."""
    columns = [ranking.likelihood.in_time(evidence.basis)]
    return {k: fall(ranking.linear, columns, p) for k, p in ranking.linear.parts.each.items()}


def holds_out(found: dict[str, Fall], linear: Linear) -> bool:
    """Are pieces, whole stretches and whole regions foretold better?

    From part to part where there are parts enough; a region may be foretold worse by chance alone.
    """
    if not linear.series:
        return found["pieces"].ratio < 1
    steady = min(found["pieces"].t, found["stretches"].t) > LEVELS.confirmed
    return steady and all(f.ratio < 1 for f in found.values())


def significant(evidence: Evidence, linear: Linear) -> bool:
    """Strong evidence in a series; in poses the F test, shared among all that was tried."""
    return evidence.score > LEVELS.strong if linear.series else evidence.p_value < LEVELS.chance


def _with_the_best(
    subject: Subject[F], state: State[F], ranking: Ranking, say: Callable[[str], None]
) -> State[F]:
    """The state with the best cause that held-out parts confirm; as it is if none is."""
    state, asked = _hypotheses(subject, state, ranking)
    every = (*ranking.causes, *pairs(ranking))
    options = [e for e in every if significant(e, ranking.linear)]
    options.sort(key=lambda e: -e.score)
    described = None if asked else subject.formula(state.fit, ranking)
    left, tried = options, list[Evidence]()
    while True:
        passing = asked or _passing(ranking, left)
        refits = _refitted(subject, state.fit, ranking, passing)
        if not asked and not tried:
            refits = _best_refits([*refits, *_shown(subject, state.fit, ranking)])
        torn = [] if asked else _torn_between(refits, ranking)
        if torn:
            return replace(state, open=tuple(torn))
        if described is not None and _describes(subject, described, refits, ranking):
            refits = [*_refitted(subject, state.fit, ranking, [described]), *refits]
        bigger, over = _first_certified(subject, state, ranking, refits, say)
        if len(bigger.kept) > len(state.kept):
            return bigger
        state, tried = bigger, [*tried, *passing]
        # A linear promise that no refit keeps: what comes after it.
        left = [] if asked else [e for e in left if e not in passing]
        if over or not passing or not (left or asked):
            break
        asked, left = [], left or options
    for evidence in [e for e in options if e not in tried][:2]:
        state = state.refusing(evidence.trials[0].what, NOT_HELD_OUT)
    return replace(state, open=tuple(options[: LEVELS.contenders]))


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
            return _kept(subject, state, ranking, replace(refit, fit=fit), say), True
        state = state.refusing(refit.evidence.trials[0].what, fit)
        later = refits[k + 1].evidence.score if k + 1 < len(refits) else 0.0
        if len(refit.evidence.trials) == 1 and refit.evidence.score > later + LEVELS.strong:
            return state, True  # what explains clearly less is not the cause
    return state, False


def _hypotheses(
    subject: Subject[F], state: State[F], ranking: Ranking
) -> tuple[State[F], list[Evidence]]:
    """What the user says is there: a hypothesis that was there before the data, by its F test."""
    asked = [e for e in ranking.found if subject.asked(e.trials[0].what)]
    found = []
    for evidence in asked:
        alone = again(evidence, ranking.likelihood, ranking.none, len(asked), 1)
        if alone.p_value >= LEVELS.chance:
            why = f"no more of it than noise would have (p = {alone.p_value:.2g})"
            state = state.refusing(evidence.trials[0].what, why)
        elif falls(ranking, alone)["pieces"].ratio < 1:
            found.append(alone)
    return state, sorted(found, key=lambda e: -e.score)


@dataclass(frozen=True)
class Refit(Generic[F]):
    """A cause in the model, fitted: `evidence` with the score of this fit; `falls` if they are not
    those of its columns."""

    fit: F
    evidence: Evidence
    falls: dict[str, Fall] | None = None


def _refitted(
    subject: Subject[F], fit: F, ranking: Ranking, options: Sequence[Evidence]
) -> list[Refit[F]]:
    """Causes by what their refits are worth; of equal ones first what would do the least harm."""
    found: list[Refit[F]] = []
    for evidence in _with_parts(options[: LEVELS.contenders], ranking):
        evidence = sharpened(subject, fit, ranking, evidence)
        better = subject.refit(fit, evidence.trials)
        if isinstance(better, str):
            continue
        gain = subject.gain(fit, better, evidence)
        score = evidence.score - evidence.gain + gain
        if ranking.enough(score, gain) or subject.asked(evidence.trials[0].what):
            found.append(Refit(better, replace(evidence, gain=gain, score=score)))
    found.sort(key=lambda r: -r.evidence.score)
    near = _near(found)
    if len(near) > 1:
        loss, _ = expected_loss(near, ranking.likelihood)
        # Of equal ones the first of the catalogue: what is met more often.
        usual = [min(ranking.order.get(f, 0) for f in e.families) for e in near]
        best = found[min(range(len(near)), key=lambda k: (float(f"{loss[k]:.3g}"), usual[k]))]
        found = [best, *[r for r in found if r is not best]]
        found = _plainest_first(found)
    return found


def _plainest_first(refits: list[Refit[F]]) -> list[Refit[F]]:
    """What the first one contains, and explains as much, comes before it."""
    first = refits[0].evidence
    inside = [
        r
        for r in refits[1:]
        if r.evidence.score > first.score - LEVELS.strong
        and r.evidence.freedom < first.freedom
        and _contains(first, r.evidence)
    ]
    if not inside:
        return refits
    best = max(inside, key=lambda r: r.evidence.score)
    return [best, *[r for r in refits if r is not best]]


def _contains(wide: Evidence, narrow: Evidence) -> bool:
    """Are the columns of one a combination of those of the other?"""
    beyond = narrow.basis - wide.basis @ (wide.basis.T @ narrow.basis)
    return bool(np.sum(beyond**2) < NESTED * narrow.freedom)


def _near(refits: Sequence[Refit[F]]) -> list[Evidence]:
    """Those that the evidence does not tell from the best."""
    best = max((r.evidence.score for r in refits), default=0.0)
    return [r.evidence for r in refits if r.evidence.score > best - LEVELS.clear]


def _torn_between(refits: Sequence[Refit[F]], ranking: Ranking) -> list[Evidence]:
    """Causes of which each, were it the wrong one, would do more harm than none of them.

    That is, leave the declared parameters further off: what is added hangs on which it is.
    """
    near = _near(refits)
    if len(near) < 2:
        return []
    loss, none = expected_loss(near, ranking.likelihood)
    noise = float(np.mean(ranking.likelihood.residual**2 * np.exp(-near[0].gain / len(
        ranking.likelihood.residual))))  # fmt: skip
    return near if none < loss.min() and loss.min() > noise else []


def _best_refits(refits: Sequence[Refit[F]]) -> list[Refit[F]]:
    """The first stays, unless another one is clearly worth more."""
    if not refits:
        return []
    best = max(refits, key=lambda r: r.evidence.score)
    clear = best.evidence.score > refits[0].evidence.score + LEVELS.clear
    first = best if clear else refits[0]
    return [first, *[r for r in refits if r is not first]]


def _shown(subject: Subject[F], fit: F, ranking: Ranking) -> list[Refit[F]]:
    """What the records show by themselves, refitted: held-out parts by the refit itself."""
    found = []
    for trial in subject.shown(fit):
        evidence = judged([trial], ranking.likelihood, ranking.none, families=ranking.families)
        better = subject.refit(fit, [trial])
        if evidence is None or isinstance(better, str):
            continue
        gain = subject.gain(fit, better, evidence)
        score = evidence.score - evidence.gain + gain
        seen = _falls_of_refit(ranking.linear, subject.linear(better))
        if ranking.enough(score, gain) and holds_out(seen, ranking.linear):
            found.append(Refit(better, replace(evidence, gain=gain, score=score), seen))
    return found


def _falls_of_refit(before: Linear, after: Linear) -> dict[str, Fall]:
    """Held-out squares of two fits, each near its own optimum."""
    return {k: fall_between(before, after, parts) for k, parts in before.parts.each.items()}


def _with_parts(options: Sequence[Evidence], ranking: Ranking) -> list[Evidence]:
    """What comes in pairs alone as well: a refit may need one of them only."""
    alone = {e.trials[0].family: e for e in ranking.found}
    parts = [alone[t.family] for e in options if len(e.trials) > 1 for t in e.trials[:1]]
    parts += [alone[t.family] for e in options if len(e.trials) > 1 for t in e.trials[1:]]
    several = {id(e): e for e in (*options, *parts) if significant(e, ranking.linear)}
    return list(several.values())


def _kept(
    subject: Subject[F], state: State[F], ranking: Ranking, refit: Refit[F],
    say: Callable[[str], None],
) -> State[F]:  # fmt: skip
    seen, kept = refit.falls or falls(ranking, refit.evidence), state.kept
    for trial in refit.evidence.trials:
        say(f"{subject.label(trial.what)}: held-out error falls")
        kept = (*kept, Kept(trial.what, refit.evidence, seen))
    return replace(state, fit=refit.fit, kept=kept)


#: Share of their length by which columns may lie outside a span that holds the most of them.
NESTED = 0.5
#: Parts that are held out whole.
FAR_AWAY = ("stretches", "regions")
NOT_HELD_OUT = "held-out data do not confirm it"


def _passing(ranking: Ranking, options: Sequence[Evidence]) -> list[Evidence]:
    """Those that hold out, down to where none has any weight beside the best of them.

    A linear promise may be far from a refit's: of causes alone the first few count in any case.
    """
    found: list[Evidence] = []
    alone = 0
    for evidence in options:
        far = bool(found) and evidence.score < found[0].score - 2 * LEVELS.strong
        several = len(evidence.trials) > 1
        if far and (several or alone >= LEVELS.contenders):
            continue
        alone += not several
        seen = falls(ranking, evidence)
        if not holds_out(seen, ranking.linear):
            continue
        if several and not _better_than_its_parts(evidence, seen, ranking):
            continue
        found.append(evidence)
    return found


def _better_than_its_parts(both: Evidence, seen: dict[str, Fall], ranking: Ranking) -> bool:
    """Does a pair foretell much more of whole parts than each of the two alone?

    Else the better one comes first, and the other one beside it, if it is there.
    """
    names = FAR_AWAY if ranking.linear.series else ("pieces",)
    for trial in both.trials:
        (one,) = [e for e in ranking.found if e.trials[0] is trial]
        if one.score > both.score - LEVELS.strong:
            return False
        alone = falls(ranking, one)
        if any(_as_much(alone[k].ratio, seen[k].ratio) for k in names):
            return False
    return True


def _as_much(alone: float, both: float) -> bool:
    """Does one alone gain nine tenths of what both gain, and do both leave as much but a tenth?"""
    gains = 1 - alone > (1 - LEVELS.alike) * (1 - both)
    return gains and both > (1 - LEVELS.alike) * alone


def _describes(
    subject: Subject[F], formula: Evidence, names: Sequence[Refit[F]], ranking: Ranking
) -> bool:
    """Is a description so much better than causes with a name, wherever it is held out?

    Than the best cause, and what has a name beside that one: terms of a formula may be several
    causes.
    """
    best = max((r.evidence.score for r in names), default=0.0)
    if formula.score < best + LEVELS.described:
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


def sharpened(subject: Subject[F], fit: F, ranking: Ranking, evidence: Evidence) -> Evidence:
    """At the best value near the one that a grid had: the grid is coarse."""
    for k, trial in enumerate(evidence.trials):
        others = [t for t in evidence.trials if t is not trial]
        for scale in (1.0, 0.3, 0.1):
            for moved in subject.nearer(fit, evidence.trials[k], scale):
                both = [*others[:k], moved, *others[k:]]
                found = judged(both, ranking.likelihood, ranking.none, start=evidence.explained,
                               families=ranking.families, rounds=1)  # fmt: skip
                if found is not None and found.score > evidence.score:
                    evidence = found
    return evidence


# -- eliminate -------------------------------------------------------------------------------------


def _on_all_axes(subject: Subject[F], state: State[F]) -> State[F]:
    """Axes that were nothing beside what was still missing may be something now."""
    for k, kept in enumerate(state.kept):
        found = subject.wider(state.fit, kept.what)
        if found is None:
            continue
        what, fit = found
        none, all_ = Likelihood(subject.linear(state.fit)), subject.linear(fit)
        more = all_.basis.shape[1] - none.declared.shape[1]
        if more < 1 or isinstance(subject.certified(fit), str):
            continue
        if worth(subject.rise(state.fit, fit), more, 0.0, none) > LEVELS.strong:
            trials = tuple(replace(t, what=what) if t.what == kept.what else t
                           for t in kept.evidence.trials)  # fmt: skip
            evidence = replace(kept.evidence, trials=trials)
            several = list(state.kept)
            several[k] = replace(kept, what=what, evidence=evidence)
            state = replace(state, fit=fit, kept=tuple(several))
    return state


def eliminated(subject: Subject[F], state: State[F]) -> State[F]:
    """Each cause must earn its place again beside the others; the weakest goes first."""
    while len(state.kept) > 1:
        weak = []
        for kept in state.kept:
            base = subject.without(state.fit, kept.what)
            score = None if base is None else _beside_the_others(subject, state, kept, base)
            if score is not None:
                weak.append((score, kept, base))
        if not weak:
            return state
        _, gone, fit = min(weak, key=lambda w: w[0])
        assert fit is not None
        state = replace(state, fit=fit, kept=tuple(k for k in state.kept if k is not gone))
        state = state.refusing(gone.what, "no longer needed beside what came later")
    return state


def _beside_the_others(subject: Subject[F], state: State[F], kept: Kept, base: F) -> float | None:
    """What a cause is worth that does not earn its place as the last one; None if it does.

    `base` is the fit without it.
    """
    linear, whole = subject.linear(base), subject.linear(state.fit)
    none, gain = Likelihood(linear), subject.rise(base, state.fit)
    freedom = max(whole.basis.shape[1] - linear.basis.shape[1], 1)
    families = state.first.families if state.first else 1
    searched = float(np.log(kept.evidence.trials[0].variants * families))
    score = worth(gain, freedom, searched, none)
    strong = (
        score > LEVELS.strong
        if linear.series
        else (p_value(gain, freedom, searched, none) < LEVELS.chance)
    )
    if strong and (subject.asked(kept.what) or linear.residual.shape != whole.residual.shape):
        return None  # rows that moved in time are others
    return None if strong and holds_out(_falls_of_refit(linear, whole), linear) else score


# -- what is not told apart ------------------------------------------------------------------------


def with_rivals(subject: Subject[F], state: State[F]) -> State[F]:
    """Each cause beside those that explain as much in its place, the others kept."""
    kept = tuple(replace(k, rivals=_rivals(subject, state, k)) for k in state.kept)
    return replace(state, kept=kept)


def _rivals(subject: Subject[F], state: State[F], kept: Kept) -> tuple[Rival, ...]:
    """By evidence, or by held-out stretches (Vuong 1989): a score alone does not say so."""
    apart, base = subject.apart(state.fit, kept), subject.without(state.fit, kept.what)
    if apart is None or base is None:
        return ()
    linear, own, others = subject.linear(base), apart[1], list(subject.trials(base))
    if own.columns.shape[:2] != linear.residual.shape:  # rows that moved in time are others
        (own, *_) = [t for t in others if t.family == own.family]
    # Slopes and grids are those of the fit without it: in its own, others follow it.
    ranking = ranked_of(linear, [own, *(t for t in others if t.family != own.family)])
    mine = [e for e in ranking.found if e.trials[0] is own]
    if not mine:
        return ()
    stretches = linear.parts.stretches
    without, best = (squares(linear, c, stretches) for c in ([], [_in_time(ranking, mine[0])]))
    rivals = list[Evidence]()
    for e in ranking.causes:
        if e is mine[0] or e.score < LEVELS.strong or len(rivals) == LEVELS.contenders:
            continue
        lost = squares(linear, [_in_time(ranking, e)], stretches) - best
        if _as_well(mine[0].score - e.score, lost, without - best):
            rivals.append(e)
    after = subject.linear(state.fit)
    target = mine[0].score - mine[0].gain + subject.rise(base, state.fit)
    found = []
    for e in rivals:  # what the columns promise, a refit must keep
        fit = subject.refit(base, e.trials)
        if isinstance(fit, str):
            continue
        behind = target - (e.score - e.gain + subject.rise(base, fit))
        other = subject.linear(fit)
        lost = np.zeros(1)
        if {x.residual.shape for x in (linear, after, other)} == {linear.residual.shape}:
            own_, its = (squares(x, [], stretches) for x in (after, other))
            lost, best = its - own_, own_
        if _as_well(behind, lost, without - best):
            found.append(Rival(e.trials[0].what, fit))
    return tuple(found)


def _in_time(ranking: Ranking, evidence: Evidence) -> Array:
    return ranking.likelihood.in_time(evidence.basis)


def _as_well(behind: float, lost: Array, gained: Array) -> bool:
    """Not clearly less evidence, or what was held out is foretold as well."""
    little = float(lost.sum()) < LEVELS.alike * float(gained.sum())
    alike = len(lost) > 1 and standard_errors(lost) < LEVELS.apart and little
    return behind < LEVELS.clear or alike
