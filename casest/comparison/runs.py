"""Running solvers under a clock: each ends by itself, or when its time is over."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.engine import Normal
from casest.errors import CasestError
from casest.leastsquares.problem import Point, Problem
from casest.solve.collocation import collocated
from casest.solve.horizon import grown
from casest.solve.ipopt import ipopt
from casest.solve.others import METHODS, scipy_solver, sqpmethod
from casest.solve.outcome import Outcome
from casest.solve.shooting import shot
from casest.solve.trust_region import settled, trust_region

#: Solvers of the least-squares problem, from a start.
SOLVERS: dict[str, Callable[[Problem, Point], Outcome]] = {
    "ipopt": ipopt,
    "ipopt-exact": partial(ipopt, exact=True),
    "sqpmethod": sqpmethod,
    "trust-region": trust_region,
    **{f"scipy-{method}": partial(scipy_solver, method=method) for method in METHODS},
}


def _integrated(
    transcription: Callable[[Problem, Point], Outcome | None], problem: Problem, start: Point
) -> Outcome | None:
    """Where it ends, a success if the integrated equations have settled there too.

    It minimises something else, to a tolerance that is no deviation's.
    """
    found = transcription(problem, start)
    if found is None or not found.claims_success or settled(problem, found.point):
        return found
    status = "not settled in the integrated equations"
    return replace(found, claims_success=False, status=status)


#: Beside them for differential equations: along the record, from many beginnings at once, and with
#: the equations as constraints. The cost is that of the integrated equations where each ends.
TRANSCRIPTIONS: dict[str, Callable[[Problem, Point], Outcome | None]] = {
    "growing-horizon": grown,
    "multiple-shooting": partial(_integrated, shot),
    "collocation": partial(_integrated, collocated),
}
#: A run of the spread is stopped after this many times the solver's time from the same start, but
#: not before so many seconds: what is lost by then is not found later.
PATIENCE, LEAST = 4.0, 0.5
#: Runs from the same start whose median time is reported, and seconds from which one is enough.
REPEATS, SLOW = 3, 0.5


@dataclass(frozen=True)
class Task:
    """One solver from one start; `size` is None for an estimator of the model's own."""

    solver: str
    size: float | None
    start: Point | None


@dataclass(frozen=True)
class Ended:
    """How a task ended: an outcome, or the reason why there is none."""

    task: Task
    outcome: Outcome | None
    reason: str
    seconds: float
    kept: bool = True


class _Clock:
    """When a run has to end."""

    deadline = np.inf

    @property
    def over(self) -> bool:
        return time.perf_counter() > self.deadline


class _OutOfTime(Exception):
    """Ends SciPy's solvers, which do not look at what they are given."""


@dataclass(frozen=True)
class _Limited(Problem):
    """A problem without an answer once the time is over.

    CasADi's solvers go on for long after an exception in a callback, but end soon where nothing is
    finite; so does the trust region.
    """

    clock: _Clock = field(default_factory=_Clock, compare=False)

    def cost(self, point: Point) -> float:
        return float("nan") if self.clock.over else super().cost(point)

    def normal(self, point: Point) -> Normal:
        n = self.unknowns
        if self.clock.over:
            return Normal(float("nan"), np.full(n, np.nan), np.full((n, n), np.nan))
        return super().normal(point)

    def factor(self, point: Point) -> tuple[Array, Array, float]:
        n = self.unknowns
        if self.clock.over:
            return np.full((n, n), np.nan), np.full(n, np.nan), float("nan")
        return super().factor(point)

    def hessian(self, point: Point) -> Array:
        if self.clock.over:
            return np.full((self.unknowns, self.unknowns), np.nan)
        return super().hessian(point)

    def residuals(self, point: Point) -> tuple[Array, ...]:
        if self.clock.over:
            raise _OutOfTime
        return super().residuals(point)

    def jacobian(self, point: Point) -> Array:
        if self.clock.over:
            raise _OutOfTime
        return super().jacobian(point)


def solvers_of(model: Model) -> dict[str, Callable[[Problem, Point], Outcome | None]]:
    """Those that a model's problem can be given to, by name."""
    return {**SOLVERS, **(TRANSCRIPTIONS if model.traced.integrates else {})}


def tasks_of(
    model: Model, names: Sequence[str], starts: Sequence[tuple[float, Point]]
) -> list[Task]:
    """What to run, start by start."""
    own = [name for name, _ in model.estimators if name in names]
    ours = [name for name in names if name in solvers_of(model)]
    tasks = [Task(name, size, point) for size, point in starts for name in ours]
    first = [*tasks[: len(ours)], *(Task(name, None, None) for name in own)]
    return [*first, *tasks[len(ours) :]]


def run_all(
    tasks: Sequence[Task], problem: Problem, limit: float, say: Callable[[str], None]
) -> list[Ended]:
    """Run the tasks one by one."""
    clock = _Clock()
    ended: list[Ended] = []
    usual: dict[str, float] = {}
    # Constraints are held as the certified optimum found: with its multipliers.
    limited = _Limited(
        problem.model,
        problem.runs,
        problem.weights,
        problem.whitening,
        force=problem.force,
        clock=clock,
    )
    for k, task in enumerate(tasks, 1):
        say(f"{task.solver} ({k} of {len(tasks)})")
        patience = max(PATIENCE * usual.get(task.solver, np.inf), LEAST)
        result = _repeated(task, limited, min(limit, patience))
        ended.append(result)
        usual.setdefault(task.solver, result.seconds)
    return ended


def _repeated(task: Task, problem: _Limited, limit: float) -> Ended:
    """A run of the spread once; others a few times, with the median time."""
    ended = _run(task, problem, limit)
    if task.size or ended.outcome is None or ended.seconds > SLOW:
        return ended
    again = [_run(task, problem, limit).seconds for _ in range(REPEATS - 1)]
    return replace(ended, seconds=median([ended.seconds, *again]))


def _run(task: Task, problem: _Limited, limit: float) -> Ended:
    """One run; whatever goes wrong becomes words. What solvers print is not ours to hand on."""
    began = time.perf_counter()
    problem.clock.deadline = began + limit
    outcome, reason, kept = None, "", True
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            if task.start is None:
                outcome, kept = _estimated(task.solver, problem, began)
            else:
                outcome = solvers_of(problem.model)[task.solver](problem, task.start)
                reason = reason if outcome else "cannot be written so"
    except _OutOfTime:
        pass
    except CasestError as error:
        reason = str(error)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".strip().splitlines()[0]
    seconds = time.perf_counter() - began if outcome is None else outcome.seconds
    over, problem.clock.deadline = problem.clock.over, np.inf
    if over and not reason and (outcome is None or not np.isfinite(outcome.cost)):
        outcome, reason = None, f"stopped: no answer within {limit:g} s"
    return Ended(task, outcome, reason, seconds, kept)


def _estimated(name: str, problem: Problem, began: float) -> tuple[Outcome, bool]:
    """The point of an estimator of the model's own; was it inside the bounds?"""
    found = dict(problem.model.estimators)[name](problem.model, problem.runs)
    seconds = time.perf_counter() - began
    values = {p.name: found[p.name] for p in problem.model.parameters if p.name in found}
    point = problem.point(values)
    held = problem.values(point)
    kept = all(np.allclose(held[n], values[n], rtol=1e-6, atol=1e-9) for n in values)
    return Outcome(name, point, problem.cost(point), 0, 0, True, "", seconds), kept
