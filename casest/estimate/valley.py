"""Is it the right valley? What the rows themselves say, and a search where they leave it open.

That several starts end alike is no proof: around one start they share its error. Evidence is a
residual no larger than what rows with nearly the same inputs differ by, where these show a course;
else a search over all that the data span must have found nothing lower, and what it found must be
better than chance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from casest.estimate.certificate import Certificate
from casest.leastsquares.neighbours import Scatter, scatter
from casest.leastsquares.per_sample import linear
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import has_noise_effects
from casest.solve.aliases import folded, others, without_turns
from casest.solve.equivalent import between_rows, limit_of, roughness, same_on
from casest.solve.global_search import EFFORTS, Search, search, unlike
from casest.solve.outcome import Outcome
from casest.solve.reach import turning
from casest.solve.strategy import best_of, valleys
from casest.solve.trust_region import LITTLE, trust_region

#: Chance of noise from which on the residual is as large as neighbours say (no search), and below
#: which it is larger than they say (a misfit).
AS_LARGE, LARGER = 0.01, 1e-3
#: And variance of the residual over that of neighbours up to which these vouch for it.
MOST = 1.5
#: Share of the readings' spread that neighbours must show as a course to vouch for a valley.
COURSE = 0.75
#: Share of that course that a model must explain for its valley to be believed beside a misfit.
EXPLAINED = 0.5
#: And from which on there is too little left to go on looking for more.
LITTLE_LEFT = 0.9
#: Chance, over all valleys seen, of explaining so much by accident.
ACCIDENT = 1e-3
#: Half turns between neighbouring rows that these can still follow.
FASTEST = 1.2
#: Times that a search must have come to one valley from different places.
AGAIN = 3


@dataclass(frozen=True)
class Evidence:
    """For a valley: the scatter of neighbours at the best point, and the search, where one was.

    `equal`: other points that are the same function of the inputs; `aliases`: rates that the rows
    cannot tell from those given.
    """

    scatter: Scatter | None
    search: Search | None = None
    equal: tuple[Point, ...] = ()
    aliases: tuple[str, ...] = ()

    @property
    def vouched(self) -> bool:
        """Do the neighbours by themselves say that nothing is left, and could they tell?"""
        found = self.scatter
        if found is None:
            return False
        exact = found.explained > 1 - 1e-9
        # Few rows refuse little: as large means so in size too.
        as_large = found.p_value() >= AS_LARGE and found.residual <= MOST * found.neighbours
        return exact or (as_large and found.resolved >= COURSE)

    @property
    def settled(self) -> bool:
        """Is there no reason to look any further?"""
        found = self.scatter
        if self.vouched:
            return True
        little = found is None or found.explained >= LITTLE_LEFT * found.resolved
        return _against(self, 0) is None and (little or not self.misfit)

    @property
    def misfit(self) -> bool:
        """Is there something left that rows with nearly the same inputs share?"""
        found = self.scatter
        return found is not None and min(found.p_value(), found.p_value(left=True)) < LARGER


def looked_for(
    problem: Problem, first: Point, outcomes: tuple[Outcome, ...], seed: int, stated: bool
) -> tuple[tuple[Outcome, ...], Evidence | None]:
    """The outcomes with the lowest that a search found in front, and the evidence.

    None for models that have their own start from the data, are linear in all unknowns or predict
    no reading row by row. `stated`: the start is the user's own.
    """
    if not _searchable(problem) or not np.isfinite(best_of(outcomes).cost):
        return outcomes, None
    allowed = _rows_can_follow(problem, first, stated)
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


def _rows_can_follow(problem: Problem, first: Point, stated: bool) -> Callable[[Point], bool]:
    """May a solution count? No faster than the rows can follow, or the declared start is."""
    fastest = max(FASTEST, turning(problem, first))
    return lambda point: stated or turning(problem, point) <= fastest


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
        if found.outcome is not best:
            outcomes, best = (found.outcome, *outcomes), found.outcome
        evidence = Evidence(scatter(problem, best.point), found)
        if evidence.settled:
            break
    return (*outcomes, *found.rivals), evidence


def _in_one_form(
    problem: Problem, first: Point, outcomes: tuple[Outcome, ...], stated: bool
) -> tuple[tuple[Outcome, ...], tuple[Point, ...]]:
    """Outcomes that predict on all rows as the best does, as one; and what else it may be called.

    Of aliases, which agree on the rows only, the smoothest is meant, unless a start is `stated`;
    of equal functions the one most like the start.
    """
    best = best_of(outcomes)
    limit = limit_of(problem, best)
    alike = [o for o in outcomes if o is best or same_on(problem, o.point, best.point, limit)]
    if all(_near(o.point, best.point) for o in alike):
        return outcomes, ()
    moved, meant = between_rows(problem), best
    rough = [roughness(problem, moved, o.point) for o in alike]
    own = roughness(problem, moved, best.point) if stated else min(rough)
    smooth = [o for o, size in zip(alike, rough, strict=True) if abs(size - own) <= 0.1 * own]
    like = min(smooth, key=lambda o: unlike(o.point.x, first.x))
    if not _near(like.point, best.point):
        meant = trust_region(problem, like.point, damping=LITTLE)
    turned = [replace(o.point, x=without_turns(problem, o.point, meant.point)) for o in alike]
    named = [
        p for p in turned if not _near(p, meant.point) and same_on(moved, p, meant.point, limit)
    ]
    known = {id(o) for o in alike}
    as_one = [
        replace(o, point=meant.point, cost=meant.cost) if id(o) in known else o for o in outcomes
    ]
    return (tuple(as_one) if meant is best else (meant, *as_one)), tuple(named[:1])


def _near(a: Point, b: Point) -> bool:
    """Are two points one solution, ended at to different precision?"""
    return bool(np.all(np.abs(a.x - b.x) <= 0.05 * np.maximum(np.abs(a.x), np.abs(b.x))))


def _searchable(problem: Problem) -> bool:
    model = problem.model
    return not (
        model.starter is not None
        or model.implicit
        or problem.sequential
        or has_noise_effects(model)
        or linear(model)
    )


def judged(problem: Problem, certificate: Certificate, evidence: Evidence | None) -> Certificate:
    """The certificate in the light of the evidence: refused, or with one more reason."""
    if evidence is None or not certificate.trusted:
        return certificate
    against = _rival(problem, evidence) or _against(evidence, certificate.agreeing)
    if against is not None:
        return replace(certificate, trusted=False, reasons=(against,))
    found = evidence.search
    if found is not None:
        more = (
            f"no lower valley in a search over what the data span: {found.places} places, of "
            f"{found.followed} followed {found.arrived} ended here"
        )
    elif certificate.agreeing < certificate.starts and evidence.vouched:
        more = "the residual is no larger than what rows with nearly the same inputs differ by"
    else:
        return certificate
    return replace(certificate, reasons=(*certificate.reasons, more))


def _against(evidence: Evidence, agreeing: int) -> str | None:
    """What speaks against the valley, in words; None where nothing does.

    `agreeing` starts around the first one ended there, beside those of the search.
    """
    found, looked = evidence.scatter, evidence.search
    if looked is None or evidence.vouched:
        return None
    advice = "give --start near the solution, bounds, or more rows"
    most = looked.arrived >= 0.5 * looked.followed
    if found is None:
        if most or looked.arrived + agreeing >= AGAIN:
            return None
        return (
            f"{looked.followed} starts over what the data span ended in {looked.valleys} places, "
            f"{looked.arrived} of them here: there may be a better one; {advice}"
        )
    if evidence.misfit:
        enough = found.explained >= EXPLAINED * max(found.resolved, 0.0)
        if most or (enough and looked.arrived + agreeing >= AGAIN):
            return None
        return (
            f"it explains {100 * max(found.explained, 0.0):.0f} % of the readings' variance, of "
            f"which rows with nearly the same inputs share {100 * found.resolved:.0f} %, and a "
            f"search over {looked.places} places found nothing better: a wrong valley, or a wrong "
            f"model; {advice}"
        )
    if most or _accident(found, looked) < ACCIDENT:
        return None
    return (
        f"no better than chance: {looked.valleys} valleys were seen, and the best explains "
        f"{100 * max(found.explained, 0.0):.0f} % of the readings' variance; {advice}"
    )


def _rival(problem: Problem, evidence: Evidence) -> str | None:
    """Another valley that the data do not refuse at a level of 0.001, in words."""
    looked = evidence.search
    if looked is None or evidence.vouched or not looked.rivals:
        return None
    here, there = looked.outcome.point.x, looked.rivals[0].point.x
    i = int(np.argmax(np.abs(there - here) / np.maximum(np.abs(here), np.abs(there))))
    return (
        f"two valleys fit nearly alike: `{problem.names[i]}` = {here[i]:.6g} and {there[i]:.6g}; "
        "give bounds that leave out one of them, or more rows"
    )


def _accident(found: Scatter, looked: Search) -> float:
    """Chance that the best of so many valleys explains so much of mere noise."""
    from scipy.special import fdtrc

    freedom = found.freedom[0]
    gained = found.spread * (freedom + looked.bent) - found.residual * freedom
    F = gained / looked.bent / found.residual if found.residual > 0 else np.inf
    return float(fdtrc(looked.bent, freedom, max(F, 0.0)) * looked.valleys)


def remarks(problem: Problem, evidence: Evidence | None) -> Iterator[str]:
    """That something is left which neighbours share; that there are equal solutions elsewhere."""
    if evidence is None:
        return
    if evidence.search is not None and evidence.scatter is not None and evidence.misfit:
        yield _misfit(evidence.scatter)
    if evidence.aliases:
        yield (
            f"evenly spaced rows cannot tell rates that turn whole turns more from one row to the "
            f"next: {', '.join(evidence.aliases)} (and multiples) fits alike; what is given is "
            "the slowest, or that at the stated start; bounds leave the others out"
        )
    if evidence.equal:
        there = ", ".join(
            f"`{name}` = {x:.6g}"
            for name, x in zip(problem.names, evidence.equal[0].x, strict=True)
        )
        yield (
            f"other values are the same function of the inputs ({there}): of such equal solutions "
            "the one most like the start is given"
        )


def _misfit(found: Scatter) -> str:
    times = np.sqrt(found.residual / max(min(found.neighbours, found.left), 1e-300))
    return (
        f"misfit: the residual is {times:.3g} times what rows with nearly the same inputs differ "
        "by, and no better valley was found: the model lacks something (casest close looks for "
        "it), or the noise is alike in neighbouring rows"
    )
