"""The motion to fly: searched for from the best of many random ones, followed finely, judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.gramian import Observed, Products, observed
from casest.dynamics.path import Path
from casest.errors import UsageError
from casest.plan.motion.limits import Limit
from casest.plan.motion.program import Task
from casest.plan.motion.starts import random_inputs

#: Random motions that are looked at; the search begins at the best of them.
RANDOM = 20
#: Steps of a search. It is at its optimum to some thousandths of a standard deviation by then.
STEPS = 60
#: Share by which a limit may be passed between two nodes; rounds in which it is narrowed, and times
#: the nodes at which it is kept in all but the first.
PASSED, ROUNDS, FINER = 1e-3, 8, 3


@dataclass(frozen=True)
class Flown:
    """A motion at the samples of its record: a run with inputs and the readings to expect, states
    (N, n), what it makes observable, and how much of every limit it takes."""

    run: Run
    states: Array
    seen: Observed
    shares: Mapping[str, float]


@dataclass(frozen=True)
class MotionPlan:
    """The motion, and beside it the one of the random motions that is their median.

    elsewhere: of each other beginning that it was planned for, the geometric mean of the standard
    deviations as a multiple of those at the likeliest.
    """

    motion: Flown
    random: Flown
    limits: tuple[Limit, ...]
    elsewhere: tuple[float, ...] = ()


def planned_motion(
    task: Task,
    rate: float,
    rng: np.random.Generator,
    *,
    starts: Sequence[Array] = (),
    worst: bool = False,
    searches: int = 1,
) -> MotionPlan:
    """The best motion that is found, sampled `rate` times a second.

    `starts` (n,) of the states that are possible beside the likeliest: averaged over, or the
    `worst`; limits hold from the likeliest. `searches` are begun at so many of the best random
    motions. UsageError where no motion keeps to the limits.
    """
    weights = _counted(task)
    starts = [task.model.start, *starts]
    drawn = [random_inputs(task, rng) for _ in range(RANDOM)]
    drawn = [u for u in drawn if np.isfinite(task.states(u)).all()]
    if not drawn:
        raise UsageError(
            f"{task.model.name}: no random motion stays finite; narrower limits (--limit), or "
            "a shorter --duration"
        )
    values = [_worth(task, u, weights, starts, worst) for u in drawn]
    order = np.argsort(values)
    middle = flown(task, drawn[int(order[len(order) // 2])], rate)
    found = []
    for i in order[:searches]:
        u = task.solved(drawn[int(i)], weights, STEPS, starts, worst, limited=1)
        u, made = _within(task, u, rate)
        found.append((_worth(task, u, weights, starts, worst), u, made))
    _, u, made = min(found, key=lambda one: one[0])
    logs = [task.wanted.value(task.information(u, weights, start)) for start in starts]
    elsewhere = np.exp((np.array(logs[1:]) - logs[0]) / len(task.wanted.free))
    return MotionPlan(made, middle, task.limits, tuple(map(float, elsewhere)))


def bent(model: Dynamics) -> bool:
    """Does what a motion shows depend on where the states begin, beside the inputs?"""
    t = model.traced
    return bool(ca.depends_on(ca.vertcat(ca.vec(t.A), ca.vec(t.C)), t.x))


def _counted(task: Task) -> Array:
    """For how long the reading at each node stands, s."""
    K = len(task.grid.time) - 1
    weights = np.full(K + 1, task.grid.step)
    weights[[0, -1]] *= 0.5
    return weights


def _worth(task: Task, u: Array, weights: Array, starts: Sequence[Array], worst: bool) -> float:
    """What is to be least, infinite where it is no number."""
    every = [task.wanted.value(task.information(u, weights, start)) for start in starts]
    value = max(every) if worst else float(np.mean(every))
    return value if np.isfinite(value) else np.inf


def _within(task: Task, u: Array, rate: float) -> tuple[Array, Flown]:
    """The motion, brought back to limits that it passes; UsageError where it cannot be."""
    narrow = task
    for turn in range(ROUNDS):
        made = flown(task, u, rate)
        over = {name: share for name, share in made.shares.items() if not share <= 1 + PASSED}
        if not over:
            return u, made
        limits = tuple(
            limit.within(min(1.0, (1 - 5 * PASSED) / over[limit.name]))
            if limit.name in over and over[limit.name] < 2
            else limit
            for limit in narrow.limits
        )
        narrow = replace(narrow, limits=limits)
        if narrow.grid is task.grid and turn:  # what passes between two nodes needs nodes there
            narrow = replace(narrow, grid=task.grid.finer(FINER))
        u = narrow.nearest(u)
    made = flown(task, u, rate)
    over = {name: share for name, share in made.shares.items() if not share <= 1 + PASSED}
    if over:
        name = max(over, key=lambda n: over[n])
        limit = next(limit for limit in task.limits if limit.name == name)
        raise UsageError(
            f"{task.model.name}: no motion was found that keeps {limit} (the nearest one has "
            f"{over[name]:.3g} times as much); a wider limit, or another beginning (--value)"
        )
    return u, made


def flown(task: Task, u: Array, rate: float) -> Flown:
    """The motion with inputs u (P, k) at knots, `rate` samples a second."""
    model, duration = task.model, float(task.grid.time[-1])
    time = np.arange(int(np.floor(duration * rate + 1e-9)) + 1) / rate
    begin, end = task.grid.at(time), task.grid.at(time[1:], before=True)
    inputs = begin @ u
    x = followed(task, inputs[:-1], end @ u, 1 / rate)
    signals = {name: inputs[:, own] for name, own in task.columns.items()}
    signals |= readings(model, x, signals)
    every = {s.name: signals.get(s.name, time[:, None]) for s in model.signals}
    units = {s.name: s.unit for s in model.signals}
    run = Run.raw("planned", every, units=units, time=time)
    exact = [1 / s.std**2 if s.known else 0.0 for s in model.states for _ in range(s.size)]
    along = None if model.linear else Path.along(model, run, x)
    W = Products.of(model, run, along).gramian() + np.diag(exact)
    return Flown(run, x, observed(model, W), _shares(task, x, inputs, rate))


def followed(task: Task, begin: Array, end: Array, h: float) -> Array:
    """States (N, n) by Runge-Kutta steps of h s, from inputs (N − 1, k) at both ends of each."""
    x, u0, u1 = (ca.SX.sym(n, s) for n, s in (("x", task.model.size), ("a", task.wide),
                                             ("b", task.wide)))  # fmt: skip
    middle = 0.5 * (u0 + u1)
    k1 = task.rate(x, u0)[0]
    k2 = task.rate(x + 0.5 * h * k1, middle)[0]
    k3 = task.rate(x + 0.5 * h * k2, middle)[0]
    k4 = task.rate(x + h * k3, u1)[0]
    step = ca.Function("follow", [x, u0, u1], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    after = np.array(step.mapaccum(len(begin))(task.model.start, begin.T, end.T))
    return np.vstack([task.model.start, after.T])


def readings(model: Dynamics, x: Array, signals: Mapping[str, Array]) -> dict[str, Array]:
    """What outputs would read without noise along states (N, n)."""
    t = model.traced
    names = list(signals)
    f = ca.Function("h", [t.x, *(flat(t.symbols[n]) for n in names)], [ca.densify(t.h)])
    h = np.array(f.map(len(x))(x.T, *(signals[n].T for n in names))).T
    found, place = {}, 0
    for name, output in zip(t.measured, t.outputs, strict=True):
        size = int(output.predicted.numel())
        found[name] = h[:, place : place + size]
        place += size
    return found


def _shares(task: Task, x: Array, inputs: Array, rate: float) -> dict[str, float]:
    """How much of every limit the motion takes, at most."""
    where = task.model.slices()
    slopes = np.array(task.rate.map(len(x))(x.T, inputs.T)[0]).T
    found = {}
    for limit in task.limits:
        if limit.of in where:
            values = (slopes if limit.rate else x)[:, where[limit.of]]
        else:
            values = inputs[:, task.columns[limit.of]]
            values = np.diff(values, axis=0) * rate if limit.rate else values
        share = limit.share(values) if np.isfinite(values).all() else np.inf
        found[limit.name] = share
    return found
