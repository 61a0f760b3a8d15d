"""Solvers side by side on one problem, each judged by the certified optimum, none by its own word.

Every solver begins at the same start and at the same spread of starts around it, and is taken as it
ends: no polish, no second opinion. Estimators of the model's own have no start; they minimise
something else, so that their distance says how much that costs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np

from casest.comparison.runs import SOLVERS, TRANSCRIPTIONS, Ended, run_all, solvers_of, tasks_of
from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.engine.threads import one_thread
from casest.errors import NotTrusted, UsageError
from casest.estimate.calibrate import attempt
from casest.estimate.estimate import Estimate
from casest.estimate.reasons import SAME
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import rounding as rounding_error
from casest.solve.outcome import Outcome

#: How far starts are spread: standard deviation of each unknown's move over its size.
SIZES = (0.001, 0.01, 0.1, 0.3)
#: Seconds after which one run of a solver is stopped.
LIMIT = 10.0


@dataclass(frozen=True)
class Trial:
    """Where one solver ended from one start, judged.

    `excess` is the cost above the best one, `distance` the largest difference of an unknown from
    the best point in standard deviations of the certified estimate, that of `furthest`. `right`:
    within SAME standard deviations, by the cost, and inside the bounds. `claims` is what the
    solver says itself, None for an estimator that claims nothing. `size` is how far the start was
    moved (0: not at all). What does not exist is NaN or None.
    """

    size: float
    cost: float
    excess: float
    distance: float
    furthest: str | None
    inside: bool
    right: bool
    claims: bool | None
    status: str
    iterations: int | None
    evaluations: int | None
    seconds: float


@dataclass(frozen=True)
class Row:
    """One solver: its trial from the same start, and those from the spread of starts.

    `own` marks an estimator of the model's own, which has no start and claims nothing.
    """

    solver: str
    own: bool
    first: Trial | None
    spread: tuple[Trial, ...]

    @property
    def right(self) -> int:
        """Starts of the spread from which it found the optimum."""
        return sum(t.right for t in self.spread)

    @property
    def claimed(self) -> int:
        """Starts of the spread from which it claimed to have found it."""
        return sum(t.claims is True for t in self.spread)

    @property
    def false_successes(self) -> int:
        """Claims of the spread that are wrong."""
        return sum(t.claims is True and not t.right for t in self.spread)

    @property
    def false_failures(self) -> int:
        """Optima of the spread that it reported as failures."""
        return sum(t.claims is False and t.right for t in self.spread)

    @property
    def seconds(self) -> float:
        """Median time of the spread."""
        return median([t.seconds for t in self.spread]) if self.spread else float("nan")


@dataclass(frozen=True)
class Comparison:
    """All rows, and what they were judged by.

    `best` is the lowest cost that anything found inside the bounds, `sigma` the standard deviation
    of one residual that judges it. `certified` says that the estimate is trusted and that nothing
    found a better point.
    """

    estimate: Estimate
    rows: tuple[Row, ...]
    best: float
    best_by: str
    sigma: float
    certified: bool
    sizes: tuple[float, ...]
    starts: int
    seed: int
    automatic: bool


def compare(
    model: Model,
    runs: Sequence[Run],
    *,
    starts: int = 8,
    seed: int = 0,
    start: Mapping[str, Any] | None = None,
    sizes: Sequence[float] = SIZES,
    solvers: Sequence[str] = (),
    limit: float = LIMIT,
    say: Callable[[str], None] = lambda _: None,
) -> Comparison:
    """Run every solver from the same start and from `starts` more around it; judge where they end.

    `sizes` are taken in turn: how far a start lies from the first, as a share of each unknown's
    size. `solvers` names those wanted (all). A run is stopped after `limit` seconds, one of the
    spread after PATIENCE times the solver's own time where that is less. Raises DataError or
    UsageError where nothing can be fitted, NotTrusted where not even the cost at the start is
    finite.
    """
    names = _wanted(model, solvers)
    _check(starts, sizes, limit)
    say("certified optimum")
    found = attempt(model, runs, start=start, seed=seed)
    if not found.outcomes:
        error = NotTrusted("nothing to compare: " + found.certificate.reasons[0])
        error.estimate = found
        raise error
    first = _first(found.problem, start)
    with np.errstate(all="ignore"), one_thread():
        spread = _spread(found, first, tuple(sizes), starts, seed)
        tasks = tasks_of(found.model, names, [(0.0, first), *spread])
        ended = run_all(tasks, found.problem, limit, say)
    judge, best_by = _judge(found, ended)
    sigma = max(_known(found.noise.sigma), judge.rounding)
    return Comparison(
        found,
        tuple(_rows(judge, ended)),
        judge.cost,
        best_by,
        sigma,
        best_by == "certified" and found.certificate.trusted,
        tuple(sizes),
        starts,
        seed,
        start is None,
    )


def _wanted(model: Model, solvers: Sequence[str]) -> list[str]:
    known = [*solvers_of(model), *(name for name, _ in model.estimators)]
    for name in solvers:
        if name not in known:
            raise UsageError(f"unknown solver {name!r} for {model.name}; it has {', '.join(known)}")
    return [name for name in known if not solvers or name in solvers]


def _check(starts: int, sizes: Sequence[float], limit: float) -> None:
    if starts < 0:
        raise UsageError(f"--starts {starts}: give 0 or more")
    for size in sizes:
        if not 0 < size < np.inf:
            raise UsageError(f"--spread {size:g}: give a share above 0, such as 0.1 for 10 %")
    if not sizes:
        raise UsageError("no size of the spread is given; give one, such as --spread 0.1")
    if not limit > 0:
        raise UsageError(f"--limit {limit:g}: give a time above 0 in seconds")


# -- starts ----------------------------------------------------------------------------------------


def _first(problem: Problem, start: Mapping[str, Any] | None) -> Point:
    """The automatic start, with the user's values in place of its own where given."""
    if start is None:
        return problem.start()
    automatic = problem.values(problem.start()) if problem.model.starter else {}
    return problem.point({**automatic, **start})


def _spread(
    found: Estimate, first: Point, sizes: tuple[float, ...], count: int, seed: int
) -> Iterator[tuple[float, Point]]:
    """Starts around the first one, sizes in turn."""
    problem, rng = found.problem, np.random.default_rng(seed)
    length = _lengths(problem, first, found.point)
    for k in range(count):
        size = sizes[k % len(sizes)]
        moved = problem.moved(first, size * length * rng.standard_normal(len(length)))
        yield size, Point(problem.inside(moved.x), moved.references)


def _lengths(problem: Problem, first: Point, best: Point) -> Array:
    """Size of every unknown: its value, at the start or at the optimum, whichever is larger."""
    normal = problem.normal(first)
    columns = np.sqrt(np.where(np.diag(normal.matrix) > 0, np.diag(normal.matrix), np.inf))
    # An unknown that is zero has no size of its own: what changes the residual by its own length.
    least = np.sqrt(2 * normal.cost) / columns
    length = np.maximum(np.maximum(np.abs(first.x), np.abs(best.x)), least)
    for slot in problem.slots:
        if slot.parameter.shape.curved:
            length[slot.x] = 1.0  # rad: a direction or rotation is as large as any other
    return np.asarray(length)


# -- judging ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Judge:
    """What a trial is judged by: the best point and its cost, standard deviations, tolerance."""

    problem: Problem
    point: Point
    cost: float
    std: Array
    rounding: float
    tolerance: float

    def same(self, cost: float) -> bool:
        """Is a cost the best one, to SAME standard deviations or to rounding?"""
        return bool(np.sqrt(2 * max(cost - self.cost, 0.0)) <= self.tolerance)


def _judge(found: Estimate, ended: Sequence[Ended]) -> tuple[_Judge, str]:
    """The judge, and whose point is the best: "certified" unless something lower was found."""
    problem = found.problem
    rounding = rounding_error(problem, found.point)
    tolerance = SAME * _known(found.noise.sigma)
    tolerance = max(tolerance, 10 * rounding * float(np.sqrt(problem.residual_count)))
    std = np.sqrt(np.diag(found.covariance))
    certified = problem.cost(found.point)
    inside = [(e.outcome, e.task.solver) for e in ended if e.outcome and _inside(problem, e)]
    finite = [(o, name) for o, name in inside if np.isfinite(o.cost)]
    lowest, by = min(finite, key=lambda pair: pair[0].cost, default=(None, ""))
    cost = certified if lowest is None else min(lowest.cost, certified)
    judge = _Judge(problem, found.point, cost, std, rounding, tolerance)
    if lowest is None or judge.same(certified):
        return judge, "certified"
    return replace(judge, point=lowest.point), by


def _known(sigma: float) -> float:
    """The noise of one residual, 0 where nothing shows it."""
    return sigma if np.isfinite(sigma) else 0.0


def _inside(problem: Problem, ended: Ended) -> bool:
    """Did it end inside the bounds? SciPy's lm does not know them."""
    if ended.outcome is None:
        return False
    lower, upper = problem.bounds
    x = ended.outcome.point.x
    margin = 1e-8 * np.maximum(1.0, np.abs(x))  # SQP keeps bounds to a tolerance only
    return ended.kept and bool(np.all((x >= lower - margin) & (x <= upper + margin)))


def _rows(judge: _Judge, ended: Sequence[Ended]) -> Iterator[Row]:
    for name in dict.fromkeys(e.task.solver for e in ended):
        trials = [_trial(judge, e) for e in ended if e.task.solver == name]
        first = [t for t in trials if t.size == 0]
        spread = tuple(t for t in trials if t.size > 0)
        yield Row(
            name, name not in {**SOLVERS, **TRANSCRIPTIONS}, first[0] if first else None, spread
        )


def _trial(judge: _Judge, ended: Ended) -> Trial:
    task, outcome = ended.task, ended.outcome
    nan, size = float("nan"), task.size or 0.0
    if outcome is None:
        return Trial(
            size, nan, nan, nan, None, False, False, False, ended.reason, None, None, ended.seconds
        )
    excess = outcome.cost - judge.cost
    inside = _inside(judge.problem, ended)
    right = inside and judge.same(outcome.cost)
    distance, furthest = _distance(judge, outcome)
    own = task.size is None
    status = outcome.status if inside else f"left the bounds; {outcome.status}".rstrip("; ")
    return Trial(
        size,
        outcome.cost,
        excess,
        distance,
        furthest,
        inside,
        right,
        None if own else outcome.claims_success,
        status,
        None if own else outcome.iterations,
        None if own else outcome.evaluations,
        ended.seconds,
    )


def _distance(judge: _Judge, outcome: Outcome) -> tuple[float, str | None]:
    """Largest difference of an unknown in standard deviations, and which."""
    if not np.isfinite(outcome.cost):
        return float("nan"), None
    point = _in_convention(judge.problem, outcome)
    away = np.abs(judge.problem.difference(point, judge.point)) / judge.std
    if not np.any(np.isfinite(away)):
        return float("nan"), None
    worst = int(np.nanargmax(away))
    return float(away[worst]), judge.problem.names[worst]


def _in_convention(problem: Problem, outcome: Outcome) -> Point:
    """The same solution in the model's convention: whole turns of an angle are no distance."""
    convention = problem.model.canonicaliser
    if convention is None:
        return outcome.point
    values = problem.values(outcome.point)
    chosen = {k: v for k, v in convention(problem.model, values).items() if k in values}
    point = problem.point({**values, **chosen})
    same = abs(problem.cost(point) - outcome.cost) <= 1e-6 * outcome.cost
    return point if same else outcome.point
