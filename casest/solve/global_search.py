"""A search over all that the data span, for where starts around one point are no evidence.

Unknowns in which the residual is linear are projected out (Golub & Pereyra 1973); the others are
spread over their reach by a low-discrepancy sequence (Sobol), whatever the start. The best places
are followed by many damped Gauss-Newton steps at once, and the best ends to their optimum. How
much is done depends on the size of the problem, not on the machine: the same data give the same
answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.many_points import separable
from casest.leastsquares.problem import Point, Problem
from casest.solve.equivalent import limit_of, same_on
from casest.solve.many_descents import followed, projected
from casest.solve.outcome import Outcome
from casest.solve.reach import Piece, reach
from casest.solve.trust_region import LITTLE, trust_region

#: Rows that are looked at, a random choice of a longer record (at random no frequency is lost).
ROWS = 2000
#: And of these, where thousands of places are only to be compared.
FEW = 200
#: Residuals that are computed in all to look over the places: at first, and where that leaves the
#: question open (together up to five seconds); places at most, for each unknown that is searched.
EFFORTS = (1.2e7, 4e7)
EACH, MORE = 32, 16
#: Places that are followed: the best of all, and the best of every cell.
BEST, CELLS = 64, 192
#: Ends that are followed to their optimum.
POLISHED = 6
#: Rise of the cost, in variances of the noise, within which another end is a rival: what a
#: likelihood-ratio test refuses at a level of 0.001 (χ² of one degree of freedom, halved).
CLOSE = 5.414
#: Ends whose costs differ by less than this share are in one valley.
ONE_VALLEY = 1e-2


@dataclass(frozen=True)
class Search:
    """What a search found: the best `outcome`; `places` looked at, `followed` and `arrived` there.

    `valleys`: different ends of those that were followed; `bent`: unknowns that were searched, in
    which the residual is not linear. `rivals`: ends that fit about as well and predict otherwise.
    """

    outcome: Outcome
    places: int
    followed: int
    arrived: int
    valleys: int
    bent: int
    rivals: tuple[Outcome, ...] = ()
    #: Was the time over before it came to its end?
    given_up: bool = False


def search(
    problem: Problem,
    first: Point,
    best: Outcome,
    seed: int = 0,
    effort: float = EFFORTS[0],
    allowed: Callable[[Point], bool] = lambda point: True,
) -> Search:
    """Look for a lower valley than the best one known.

    Of equal ones that most like the start, `first`, is taken. `effort`: residuals to compute;
    `allowed`: is an end there to count?
    """
    began, small = time.perf_counter(), some_rows(problem, ROWS, seed)
    few = some_rows(small, FEW, seed)
    linear = np.array(_linear(problem), dtype=int)
    bent = np.setdiff1d(np.arange(problem.unknowns), linear)
    shares = _spread(len(bent), _places(few, len(bent), effort), seed)
    x = np.tile(first.x, (len(shares), 1))
    pieces = reach(problem, first, bent.tolist())
    for k, j in enumerate(bent):
        x[:, j] = _on(pieces[int(j)], shares[:, k])
    x, cost = projected(few, first, x, linear)
    chosen = _chosen(cost, shares)
    ends, costs = followed(small, first, np.vstack([x[chosen], best.point.x]))
    outcome, others = _polished(problem, first, best, ends, costs, allowed)
    known = small.cost(outcome.point)
    own = costs[:-1]
    arrived = int(np.sum(own <= known * (1 + ONE_VALLEY)))
    outcome = replace(outcome, seconds=time.perf_counter() - began)
    rivals = rivals_of(problem, outcome, others)
    return Search(outcome, len(x), len(own), arrived, _distinct(own), max(len(bent), 1), rivals)


def _linear(problem: Problem) -> list[int]:
    """Unknowns of all runs that are projected out."""
    own = separable(problem.model)
    return sorted({int(problem.seen(r)[0][k]) for r in range(len(problem.runs)) for k in own})


def some_rows(problem: Problem, rows: int, seed: int = 0) -> Problem:
    """The problem on some of its rows, chosen at random."""
    rng = np.random.default_rng(seed)
    limit = max(rows // len(problem.runs), 10)
    if all(len(run) <= limit for run in problem.runs):
        return problem
    runs = [
        run.take(np.sort(rng.permutation(len(run))[:limit])) if len(run) > limit else run
        for run in problem.runs
    ]
    return Problem(problem.model, tuple(runs))


def _places(problem: Problem, dimensions: int, effort: float) -> int:
    """How many: a power of two, as the sequence wants it."""
    wanted = min(effort / problem.residual_count, float(EACH) ** dimensions * MORE)
    return 1 << max(int(np.log2(max(wanted, 1))), 6)


def _spread(dimensions: int, count: int, seed: int) -> Array:
    from scipy.stats import qmc

    if not dimensions:
        return np.zeros((1, 0))
    return np.asarray(qmc.Sobol(dimensions, rng=np.random.default_rng(seed)).random(count))


def _on(pieces: tuple[Piece, ...], shares: Array) -> Array:
    """Values at shares of an axis that is made of pieces, each as long as the others."""
    which = np.minimum((shares * len(pieces)).astype(int), len(pieces) - 1)
    found = np.empty_like(shares)
    for k, piece in enumerate(pieces):
        own = which == k
        found[own] = piece.at(shares[own] * len(pieces) - k)
    return found


def _chosen(cost: Array, shares: Array) -> Array:
    """The best of all, and the best of every cell of a coarse grid."""
    order = np.argsort(cost, kind="stable")
    order = order[np.isfinite(cost[order])]
    bins = max(2, int(CELLS ** (1 / max(shares.shape[1], 1))))
    cells = (shares[order] * bins).astype(int) @ bins ** np.arange(shares.shape[1])
    apart = order[np.sort(np.unique(cells, return_index=True)[1])][:CELLS]
    return np.asarray(np.unique(np.concatenate([order[:BEST], apart])))


def _distinct(costs: Array) -> int:
    """In how many different costs did they end?"""
    ordered = np.sort(costs[np.isfinite(costs)])
    if not len(ordered):
        return 0
    return 1 + int(np.sum(ordered[1:] > ordered[:-1] * (1 + 1e-3)))


def _polished(
    problem: Problem,
    first: Point,
    best: Outcome,
    ends: Array,
    costs: Array,
    allowed: Callable[[Point], bool],
) -> tuple[Outcome, list[Outcome]]:
    """The best end at its optimum, of all rows, and the others that were followed there.

    Of equal ones that most like the start is best: the one known before, unless its signs differ.
    """
    found, tried = [best], list[tuple[float, Array]]()
    for k in np.argsort(costs, kind="stable"):
        if len(tried) >= POLISHED or not np.isfinite(costs[k]):
            break
        signs = np.sign(ends[k])
        if any(costs[k] <= c * (1 + 1e-3) and np.array_equal(signs, s) for c, s in tried):
            continue
        start = Point(problem.inside(ends[k]), first.references)
        if not allowed(start):
            continue
        tried.append((costs[k], signs))
        end = trust_region(problem, start, damping=LITTLE)
        found += [end] if allowed(end.point) else []
    lowest = min(o.cost for o in found if np.isfinite(o.cost))
    equal = [o for o in found if o.cost <= lowest * (1 + 1e-9)]
    like = min(equal, key=lambda o: unlike(o.point.x, first.x))
    known = any(o is best for o in equal)
    fewer = unlike(like.point.x, first.x)[0] < unlike(best.point.x, first.x)[0]
    return (best if known and not fewer else like), found


def unlike(x: Array, start: Array) -> tuple[int, float]:
    """Signs that differ from the start's, then how far away."""
    signs = int(np.sum(np.sign(x) * np.sign(start) < 0))
    return signs, float(np.linalg.norm((x - start) / np.maximum(np.abs(start), 1.0)))


def rivals_of(problem: Problem, best: Outcome, others: list[Outcome]) -> tuple[Outcome, ...]:
    """Those of the others that the data hardly tell from the best, and that predict otherwise."""
    variance = 2 * best.cost / max(problem.residual_count - problem.unknowns, 1)
    near = [o for o in others if o is not best and o.cost - best.cost < CLOSE * variance]
    if not near:
        return ()
    limit = limit_of(problem, best)
    return tuple(o for o in near if not same_on(problem, o.point, best.point, limit))
