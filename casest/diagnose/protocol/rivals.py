"""What explains as much in the place of a cause that was added."""

from __future__ import annotations

from dataclasses import replace

from casest.declaration.shapes import Array
from casest.diagnose.evidence.held_out import Fall, fall_between_causes, foretold
from casest.diagnose.evidence.input_noise import at_most
from casest.diagnose.evidence.linear import alike
from casest.diagnose.evidence.score import Evidence, judged
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.ranking import best_first, on_its_axes, ranked_of, sharpened
from casest.diagnose.protocol.refits import feigned_between
from casest.diagnose.protocol.state import F, Kept, Ranking, Rival, State
from casest.diagnose.protocol.subject import Subject


def with_rivals(subject: Subject[F], state: State[F]) -> State[F]:
    """Each cause beside those that explain as much in its place, the others kept."""
    several = []
    for kept in state.kept:
        state, rivals = _rivals(subject, state, kept)
        several.append(replace(kept, rivals=tuple(rivals)))
    return replace(state, kept=tuple(several))


def _rivals(subject: Subject[F], state: State[F], kept: Kept) -> tuple[State[F], list[Rival]]:
    """By evidence, or by held-out stretches (Vuong 1989): a score alone does not say so."""
    apart, there = subject.apart(state.fit, kept), _without(subject, state, kept)
    if apart is None or there is None:
        return state, []
    base, ranking = there
    linear, own, slow = ranking.linear, apart[1], ranking.linear.coloured
    others = [e for e in ranking.found if e.trials[0].family != own.family]
    if own.columns.shape[:2] == linear.residual.shape:
        mine = judged([own], ranking.likelihood, ranking.none, families=ranking.families)
    else:  # rows that moved in time are others
        mine = next((e for e in ranking.found if e.trials[0].family == own.family), None)
    if mine is None:
        return state, []
    ranking = replace(ranking, found=best_first([mine, *others]))
    stretches = linear.parts.stretches
    without, best = (foretold(linear, c, stretches) for c in ([], [_in_time(ranking, mine)]))
    fall = fall_between_causes(linear, without, best)
    nothing = fall.left + fall.gained  # squares without any of them
    # What a slope does not reach as far as is asked by its refit, whatever its columns say.
    shown = {t.family for t in subject.shown(base) if t.what.held}
    # Of causes that take most of the squares of a slow residual a likelihood says little.
    most = {t.family for t in ranking.most}
    most = most if own.family in most else set()
    rivals = list[Evidence]()
    for e in sorted(ranking.causes, key=lambda e: e.trials[0].family not in most):
        if e is mine or len(rivals) == 2 * LEVELS.contenders:
            continue
        if e.trials[0].secant and e.gain > LEVELS.nested * mine.gain:
            e = sharpened(subject, base, ranking, e)  # its grid is coarse
        if not linear.series:  # each unknown costs: what was added is on its axes as well
            e = on_its_axes(subject, base, e, ranking)
        # A score is a promise: noise that was matched to what explains more may hide its worth.
        # What noise of the inputs may have of it is asked of its refit.
        score, gain = e.score + e.feigned, e.gain + e.feigned
        strong = score >= LEVELS.strong if linear.series else ranking.says(e)
        if not strong and gain < mine.gain and e.trials[0].family not in most:
            continue
        if own.family not in most and _another_thing(ranking, mine, e):
            continue
        its = foretold(linear, [_in_time(ranking, e)], stretches)
        lost = fall_between_causes(linear, its, best)
        # The columns of a grid's value promise little: a refit goes further.
        told = slow and not e.trials[0].what.held
        if e.trials[0].family in shown or _as_well(mine.score - score, lost, nothing, told):
            rivals.append(e)
    after = subject.linear(state.fit)
    found = list[Rival]()
    for e in rivals:  # what the columns promise, a refit must keep
        before = mine.score - mine.gain - (e.score - e.gain)
        place = _in_its_place(subject, state, kept, base, e, before)
        if isinstance(place, str):
            state = state.failing(e, f"in the place of {own.family} {place}")
            continue
        fit, behind = place
        other = subject.linear_in(state.fit, fit)
        again: Fall | None = None
        if {x.residual.shape for x in (linear, after, other)} == {linear.residual.shape}:
            own_errors, its_errors = (foretold(x, [], stretches) for x in alike([after, other]))
            again = fall_between_causes(after, its_errors, own_errors)
        if _as_well(behind, again, nothing, slow):
            found.append(Rival(e.trials[0].what, fit))
    return state, found


def _another_thing(ranking: Ranking, mine: Evidence, other: Evidence) -> bool:
    """Does a cause keep most of what it explains beside another one, which is none in its place?"""
    both = judged([*mine.trials, *other.trials], ranking.likelihood, ranking.none,
                  start=mine.explained, families=ranking.families)  # fmt: skip
    kept = 0.0 if both is None else both.gain + both.feigned - other.gain - other.feigned
    return kept > LEVELS.most * (mine.gain + mine.feigned)


def _without(subject: Subject[F], state: State[F], kept: Kept) -> tuple[F, Ranking] | None:
    """The fit without a cause, and all causes beside it: slopes and grids are those of that fit,
    in its own others follow it."""
    others = tuple(k.what for k in state.kept if k is not kept)
    for seen in state.rounds:
        if seen.causes == others:
            return seen.fit, seen.ranking
    base = subject.without(state.fit, kept.what)
    return None if base is None else (base, ranked_of(subject.linear(base), subject.trials(base)))


def _in_its_place(
    subject: Subject[F], state: State[F], kept: Kept, base: F, evidence: Evidence, before: float
) -> tuple[F, float] | str:
    """The better refit of two, and how far behind in score, of which `before` is the price: without
    the cause, another one may have gone far to stand in for it, and not find its way back."""
    found, why = list[tuple[F, float]](), ""
    for there in (True, False):
        if there:
            fit = subject.refit(base, evidence.trials)
        else:
            fit = subject.instead(state.fit, kept.what, evidence.trials)
        if isinstance(fit, str):
            why = why or fit
            continue
        ours, theirs = subject.rises(base, [state.fit, fit])
        behind = before + ours - theirs
        if behind >= LEVELS.clear:
            behind -= _by_noise(subject, base, state.fit, fit)
        found.append((fit, behind))
        if found[-1][1] < LEVELS.clear:
            break  # as well already
    return min(found, key=lambda f: f[1]) if found else why


def _by_noise(subject: Subject[F], base: F, own: F, other: F) -> float:
    """How much of the lead of a cause over another noise of the inputs may be."""
    (more, most), (less, _) = (_feigned(subject, base, fit) for fit in (own, other))
    return most - less if more > less else 0.0


def _feigned(subject: Subject[F], base: F, fit: F) -> tuple[float, float]:
    """What noise of the inputs gains in a refit on average, and at most."""
    gain = feigned_between(subject, base, fit) or 0.0
    return gain, at_most(gain, subject.linear(fit).residual.size)


def _in_time(ranking: Ranking, evidence: Evidence) -> Array:
    return ranking.likelihood.in_time(evidence.basis)


def _as_well(behind: float, lost: Fall | None, nothing: float, slow: bool) -> bool:
    """Not clearly less evidence, or what was held out is foretold as well.

    lost: of held-out squares, from the other's to its own; `nothing`: those without either. A cause
    may gain so much that a tenth of it is many times what it leaves: that is not as well. Nor is
    what leaves more than twice as much, where noise may be `slow`: then a likelihood says little.
    """
    if lost is None:
        return behind < LEVELS.clear
    if slow and LEVELS.most * (lost.left + lost.gained) > lost.left:
        return False
    if behind < LEVELS.clear:
        return True
    little = lost.gained < min(LEVELS.alike * (nothing - lost.left), lost.left)
    return lost.t < LEVELS.apart and little
