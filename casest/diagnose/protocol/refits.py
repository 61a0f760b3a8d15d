"""Causes refitted, and which of several that explain alike comes first, or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.by_row import (
    carried_by_few,
    chance_by_row,
    chance_together,
    most_there,
)
from casest.diagnose.evidence.input_noise import at_most, feigned_by_refit
from casest.diagnose.evidence.linear import Linear, alike
from casest.diagnose.evidence.rises import of_squares, rises
from casest.diagnose.evidence.score import (
    Evidence,
    Trial,
    expected_loss,
    judged,
    priced,
    shared_chance,
    with_chance,
)
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.louder import louder
from casest.diagnose.protocol.confirming import falls, falls_of_refit, falls_with, holds_out
from casest.diagnose.protocol.ranking import sharpened, without_feigned
from casest.diagnose.protocol.state import LOUDER, F, Ranking, Refit, State
from casest.diagnose.protocol.subject import Subject

#: Why a cause in poses is not added.
FEW_ROWS = "a row or a few may carry it: by its size without each of them, chance has p = {:.2g}"
#: Why an influence in a series is not.
FEW_OF_MANY = "one in a hundred rows or fewer carry it: look at those that are far out first"
#: Why what somebody asked for is not: noise, that of the inputs, or what was held out.
NONE_OF_IT = "no more of it than noise like what is left would have (p = {:.2g})"
FEIGNED = "no more of it than noise of the inputs would have (p = {:.2g})"
NOT_HELD_OUT = "held-out data do not confirm it"
#: Why what holds out and has strong evidence is not added.
AS_MUCH = "a slow course of unknown cause explains as much"
#: Why what a table shows is not, where no time says how long its rows remember.
TOGETHER = "neighbouring rows go together: its size is not as sure as the F test has it"


def refitted(
    subject: Subject[F], state: State[F], ranking: Ranking, options: Sequence[Evidence]
) -> tuple[State[F], list[Refit[F]]]:
    """Causes by what their refits are worth; of equal ones first what would do the least harm.

    The state says which refits fail.
    """
    fits: list[tuple[Evidence, F]] = []
    for evidence in _with_parts(options[: LEVELS.contenders], ranking):
        evidence = sharpened(subject, state.fit, ranking, evidence)
        better = subject.refit(state.fit, evidence.trials)
        if isinstance(better, str):
            state = state.failing(evidence, better)
        else:
            fits.append((evidence, better))
    refits = [fit for _, fit in fits]
    gains = subject.rises(state.fit, refits) if fits else []
    even = _where_noise_is_louder(subject, state.fit, ranking, refits, gains)
    slow = (refits and subject.rises_beside_a_wander(state.fit, refits)) or gains
    found: list[Refit[F]] = []
    asked = max(sum(subject.asked(e.trials[0].what) for e, _ in fits), 1)
    for (evidence, better), gain, *noisier in zip(fits, gains, even, slow, strict=True):
        evidence = _charged(subject, state.fit, evidence, better)
        kept = _gaining(evidence, gain)
        if subject.asked(evidence.trials[0].what):
            gain = min(gain, noisier[0])
            shared = asked * evidence.trials[0].choices
            kept = with_chance(_gaining(evidence, gain), ranking.likelihood, shared)
            plain = _gaining(evidence, gain + evidence.feigned)
            chance = with_chance(plain, ranking.likelihood, shared).p_value
            why = NONE_OF_IT.format(chance) if chance >= LEVELS.chance else ""
            why = why or _refused(kept, subject.linear(state.fit), subject.linear(better))
            if why:
                state = state.failing(evidence, why)
            else:
                found.append(Refit(state.fit, better, kept))
            continue
        kept = with_chance(kept, ranking.likelihood, ranking.families)
        least = _gaining(evidence, min(noisier))
        enough = beyond_courses(ranking, kept) and _strong(ranking, least)
        few = _by_few_rows(subject, state.fit, ranking, kept, better) if enough else ""
        if enough and not few:
            found.append(Refit(state.fit, better, kept))
        elif few:
            state = state.failing(evidence, few)
        elif len(evidence.trials) == 1 and _strong(ranking, kept):
            loud = not _strong(ranking, _gaining(evidence, noisier[0]))
            state = state.refusing(evidence.trials[0].what, LOUDER if loud else AS_MUCH)
    found.sort(key=lambda r: -r.evidence.score)
    near = [r.evidence for r in _near(found)]
    if len(near) > 1:
        loss, _ = expected_loss(near, ranking.likelihood)
        # Of equal ones the first of the catalogue: what is met more often.
        usual = [min(ranking.order.get(f, 0) for f in e.families) for e in near]
        best = found[min(range(len(near)), key=lambda k: (float(f"{loss[k]:.3g}"), usual[k]))]
        found = [best, *[r for r in found if r is not best]]
    return state, _plainest_first(found, ranking)


def _refused(evidence: Evidence, before: Linear, after: Linear) -> str:
    """Why what somebody says is there is none, by the F test of its refit; else empty."""
    if evidence.p_value >= LEVELS.chance:
        return FEIGNED.format(evidence.p_value)
    if before.residual.shape != after.residual.shape:
        return ""
    if not before.coloured and chance_together(before, after) >= LEVELS.chance:
        return TOGETHER
    return NOT_HELD_OUT if falls_of_refit(before, after)["pieces"].ratio >= 1 else ""


def _by_few_rows(subject: Subject[F], less: F, ranking: Ranking, evidence: Evidence, fit: F) -> str:
    """Why it is none where it hangs on a few rows; empty where it is seen whatever the sizes of
    their errors are, what is there in every row of a series in many of them."""
    before, after = subject.compared(less, fit)
    if after.residual.shape != before.residual.shape:
        return ""
    influence = all(subject.everywhere(t.what) for t in evidence.trials)
    if before.series and influence and carried_by_few(before, after):
        return FEW_OF_MANY
    chance = chance_by_row(before, after)
    chance = shared_chance(chance, evidence, ranking.families)
    return "" if chance < LEVELS.chance else FEW_ROWS.format(chance)


def _charged(subject: Subject[F], before: F, evidence: Evidence, fit: F) -> Evidence:
    """With what noise of the inputs may feign of this refit, in the place of its columns."""
    gain = feigned_between(subject, before, fit)
    if gain is None:
        return evidence
    own = at_most(gain, evidence.explained.left.size) / len(evidence.trials)
    return replace(evidence, trials=tuple(replace(t, feigned=own) for t in evidence.trials))


def feigned_between(subject: Subject[F], before: F, after: F) -> float | None:
    """What noise of the inputs gains in a refit on average; None where there is no saying."""
    one, other = subject.linear(before), subject.linear(after)
    gains = [feigned_by_refit(one, other, draws) for draws in subject.noise_in(before, after)]
    found = max((g for g in gains if g is not None), default=None)
    return min(found, subject.gained_backward(before, after)) if found else found


def _gaining(evidence: Evidence, gain: float) -> Evidence:
    """With what its refit gains."""
    gain -= evidence.feigned
    return replace(evidence, gain=gain, score=evidence.score - evidence.gain + gain)


def _where_noise_is_louder(
    subject: Subject[F], less: F, ranking: Ranking, fits: Sequence[F], gains: Sequence[float]
) -> list[float]:
    """The gains of refits where readings in bursts of noise count as less; as they are without.

    In a burst of a few readings the largest are on one side by chance, and any event is seen.
    """
    before, after = ranking.linear, [subject.linear_in(less, fit) for fit in fits]
    same = [x.residual.shape == before.residual.shape for x in after]
    if not before.series or not after or not all(same):
        return list(gains)
    size = louder(before.residual, before.spans)
    if np.any(size > 1):
        gains = rises(before.evened(size), [x.evened(size) for x in after])
    pairs = [subject.compared(less, fit) for fit in fits]
    most = [most_there(one.residual, other.residual) for one, other in pairs]
    return [min(pair) for pair in zip(gains, most, strict=True)]


def _strong(ranking: Ranking, evidence: Evidence) -> bool:
    return evidence.score > (LEVELS.strong if ranking.linear.series else 0.0)


def beyond_courses(ranking: Ranking, evidence: Evidence) -> bool:
    """Is it strong evidence, clearly more than a course of unknown cause has, or beside one?

    Of a pair each is asked beside the other: what one explains is no merit of the other.
    """
    if not _strong(ranking, evidence):
        return False
    if len(evidence.trials) == 1:
        courses = _against(ranking.descriptions, evidence.trials[0])
        return all(_more_than(c, evidence, ranking) for c in courses[:1])
    for trial in evidence.trials:
        others = [t for t in evidence.trials if t is not trial]
        beside = (_together(c, others, ranking) for c in _against(ranking.courses, trial))
        best = max((e for e in beside if e), key=lambda e: e.score, default=None)
        if best is not None and not _more_than(best, evidence, ranking):
            return False
    return True


def _against(courses: Sequence[Evidence], trial: Trial) -> list[Evidence]:
    """Those that a cause must lead: what begins at a moment of its own only where it does as well,
    since nearly any slow cause looks like that."""
    return [c for c in courses if trial.event or not c.trials[0].event]


def _more_than(course: Evidence, evidence: Evidence, ranking: Ranking) -> bool:
    if evidence.score > course.score + LEVELS.clear or _foretells(course, evidence, ranking):
        return True
    own = [t for t in evidence.trials if not any(t is c for c in course.trials)]
    both = _together(course, own, ranking)
    return both is not None and both.score > course.score + LEVELS.strong


def _foretells(course: Evidence, evidence: Evidence, ranking: Ranking) -> bool:
    """Is it as likely, and are whole stretches foretold much better than by the course, or by
    nothing? A course bends as the record does, and ends with what was seen of it."""
    if not ranking.linear.series or evidence.score < course.score:
        return False
    its, own = (falls(ranking, e)["stretches"].ratio for e in (course, evidence))
    return own < LEVELS.nested * min(its, 1.0)


def _together(course: Evidence, trials: Sequence[Trial], ranking: Ranking) -> Evidence | None:
    return judged([*course.trials, *trials], ranking.likelihood, ranking.none,
                  start=course.explained, families=ranking.families)  # fmt: skip


def _with_parts(options: Sequence[Evidence], ranking: Ranking) -> list[Evidence]:
    """What comes in pairs alone as well, if it holds out: a refit may need one of them only."""
    alone = {e.trials[0].family: e for e in ranking.found}
    pairs = [e for e in options if len(e.trials) > 1]
    parts = {id(e): e for pair in pairs for e in (alone[t.family] for t in pair.trials)}
    own = {id(e) for e in options}
    more = [
        e
        for e in parts.values()
        if id(e) not in own and ranking.says(e) and holds_out(falls(ranking, e), ranking.linear)
    ]
    return [*options, *more]


def _plainest_first(refits: list[Refit[F]], ranking: Ranking) -> list[Refit[F]]:
    """What the first one contains, and explains as much or foretells as much, comes before it: also
    what does the same with fewer unknowns, of which a record tells no more."""
    if not refits:
        return refits
    first = refits[0].evidence
    inside = [
        r
        for r in refits[1:]
        if _plainer(r.evidence, first)
        and (
            r.evidence.score > first.score - LEVELS.strong
            or _foretells_as_much(r.evidence, first, ranking)
        )
    ]
    if not inside:
        return refits
    best = max(inside, key=lambda r: r.evidence.score)
    return [best, *[r for r in refits if r is not best]]


def _plainer(one: Evidence, other: Evidence) -> bool:
    """Is one a part of the other, or the same with fewer unknowns?"""
    if one.freedom < other.freedom:
        return _contains(other, one)
    fewer = _unknowns(one) < _unknowns(other)
    return one.freedom == other.freedom and fewer and _nested(one.basis, other.basis)


def _unknowns(evidence: Evidence) -> int:
    """Sizes that it has, whether the record tells them or not."""
    return sum(t.columns.shape[2] for t in evidence.trials)


def _foretells_as_much(plain: Evidence, other: Evidence, ranking: Ranking) -> bool:
    """Is what is held out foretold as well, but for what is printed as nothing of that? Beside slow
    noise a likelihood may ask for a bend of which it knows nothing."""
    if not ranking.linear.series:
        return False
    ours, theirs = falls(ranking, plain), falls(ranking, other)
    least = 1 - LEVELS.told_share
    return all(1 - f.ratio > least * (1 - theirs[k].ratio) for k, f in ours.items())


def _contains(wide: Evidence, narrow: Evidence) -> bool:
    """Are the columns of one a combination of those of the other?"""
    beyond = narrow.basis - wide.basis @ (wide.basis.T @ narrow.basis)
    return bool(np.sum(beyond**2) < LEVELS.nested * narrow.freedom)


def _different(refits: Sequence[Refit[F]]) -> list[Refit[F]]:
    """Those of which none does all that an earlier one does, nor the other way round."""
    found: list[Refit[F]] = []
    for refit in refits:
        own = refit.evidence.basis
        if not any(_nested(own, other.evidence.basis) for other in found):
            found.append(refit)
    return found


def _nested(one: Array, other: Array) -> bool:
    """Does what orthonormal columns (n, k) span contain what the others do?"""
    wide, narrow = (one, other) if one.shape[1] >= other.shape[1] else (other, one)
    return bool(np.linalg.norm(narrow - wide @ (wide.T @ narrow)) < 1e-3)


def _near(refits: Sequence[Refit[F]]) -> list[Refit[F]]:
    """Those that the evidence does not tell from the best."""
    best = max((r.evidence.score for r in refits), default=0.0)
    return [r for r in refits if r.evidence.score > best - LEVELS.clear]


def torn_between(refits: Sequence[Refit[F]], ranking: Ranking) -> list[Refit[F]]:
    """Causes of which each, were it the wrong one, would do more harm than none of them.

    That is, leave the declared parameters further off: what is added hangs on which it is. Causes
    that predict the same whatever their sizes are one model, which is called so or otherwise.
    """
    near = _different(_near(refits))
    if len(near) < 2:
        return []
    loss, none = expected_loss([r.evidence for r in near], ranking.likelihood)
    left = np.exp(-near[0].evidence.gain / len(ranking.likelihood.residual))
    noise = float(np.mean(ranking.likelihood.residual**2 * left))
    return near if none < loss.min() and loss.min() > noise else []


def best_refits(
    refits: Sequence[Refit[F]], more: Sequence[Refit[F]], order: Mapping[str, int]
) -> list[Refit[F]]:
    """All of them. The first stays, unless one of the others is clearly worth more; of others that
    are worth as much the first of the catalogue: what is met more often."""
    top = max((r.evidence.score for r in more), default=0.0)

    def place(refit: Refit[F]) -> tuple[float, float]:
        score = refit.evidence.score
        if score > top - LEVELS.strong:
            return -top, min(order.get(f, 0) for f in refit.evidence.families)
        return -score, 0.0

    several = [*refits, *sorted(more, key=place)]
    if refits and more:
        best = several[len(refits)]
        if best.evidence.score > refits[0].evidence.score + LEVELS.clear:
            return [best, *[r for r in several if r is not best]]
    return several


def _by_squares(
    subject: Subject[F], state: State[F], ranking: Ranking, evidence: Evidence, fit: F
) -> Evidence:
    """By what its refit takes of the squares, less what noise of the inputs may feign of these: a
    likelihood beside smooth noise weighs what is quick, and that may be all noise. Of as many
    samples as are independent, which set the price of an unknown as well."""
    plain = ranking.likelihood.plainly(evidence.beyond)
    seen = replace(evidence, explained=plain, score=np.inf)
    (seen,) = without_feigned(subject, state.fit, ranking.likelihood, [seen], ranking.families)
    before, after = alike([ranking.linear, subject.linear(fit)])
    count, rise = of_squares(before, after)
    share = min(1.0, count / ranking.likelihood.residual.size)
    trials = tuple(replace(t, feigned=share * t.feigned) for t in seen.trials)
    return priced(replace(evidence, trials=trials), count * rise, count, ranking.families)


def shown(
    subject: Subject[F], state: State[F], ranking: Ranking, beside: Sequence[Refit[F]]
) -> tuple[State[F], list[Refit[F]], list[Refit[F]]]:
    """What the records show by themselves, and what takes most of the squares though it is no
    likelier (a slow residual is likely as it is), refitted: held-out parts by the refit itself.

    And what leaves less than half of all that is held out, though what is slow may do so by chance.
    """
    found, halving = list[Refit[F]](), list[Refit[F]]()
    there = {f for r in beside for f in r.evidence.families}
    most = [t for t in ranking.most if t.family not in there][: LEVELS.contenders]
    for trial in (*subject.shown(state.fit), *most):
        evidence = judged([trial], ranking.likelihood, ranking.none, families=ranking.families)
        if evidence is not None:
            (evidence,) = without_feigned(
                subject, state.fit, ranking.likelihood, [evidence], ranking.families
            )
        small = evidence is None or (evidence.score <= 0 and evidence.beyond.share < LEVELS.most)
        if trial.what.held and small:
            continue  # its columns are those of that very value: nothing to wait for from a refit
        better = subject.refit(state.fit, [trial])
        if evidence is None or isinstance(better, str):
            state = state if evidence is None else state.failing(evidence, str(better))
            continue
        gain, *_ = subject.rises(state.fit, [better, *(r.fit for r in beside)])
        evidence = _charged(subject, state.fit, evidence, better)
        kept = _gaining(evidence, gain)
        if not _strong(ranking, kept):
            kept = _by_squares(subject, state, ranking, evidence, better)
        # Its columns say little of it: the chance is that of its refit.
        kept = with_chance(kept, ranking.likelihood, ranking.families)
        seen = falls_with(subject, state, ranking, kept, better)
        clear = beyond_courses(ranking, kept) and ranking.stands_out(kept)
        clear = clear and holds_out(seen, ranking.linear)
        halves = all(f.ratio < LEVELS.most for f in seen.values())
        if not (clear or halves):
            continue
        if few := _by_few_rows(subject, state.fit, ranking, kept, better):
            state = state.failing(evidence, few)
        else:
            (found if clear else halving).append(Refit(state.fit, better, kept, seen))
    return state, found, halving
