"""Are parts that were held out foretold better with a cause?"""

from __future__ import annotations

from collections.abc import Sequence

from casest.diagnose.evidence.held_out import Fall, fall, fall_between
from casest.diagnose.evidence.linear import Linear, alike
from casest.diagnose.evidence.score import Evidence
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.state import F, Ranking, State
from casest.diagnose.protocol.subject import Subject

#: Parts that are held out whole.
FAR_AWAY = ("stretches", "regions")


def falls(ranking: Ranking, evidence: Evidence) -> dict[str, Fall]:
    """What the columns of a cause do to each kind of held-out squares."""
    columns = [ranking.likelihood.in_time(evidence.basis)]
    return {k: fall(ranking.linear, columns, p) for k, p in ranking.linear.parts.each.items()}


def falls_of_refit(before: Linear, after: Linear) -> dict[str, Fall]:
    """Held-out squares of two fits, each near its own optimum."""
    before, after = alike([before, after])
    return {k: fall_between(before, after, parts) for k, parts in before.parts.each.items()}


def falls_with(
    subject: Subject[F], state: State[F], ranking: Ranking, evidence: Evidence, fit: F
) -> dict[str, Fall]:
    """What a cause does to each kind of held-out squares by its refit, in the deviations of the fit
    without it; by its columns where the refit is one to other rows, as where readings came late."""
    after = subject.linear_in(state.fit, fit)
    if after.residual.shape != ranking.linear.residual.shape:
        return falls(ranking, evidence)
    return falls_of_refit(ranking.linear, after)


def holds_out(found: dict[str, Fall], linear: Linear) -> bool:
    """Are pieces, whole stretches and whole regions foretold better?

    From part to part where there are parts enough; a region may be foretold worse by chance alone.
    """
    if not linear.series:
        return found["pieces"].ratio < 1
    steady = min(found["pieces"].t, found["stretches"].t) > LEVELS.confirmed
    return steady and all(f.ratio < 1 for f in found.values())


def passing(ranking: Ranking, options: Sequence[Evidence]) -> list[Evidence]:
    """Those that hold out, down to where none has any weight beside the best of them.

    A linear promise may be far from a refit's: of causes alone the first few count in any case.
    None in the place of one that explains more wherever it is held out, though too unevenly to be
    confirmed.
    """
    found: list[Evidence] = []
    uneven: list[tuple[Evidence, dict[str, Fall]]] = []
    alone = 0
    for evidence in options:
        far = bool(found) and evidence.score < found[0].score - 2 * LEVELS.strong
        several = len(evidence.trials) > 1
        if far and (several or alone >= LEVELS.contenders):
            continue
        alone += not several
        seen = falls(ranking, evidence)
        if not holds_out(seen, ranking.linear):
            if not several and ranking.linear.series:
                uneven.append((evidence, seen))
            continue
        if any(_in_its_place(evidence, seen, *other) for other in uneven):
            continue
        if several and not _better_than_its_parts(evidence, seen, ranking):
            continue
        found.append(evidence)
    return found


def _in_its_place(
    evidence: Evidence, seen: dict[str, Fall], more: Evidence, its: dict[str, Fall]
) -> bool:
    """Would it stand for a cause that is clearly likelier, and explains more of all parts?"""
    if more.score < evidence.score + LEVELS.clear:
        return False
    return all(1 - f.ratio < (1 - LEVELS.alike) * (1 - its[k].ratio) for k, f in seen.items())


def _better_than_its_parts(both: Evidence, seen: dict[str, Fall], ranking: Ranking) -> bool:
    """Does a pair foretell much more of whole parts than each of the two alone?

    Else the better one comes first, and the other one beside it, if it is there.
    """
    names = FAR_AWAY if ranking.linear.series else ("pieces",)
    for trial in both.trials:
        (one,) = [e for e in ranking.found if e.trials[0].family == trial.family]
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
