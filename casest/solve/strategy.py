"""How a problem is solved: the solver asked for, a polish, and second opinions.

No single run is believed. The polished solution must be found again by a trust region from the
start; where two ways disagree, more starts are tried, and always two far along the direction that
the data determine least, where a second valley would lie.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from casest.declaration.effect import OVER_TIME
from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.leastsquares.fewer import few_of
from casest.leastsquares.flow import GivenUp, for_seconds
from casest.leastsquares.identifiability import rank
from casest.leastsquares.per_sample import linear
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import has_noise_effects, weights
from casest.solve.equations import OPINION as OPINIONS
from casest.solve.equations import allowed, by_equations, by_shooting
from casest.solve.ipopt import CLOSE_BY, STANDSTILL, ipopt
from casest.solve.ipopt import PATIENCE as EVALUATIONS
from casest.solve.multipliers import kept
from casest.solve.outcome import Outcome
from casest.solve.trust_region import LITTLE, slight, trust_region

#: Iterations after which a second opinion has nothing to say.
OPINION = 50
#: Iterations in which a bent valley is followed to its end, once ways disagree.
PATIENCE = 1000
#: Evaluations by IPOPT where equations have been fitted already: where steps are chosen anew at
#: every point (`leastsquares.stiff`) its line search would fight their rounding.
LITTLE_LEFT = 60
#: More starts, and their spread as a share of each unknown: what reveals 19 of 20 false optima of
#: NIST's problems (studies/nist.md).
STARTS, SPREAD = 8, 0.3
#: Still more of them, where these did not all end alike.
FURTHER = 24
#: Ratio of the costs of a few samples from which on there is no need to look at all of them.
CLEARLY = 1.1
#: Costs that differ by more than this share are those of different valleys.
APART = 1e-3
#: Rise of the cost over that of a parabola within which there is no second valley.
PARABOLA = (0.8, 1.25)
#: Solvers of the least-squares problem.
SOLVERS = ("ipopt", "ipopt-exact", "trust-region", "multiple-shooting")


def solve(
    problem: Problem,
    first: Point,
    *,
    solver: str = "ipopt",
    seed: int = 0,
    automatic: bool = True,
    vouched: Callable[[Point], bool] = lambda _: False,
) -> tuple[Problem, tuple[Outcome, ...]]:
    """All outcomes, that of the solver asked for first; the problem with its final weights.

    `automatic` says that `first` is the model's own start, not the user's; `vouched` whether the
    readings themselves say that nothing is left at a point: differential equations are then
    followed in no more ways.
    """
    if solver not in SOLVERS:
        raise UsageError(f"unknown solver {solver!r}; there are {', '.join(SOLVERS)}")
    outcomes = _ways(problem, first, solver, seed, automatic, vouched)
    if problem.constraints is not None:
        problem, point = kept(problem, best_of(outcomes).point)
        outcomes = _ways(problem, point, solver, seed, automatic=True)
    outcomes += _around_the_sphere(problem, first)
    outcomes += _along_the_weakest(problem, best_of(outcomes))
    best = best_of(outcomes)
    if best is not outcomes[0]:
        # An opinion was better than the answer: it becomes one.
        outcomes = (_polished(problem, best, PATIENCE), *outcomes)
    if not has_noise_effects(problem.model):
        return problem, outcomes
    problem, point = _reweighted(problem, best_of(outcomes).point)
    return problem, _ways(problem, point, solver, seed, automatic=True)


def best_of(outcomes: tuple[Outcome, ...]) -> Outcome:
    """The outcome of the lowest cost; one that is not finite loses.

    Where costs differ by rounding only, the first is best: it is polished.
    """
    lowest, first = min(outcomes, key=_cost), outcomes[0]
    return first if _cost(first) <= _cost(lowest) * (1 + 1e-12) else lowest


def _cost(outcome: Outcome) -> float:
    return outcome.cost if np.isfinite(outcome.cost) else np.inf


def _ways(
    problem: Problem,
    first: Point,
    solver: str,
    seed: int,
    automatic: bool,
    vouched: Callable[[Point], bool] = lambda _: False,
) -> tuple[Outcome, ...]:
    """The solver asked for with a polish, and a second way that must agree with it.

    The polished outcome comes first and carries the time of both. The second way begins with a
    few of the samples, where the record is long.
    """
    if solver == "multiple-shooting" and not problem.model.traced.integrates:
        raise UsageError(
            f"multiple-shooting is for differential equations, and {problem.model.name} has none"
        )
    if problem.model.traced.integrates:
        return _ways_of_equations(problem, first, solver, automatic, vouched)
    if solver == "trust-region" or _singular(problem, first):
        # IPOPT wanders along a direction that changes nothing; the damped steps do not.
        main = trust_region(problem, first)
    else:
        main = _ipopt(problem, first, solver)
    known: list[tuple[Outcome, Outcome]] = []
    outcomes = [main, *_opinions(problem, _other_starts(problem, first, automatic), known)]
    costs = [_cost(o) for o in outcomes]
    disagree = max(costs) - min(costs) > 1e-6 * max(min(costs), 1e-300)
    # From a start that was declared, not computed, two ways may end in one valley, and the wrong.
    # Where the residual is linear in all unknowns there is no other.
    if disagree or (problem.model.starter is None and not linear(problem.model)):
        rival = best_of((*outcomes,))
        starts = list(_perturbations(problem, first, seed))
        outcomes += _opinions(problem, starts[:STARTS], known, rival)
    if problem.model.starter is None and valleys(outcomes) > 1:
        # One valley more is a reason to look for others.
        outcomes += _opinions(problem, starts[STARTS:], known, best_of((*outcomes,)))
    if problem.model.starter is None and best_of((*outcomes,)) is not outcomes[0]:
        outcomes.append(_wary(problem, first))
    return (*outcomes,)


def _ways_of_equations(
    problem: Problem,
    first: Point,
    solver: str,
    automatic: bool,
    vouched: Callable[[Point], bool],
) -> tuple[Outcome, ...]:
    """The solver asked for from where the record leads that is followed, and others beside it.

    A plain descent comes first; where readings vouch for its end the solver goes on from there.
    """
    direct = list[Outcome]()
    with suppress(GivenUp), for_seconds(OPINIONS):  # else an opinion less
        end = trust_region(problem, first, max_iterations=OPINION, tolerance=slight(problem))
        direct.append(end)
        if solver != "multiple-shooting" and np.isfinite(end.cost) and vouched(end.point):
            return (_asked_for(problem, end, solver), end)
    others = [
        o
        for start in _other_starts(problem, first, automatic)
        for o in by_equations(problem, start)
    ]
    if solver == "multiple-shooting":
        several = by_shooting(problem, first)
        if several is None:
            raise UsageError(
                f"multiple shooting leads nowhere for {problem.model.name}: its inputs have "
                "unknowns of their own, or nothing can be integrated; leave --solver out"
            )
        others.insert(0, several)
    with suppress(GivenUp), for_seconds(allowed(others, OPINIONS)):  # else an opinion less
        others += direct
        if solver != "multiple-shooting":
            others.insert(0, _asked_for(problem, best_of((*others,)), solver))
    return (*others,)


def _asked_for(problem: Problem, near: Outcome, solver: str) -> Outcome:
    """The solver asked for, from where other ways have led."""
    if solver == "trust-region" or not np.isfinite(near.cost) or _singular(problem, near.point):
        return trust_region(problem, near.point, damping=LITTLE)
    return _ipopt(problem, near.point, solver, CLOSE_BY, LITTLE_LEFT)


def _other_starts(problem: Problem, first: Point, automatic: bool) -> Sequence[Point]:
    """Where a second opinion begins.

    A start of the user's may lie in a wrong valley: the automatic one must agree. Where that is
    computed from the data, it is second opinion enough.
    """
    bare = _without_effects(problem)
    if automatic:
        return (first, *bare)
    return (problem.start(), *bare) if problem.model.starter else (first, problem.start(), *bare)


def _without_effects(problem: Problem) -> tuple[Point, ...]:
    """Where the model is best without its effects over time, which begin at nothing there.

    A fit with more in it is no worse. A lag that begins where two records look alike, or a memory,
    may be in a wrong valley, with all starts that are near it.
    """
    model = problem.model
    over = [a for a in model.effects if a.kind in OVER_TIME]
    if not over or model.traced.integrates:
        return ()
    kept = tuple(a for a in model.effects if a not in over)
    bare = Problem(replace(model, effects=kept), problem.runs)
    found = trust_region(bare, bare.start(), max_iterations=OPINION)
    lags = {p.name for a in over if a.kind == "time" for p in a.parameters}
    begun = {
        n: np.zeros_like(v) if n in lags else v for n, v in problem.values(problem.start()).items()
    }
    return (problem.point({**begun, **bare.values(found.point)}),)


def valleys(outcomes: Sequence[Outcome]) -> int:
    """In how many different costs did they end?"""
    costs = sorted(_cost(o) for o in outcomes)
    apart = [b > a * (1 + APART) + 1e-300 for a, b in itertools.pairwise(costs) if np.isfinite(b)]
    return 1 + sum(apart)


def _ipopt(
    problem: Problem,
    start: Point,
    solver: str,
    options: dict[str, Any] = STANDSTILL,
    patience: int = EVALUATIONS,
) -> Outcome:
    """Where IPOPT ends from there, polished."""
    exact = solver == "ipopt-exact"
    found = ipopt(problem, start, exact=exact, options=options, patience=patience)
    return _polished(problem, found)


def _polished(problem: Problem, main: Outcome, max_iterations: int = 300) -> Outcome:
    polished = trust_region(problem, main.point, max_iterations=max_iterations, damping=LITTLE)
    return replace(
        polished,
        solver=main.solver,
        iterations=main.iterations + polished.iterations,
        evaluations=main.evaluations + polished.evaluations,
        seconds=main.seconds + polished.seconds,
    )


def _nearby(
    problem: Problem, start: Point, rival: Outcome | None = None, wary: bool = False
) -> tuple[Outcome, bool]:
    """The solution for a few of the samples, or the start where that does not lower the cost.

    And whether it is clear from the few that the rival is better.
    """
    began = time.perf_counter()
    thinned, here = few_of(problem), problem.cost(start)
    stay = Outcome("trust-region", start, here, 0, 1, False, "start", 0.0)
    if thinned is None:
        return stay, False
    # A tenth of the deviations of so few samples is as near as they can say.
    few = trust_region(
        thinned,
        start,
        max_iterations=PATIENCE if wary else OPINION,
        tolerance=1e4 * slight(thinned),
        wary=wary,
    )
    there = problem.cost(few.point)
    near = few if np.isfinite(there) and there < here else stay
    worse = rival is not None and few.cost > CLEARLY * thinned.cost(rival.point)
    return replace(near, cost=min(here, there), seconds=time.perf_counter() - began), worse


def _opinions(
    problem: Problem,
    starts: Sequence[Point],
    known: list[tuple[Outcome, Outcome]],
    rival: Outcome | None = None,
) -> list[Outcome]:
    """Opinions from several starts, kept in `known` with where a few of the samples led.

    Where these lead two starts to one place, the rest of the way is one as well. All samples are
    only looked at where a few of them leave it open which is better, it or a rival.
    """
    found = []
    for start in starts:
        near, worse = _nearby(problem, start, rival)
        same = (o for place, o in known if _one_place(problem, place, near))
        opinion = near if worse else next(same, None) or _followed(problem, near)
        if not worse:
            known.append((near, opinion))
        found.append(opinion)
    return found


def _one_place(problem: Problem, a: Outcome, b: Outcome) -> bool:
    """Are the solutions for a few of the samples a tenth of those' deviations apart, or less?"""
    few = few_of(problem)
    if few is None or not (a.iterations and b.iterations):
        return False
    normal, away = few.normal(a.point), problem.difference(a.point, b.point)
    freedom = max(few.residual_count - few.unknowns, 1)
    return bool(away @ normal.matrix @ away <= 1e-2 * 2 * normal.cost / freedom)


def _opinion(problem: Problem, start: Point) -> Outcome:
    """Where a trust region ends from a start: near a solution to a fraction of its deviations."""
    return _followed(problem, _nearby(problem, start)[0])


def _followed(problem: Problem, near: Outcome) -> Outcome:
    """Where all samples lead from there."""
    found = trust_region(
        problem,
        near.point,
        max_iterations=OPINION,
        tolerance=slight(problem),
        damping=LITTLE if near.iterations else 1e-3,
    )
    return replace(found, seconds=near.seconds + found.seconds)


def _wary(problem: Problem, start: Point) -> Outcome:
    """Where short steps lead from a start, however long it takes."""
    near, _ = _nearby(problem, start, wary=True)
    found = trust_region(
        problem, near.point, max_iterations=PATIENCE, tolerance=slight(problem), wary=True
    )
    return replace(found, seconds=near.seconds + found.seconds)


def _singular(problem: Problem, first: Point) -> bool:
    """Is a direction undetermined at the start and at what damped steps reach from there?"""
    if rank(problem.factor(first)[0]) == problem.unknowns:
        return False
    reached = trust_region(problem, first, max_iterations=OPINION).point
    R = problem.factor(reached)[0]
    # Where a derivative overflows nothing is determined.
    return not np.isfinite(R).all() or rank(R) < problem.unknowns


def _perturbations(problem: Problem, first: Point, seed: int) -> Iterator[Point]:
    """Starts around the first one."""
    normal = problem.normal(first)
    for step in around(first.x, normal.cost, np.diag(normal.matrix), seed):
        moved = problem.moved(first, step)
        yield Point(problem.inside(moved.x), moved.references)


def around(x: Array, cost: Array | float, diagonal: Array, seed: int = 0) -> Iterator[Array]:
    """Steps from a start x (n,) to others around it, by the cost there and the diagonal of JᵀJ.

    For W sensors x and the diagonal are (n, W), cost (W,).
    """
    rng = np.random.default_rng(seed)
    columns = np.sqrt(np.where(diagonal > 0, diagonal, np.inf))
    # An unknown that is zero has no size of its own: what changes the residual by its own length.
    size = np.maximum(np.abs(x), np.sqrt(2 * cost) / columns)
    for _ in range(STARTS + FURTHER):
        yield np.asarray((SPREAD * size.T * rng.standard_normal(len(x))).T)


def _around_the_sphere(problem: Problem, first: Point) -> tuple[Outcome, ...]:
    """Starts with every direction and rotation turned half about each axis.

    On a sphere even a linear residual may have a second, false minimum.
    """
    found = []
    for slot in problem.slots:
        shape = slot.parameter.shape
        if shape.curved:
            value = shape.at_reference(first.references[slot.ref])
            for turn in (np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])):
                references = first.references.copy()
                references[slot.ref] = shape.reference(turn @ value)
                start = Point(first.x, references)
                found.append(_opinion(problem, start))
    return tuple(found)


def _along_the_weakest(problem: Problem, best: Outcome) -> tuple[Outcome, ...]:
    """Two more starts far along the least determined direction: a second valley would lie there."""
    if not np.isfinite(best.cost):
        return ()
    R = problem.factor(best.point)[0]
    norms = np.linalg.norm(R, axis=0)
    if not (np.isfinite(norms).all() and np.all(norms > 0)):
        return ()
    _, singular, Vt = np.linalg.svd(R / norms)
    if singular[-1] > 0.1 * singular[0] or singular[-1] < 1e-8 * singular[0]:
        return ()
    sigma = np.sqrt(2 * best.cost / max(problem.residual_count - problem.unknowns, 1))
    step = 6 * sigma / singular[-1] * Vt[-1] / norms
    starts, rises = [], []
    for sign in (1, -1):
        moved = problem.moved(best.point, sign * step)
        starts.append(Point(problem.inside(moved.x), moved.references))
        rise = problem.cost(starts[-1]) - best.cost
        rises.append(rise / (18 * sigma**2) if sigma > 0 else np.inf)
    # A cost that is bent one way may lead to a second valley the other way.
    if all(PARABOLA[0] <= rise <= PARABOLA[1] for rise in rises):
        return ()
    return tuple(_opinion(problem, start) for start in starts)


def _reweighted(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """Iterate weights and fit: effects on the noise say how much each residual counts."""
    for _ in range(30):
        problem = problem.with_weights(weights(problem, point))
        moved = trust_region(problem, point)
        shift = problem.factor(moved.point)[0] @ (moved.point.x - point.x)
        point = moved.point
        if float(shift @ shift) <= 1e-10 * 2 * moved.cost:
            break
    return problem, point
