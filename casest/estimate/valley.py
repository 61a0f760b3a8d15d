"""Is it the right valley? A search, where the rows themselves leave it open."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from casest.declaration.model import Model
from casest.estimate.evidence import Evidence
from casest.leastsquares.flow import GivenUp, for_seconds
from casest.leastsquares.neighbours import scatter
from casest.leastsquares.per_sample import linear
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import rounding
from casest.leastsquares.weights import has_noise_effects
from casest.solve.aliases import folded, others, without_turns
from casest.solve.equations import ALIKE, OPINION, SEARCH, allowed, arrived, from_elsewhere
from casest.solve.equivalent import between_rows, limit_of, roughness, same_on
from casest.solve.global_search import EFFORTS, ROWS, Search, rivals_of, search, some_rows, unlike
from casest.solve.outcome import Outcome
from casest.solve.pace import pace_of, slower, turning
from casest.solve.reach import neighbouring
from casest.solve.reach import turning as turning_of_rows
from casest.solve.strategy import best_of, valleys
from casest.solve.trust_region import LITTLE, trust_region

#: Costs that differ by no more than this share are those of one function under two names.
EQUAL = 1e-9
#: Half turns between neighbouring rows that these can still follow.
FASTEST = 1.2


def looked_for(
    problem: Problem, first: Point, outcomes: tuple[Outcome, ...], seed: int, stated: bool
) -> tuple[tuple[Outcome, ...], Evidence | None]:
    """The outcomes with the lowest that a search found in front, and the evidence.

    None for models that have their own start from the data, are linear in all unknowns or predict
    no reading row by row. `stated`: the start is the user's own.
    """
    if problem.model.traced.integrates and np.isfinite(best_of(outcomes).cost):
        return _looked_for_in_equations(problem, first, outcomes, seed, stated)
    if not searchable(problem.model) or not np.isfinite(best_of(outcomes).cost):
        return outcomes, None
    allowed = rows_can_follow(problem, first, stated)
    # A sine that turns at random from row to row is fitted to noise as well as to anything.
    outcomes = tuple(o for o in outcomes if allowed(o.point)) or outcomes
    best = best_of(outcomes)
    evidence = Evidence(scatter(problem, best.point))
    if not (evidence.vouched or (evidence.scatter is None and valleys(outcomes) == 1)):
        outcomes, evidence = _searched(problem, first, outcomes, seed, allowed)
    if not stated:
        outcomes = (*outcomes, *folded(problem, first, best_of(outcomes)))
    outcomes, equal = _in_one_form(problem, first, outcomes, stated)
    aliases = tuple(others(problem, best_of(outcomes).point))
    return outcomes, replace(evidence, equal=equal, aliases=aliases)


def _looked_for_in_equations(
    problem: Problem, first: Point, outcomes: tuple[Outcome, ...], seed: int, stated: bool
) -> tuple[tuple[Outcome, ...], Evidence]:
    """The same of differential equations: unless readings vouch, ways from starts elsewhere; and
    in any case the course found at a slower pace, which readings would vouch for as well."""
    found, ends = None, list[Outcome]()
    evidence = Evidence(scatter(problem, best_of(outcomes).point))
    if not evidence.vouched and problem.model.starter is None:
        outcomes, found, ends = _from_elsewhere(problem, first, outcomes, seed)
    known = best_of(outcomes)
    outcomes, alias = _at_one_pace(problem, first, outcomes, ends, stated)
    best = best_of(outcomes)
    if best is not known:
        found = None if found is None else replace(found, outcome=best)
    if found is not None or best is not known:
        evidence = Evidence(scatter(problem, best.point), found)
    return outcomes, replace(evidence, aliases=alias)


def _from_elsewhere(
    problem: Problem, first: Point, outcomes: tuple[Outcome, ...], seed: int
) -> tuple[tuple[Outcome, ...], Search, list[Outcome]]:
    """The outcomes with the lowest in front, the search, and where its starts ended."""
    best = best_of(outcomes)
    ends, given_up = from_elsewhere(problem, first, outcomes, seed, allowed(outcomes, SEARCH))
    lowest = best_of((best, *ends))
    if lowest is not best:
        best = trust_region(problem, lowest.point, damping=LITTLE)
        outcomes = (best, *outcomes)
    finite = [o for o in ends if np.isfinite(o.cost)]
    found = Search(
        best,
        len(ends),
        len(ends),
        arrived(best, finite),
        valleys((best, *finite)),
        problem.unknowns,
        rivals_of(problem, best, finite),
        given_up,
    )
    return outcomes, found, finite


def _at_one_pace(
    problem: Problem,
    first: Point,
    outcomes: tuple[Outcome, ...],
    ends: list[Outcome],
    stated: bool,
) -> tuple[tuple[Outcome, ...], tuple[str, ...]]:
    """Outcomes whose courses agree in all rows and not between them, as one; and another, in words.

    The slowest is meant, or that most like a start that was `stated`. Also `ends` that a search
    has led to are looked at.
    """
    if not stated:
        with suppress(GivenUp), for_seconds(OPINION):  # else it is not asked
            outcomes = (*outcomes, *slower(problem, best_of(outcomes)))
    best = best_of(outcomes)
    far = [o for o in (*outcomes, *ends) if o.cost <= best.cost * (1 + ALIKE) + 1e-300]
    far = [o for o in far if not _near(o.point, best.point)]
    if not far:
        return outcomes, ()
    limit, moved = limit_of(problem, best), between_rows(problem)
    far = [o for o in far if same_on(problem, o.point, best.point, limit)]
    far = [o for o in far if not same_on(moved, o.point, best.point, limit)]
    # What had only stopped on its way along a flat valley is no other course.
    there = [trust_region(problem, o.point, damping=LITTLE) for o in far]
    both = [(o, e) for o, e in zip(far, there, strict=True) if not _near(e.point, best.point)]
    if not both:
        return outcomes, ()

    def pace(o: Outcome) -> float:
        if stated:
            return unlike(o.point.x, first.x)[1]
        if pace_of(problem.model) is None:
            return roughness(problem, moved, o.point)
        return turning(problem, o.point)

    meant = min((best, *(e for _, e in both)), key=pace)
    other = next(o for o in (*(e for _, e in both), best) if not _near(o.point, meant.point))
    alike = {id(o) for o, _ in both} | {id(o) for o in outcomes if _near(o.point, best.point)}
    as_one = [
        replace(o, point=meant.point, cost=meant.cost) if id(o) in alike else o for o in outcomes
    ]
    pairs = zip(problem.names, other.point.x, strict=True)
    return (meant, *as_one), (", ".join(f"`{name}` = {x:.6g}" for name, x in pairs),)


def rows_can_follow(problem: Problem, first: Point, stated: bool) -> Callable[[Point], bool]:
    """May a solution count? No faster than the rows can follow, or the declared start is."""
    near = neighbouring(problem)
    fastest = max(FASTEST, turning_of_rows(problem, first, near))
    return lambda point: stated or turning_of_rows(problem, point, near) <= fastest


def _searched(
    problem: Problem,
    first: Point,
    outcomes: tuple[Outcome, ...],
    seed: int,
    allowed: Callable[[Point], bool],
) -> tuple[tuple[Outcome, ...], Evidence]:
    best = best_of(outcomes)
    for effort in EFFORTS:
        found = search(problem, first, best, seed, effort, allowed)
        best = found.outcome
        evidence = Evidence(scatter(problem, best.point), found)
        if evidence.settled:
            break
    return (best, *outcomes, *found.rivals), evidence


def _in_one_form(
    problem: Problem, first: Point, outcomes: tuple[Outcome, ...], stated: bool
) -> tuple[tuple[Outcome, ...], tuple[Point, ...]]:
    """Outcomes that predict on all rows as the best does, as one; and what else it may be called.

    Of aliases, which agree on the rows only, the smoothest is meant, unless a start is `stated`;
    of equal functions the one most like the start.
    """
    best = best_of(outcomes)
    limit = limit_of(problem, best)
    whole, problem = problem, some_rows(problem, ROWS)
    alike = [o for o in outcomes if o is best or same_on(problem, o.point, best.point, limit)]
    alike = _equal(whole, best, alike)
    if all(_near(o.point, best.point) for o in alike):
        return outcomes, ()
    moved, meant = between_rows(problem), best
    rough = [roughness(problem, moved, o.point) for o in alike]
    own = roughness(problem, moved, best.point) if stated else min(rough)
    smooth = [o for o, size in zip(alike, rough, strict=True) if abs(size - own) <= 0.1 * own]
    like = min(smooth, key=lambda o: unlike(o.point.x, first.x))
    if not _near(like.point, best.point):
        meant = trust_region(whole, like.point, damping=LITTLE)
    turned = [replace(o.point, x=without_turns(problem, o.point, meant.point)) for o in alike]
    named = [
        p for p in turned if not _near(p, meant.point) and same_on(moved, p, meant.point, limit)
    ]
    known = {id(o) for o in alike}
    as_one = [
        replace(o, point=meant.point, cost=meant.cost) if id(o) in known else o for o in outcomes
    ]
    return (tuple(as_one) if meant is best else (meant, *as_one)), tuple(named[:1])


def _equal(problem: Problem, best: Outcome, alike: list[Outcome]) -> list[Outcome]:
    """Those of them that lead to the cost of the best to rounding.

    Valleys that are only nearly the same function end at other costs: they are rivals.
    """
    within = (10 * rounding(problem, best.point)) ** 2 * problem.residual_count
    ends, found = list[Outcome](), list[Outcome]()
    for o in alike:
        end = next((e for e in (best, *ends) if _near(e.point, o.point)), None)
        if end is None:
            end = trust_region(problem, o.point, damping=LITTLE)
            ends.append(end)
        if abs(end.cost - best.cost) <= EQUAL * best.cost + within:
            found.append(o)
    return found


def _near(a: Point, b: Point) -> bool:
    """Are two points one solution, ended at to different precision?"""
    return bool(np.all(np.abs(a.x - b.x) <= 0.05 * np.maximum(np.abs(a.x), np.abs(b.x))))


def searchable(model: Model) -> bool:
    """May there be several valleys, and does nothing but a declared start say which is meant?

    What looks at other samples is not searched: some rows alone, far apart, are another record.
    """
    return not (
        model.starter is not None
        or model.implicit
        or has_noise_effects(model)
        or linear(model)
        or any(a.kind in ("sequence", "time") for a in model.effects)
        or model.traced.integrates
    )
