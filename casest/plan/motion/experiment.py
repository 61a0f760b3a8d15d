"""An experiment on equations: piecewise constant inputs, and when to read.

One after the other until neither gains: inputs by the program of a motion, times among the nodes of
the grid by exchange (Fedorov 1972), each node at most once. For the inputs at hand the choice of
times is convex but for being whole, so that its tangent bounds what other times could do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.plan.design.criteria import Criterion, Largest, Longest, Trace, Volume, inverse
from casest.plan.design.distinct import distinct, floor_of
from casest.plan.motion.criteria import Wanted
from casest.plan.motion.program import Task
from casest.plan.motion.starts import random_inputs

#: Random inputs that are looked at, the best that a search begins at, turns of inputs and times,
#: steps of a search.
RANDOM, SEARCHES, TURNS, STEPS = 20, 3, 4, 60
#: Gain below which a turn was the last; change of standard deviations that finer steps may make.
GAIN, FINE = 1e-4, 2e-4
#: Information, as a share of what reading everywhere tells, below which nothing is told.
UNTOLD = 1e-9


@dataclass(frozen=True)
class Experiment:
    """Inputs (P, k) at knots and the nodes at which to read.

    before, after (f, f): covariances of the unknowns in their own units; `before` None where they
    are not known. share: of the standard deviations, that the best other times would leave at
    least. even: what as many readings, evenly spread, leave with these inputs, as a multiple.
    """

    u: Array
    nodes: tuple[int, ...]
    before: Array | None
    after: Array
    share: float
    even: float
    task: Task


def planned_experiment(
    task: Task,
    count: int,
    rng: np.random.Generator,
    starts: Sequence[Array] = (),
    worst: bool = False,
) -> Experiment:
    """Inputs and `count` times that are found best; averaged over possible `starts`, or the `worst`
    of them.

    UsageError where so many readings do not determine the unknowns.
    """
    nodes = len(task.grid.time)
    if not 1 <= count <= nodes:
        raise UsageError(f"--count {count}: from 1 to {nodes}, the times at which one can read")
    beginnings = list(starts) or [task.model.start]
    criterion = criterion_of(task.wanted)
    task, drawn = _drawn(task, rng)
    uniform = np.full(nodes, count / nodes)
    values = [_worth(task, u, uniform, beginnings, worst) for u in drawn]
    found = [
        _turns(task, drawn[int(i)], count, criterion, beginnings, worst)
        for i in np.argsort(values)[:SEARCHES]
    ]
    _, u, chosen = min(found, key=lambda one: one[0])
    return _judged(task, u, chosen, criterion)


def _turns(
    task: Task, u: Array, count: int, criterion: Criterion, starts: Sequence[Array], worst: bool
) -> tuple[float, Array, list[int]]:
    """Times and inputs in turns, until neither gains: what is reached, inputs, nodes."""
    best: tuple[float, Array, list[int]] | None = None
    for _ in range(TURNS if task.wide else 1):
        factors = [task.factors(u, start) for start in starts]
        chosen = distinct(criterion, task.wanted.known, factors, count, worst)
        value = _joint(criterion, task.wanted.known, factors, chosen, worst)
        if best is not None and not value < best[0] - GAIN:
            break
        best = value, u, chosen
        weights = np.bincount(chosen, minlength=len(task.grid.time)).astype(float)
        if task.wide:
            u = _within(task, task.solved(u, weights, STEPS, starts, worst))
    assert best is not None
    return best


def criterion_of(wanted: Wanted) -> Criterion:
    """The same wish as a function of the covariance of the unknowns in their sizes."""
    f = len(wanted.free)
    if wanted.name == "D":
        return Volume()
    if wanted.name == "A":
        return Trace(np.eye(f))
    if wanted.name == "E":
        return Longest()
    columns = np.eye(f)[:, list(wanted.chosen)]
    if wanted.asked:
        columns = columns * wanted.scale[[wanted.free[k] for k in wanted.chosen]] / wanted.asked
    return Largest(columns)


def _joint(
    criterion: Criterion, known: Array, factors: Sequence[Array], chosen: Sequence[int], worst: bool
) -> float:
    every = [criterion.value(inverse(known + _sum(F, chosen))) for F in factors]
    return max(every) if worst else float(np.mean(every))


def _judged(task: Task, u: Array, chosen: list[int], criterion: Criterion) -> Experiment:
    """What it brings at the values that are thought likely, and how far from the best times."""
    wanted, factors = task.wanted, task.factors(u)
    M, every = (wanted.known + _sum(factors, own) for own in (chosen, range(len(factors))))
    size = 1 / np.sqrt(np.diag(every))
    least, most = (np.linalg.eigvalsh(X * np.outer(size, size))[0] for X in (M, every))
    if not least > UNTOLD:
        more = "more of them would (--count)" if most > UNTOLD else "nor would any others"
        raise UsageError(
            f"{task.model.name}: {len(chosen)} readings do not determine every unknown; {more}"
        )
    C = inverse(M)
    value, floor = criterion.value(C), floor_of(criterion, C, factors, chosen)
    spread = np.unique(np.linspace(0, len(factors) - 1, len(chosen)).round().astype(int))
    E = wanted.known + _sum(factors, spread)
    even = criterion.ratio(value, criterion.value(inverse(E)), len(C))
    own = np.outer(wanted.scale[list(wanted.free)], wanted.scale[list(wanted.free)])
    certain = np.linalg.eigvalsh(wanted.known)[0] > 1e-6
    before = inverse(wanted.known) * own if certain else None
    share = criterion.ratio(floor, value, len(C))
    return Experiment(u, tuple(chosen), before, C * own, share, 1 / max(even, 1e-300), task)


def _drawn(task: Task, rng: np.random.Generator) -> tuple[Task, list[Array]]:
    """Random inputs, and the task in steps so fine that finer ones change nothing."""
    drawn = [random_inputs(task, rng) for _ in range(RANDOM if task.wide else 1)]
    for _ in range(6):
        twice = replace(task, finer=2 * task.finer)
        both = [[_stds(t, u) for u in drawn[:3]] for t in (task, twice)]
        if all(np.allclose(a, b, rtol=FINE) for a, b in zip(*both, strict=True)):
            return task, drawn
        task = twice
    raise UsageError(
        f"{task.model.name}: its states move too fast for these times: a higher --rate, or a "
        "shorter --duration"
    )


def _stds(task: Task, u: Array) -> Array:
    """Square roots of the unknowns' information, reading everywhere."""
    W = task.information(u, np.ones(len(task.grid.time)))
    return np.asarray(np.sqrt(1.0 + np.diag(W)))


def _within(task: Task, u: Array) -> Array:
    """Inputs that keep to their limits to rounding."""
    u = u.copy()
    for limit in task.limits:
        if limit.of in task.columns and not limit.rate:
            u[:, task.columns[limit.of]] = limit.kept(u[:, task.columns[limit.of]])
    return u


def _worth(task: Task, u: Array, weights: Array, starts: Sequence[Array], worst: bool) -> float:
    every = [task.wanted.value(task.information(u, weights, start)) for start in starts]
    value = max(every) if worst else float(np.mean(every))
    return value if np.isfinite(value) else np.inf


def _sum(factors: Array, chosen: Sequence[int] | Array | range) -> Array:
    own = factors[list(chosen)].reshape(-1, factors.shape[2])
    return np.asarray(own.T @ own)
