"""Equations that run faster or slower as a whole: aliases in time.

Where all rates grow s times when constants are changed (k of ẋ = k·f(x); the frequency and friction
of a swing, its square and itself), one course is passed through at any pace. Readings that are few
for each turn of it may be met by a faster one as well, which turns whole turns more between two of
them; on even rows exactly so. A search that has ended in such a place need not find the slow one:
the constants of one are not near those of the other. But its own course, passed through more
slowly, shows where to look: it is followed once, and compared with the readings at every pace.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from casest.data.run import Index
from casest.declaration.flow import Flow
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import sample_symbol
from casest.engine import Replay
from casest.leastsquares.flow import Course, Integrator, Mesh
from casest.leastsquares.problem import Point, Problem
from casest.solve.outcome import Outcome
from casest.solve.trust_region import LITTLE, slight, trust_region

#: Places at which rates are looked at, and error by which powers miss that is none.
LOOKS, NONE = 40, 1e-9
#: Steps of the integrator that half a turn takes at least (at its tolerance it takes seven).
STEPS = 4
#: Half turns between neighbouring rows from which on there may be a slower course through them: at
#: the ends of a record not all are seen.
NYQUIST = 0.8
#: Half turns between neighbouring rows that these can still follow.
FASTEST = 1.2
#: Points of a course for each step, and steps of all of it at most.
FINER, MOST = 2, 20_000
#: Rows of a run that are compared, and states that are put into the residual at once.
ROWS, ONCE = 200, 200_000
#: Cost at a pace over the lowest, and over the usual one, within which it is followed; how many.
NEAR, USUAL, FOLLOWED = 10.0, 0.05, 8
#: Share by which the cost of an alias may be higher: it is polished later.
ALIKE = 1e-3


@dataclass(frozen=True)
class Pace:
    """Where time runs s times as fast, unknowns of a run (p,) are multiplied by s to these
    `powers`; `whole`: the powers are whole numbers, and s may be below zero."""

    powers: Array
    whole: bool

    def at(self, problem: Problem, point: Point, s: float) -> Point:
        """The point at which all runs s times as fast as at another."""
        x, signs = point.x.copy(), np.ones(len(self.powers))
        if s < 0:
            signs = (-1.0) ** np.round(self.powers)
        for r in range(len(problem.runs)):
            own = problem.seen(r)[0]
            x[own] = point.x[own] * signs * abs(s) ** self.powers
        return Point(x, point.references)


@lru_cache(maxsize=64)
def pace_of(model: Model) -> Pace | None:
    """How the model's equations are made faster or slower; None where nothing does it.

    Powers a of the unknowns θ and b of the states x for which f(s^b·x, s^a·θ) = s^(1 + b)·f(x, θ),
    the beginning is multiplied by s^b, and predictions stay as they are. Where the rates have
    inputs, or a constant that is known, there are none.
    """
    system = _system(model)
    if system is None:
        return None
    powers, *_ = np.linalg.lstsq(system[:, :-1], system[:, -1], rcond=1e-10)
    if np.max(np.abs(system[:, :-1] @ powers - system[:, -1])) > NONE:
        return None
    own: Array = powers[: model.staged.coordinates.numel()].astype(float)
    return Pace(own, bool(np.allclose(own, np.round(own), atol=1e-6)))


def _system(model: Model) -> Array | None:
    """Rows [A c] of what powers (a, b) have to keep to, A·(a, b) = c, each of length one: slopes of
    both sides in s at s = 1, at several places."""
    traced = model.staged
    (flow,) = traced.stages if len(traced.stages) == 1 else (None,)
    if not isinstance(flow, Flow) or flow.inputs.numel() or traced.predicted is None:
        return None
    theta, x, n = traced.coordinates, flow.x, flow.x.numel()
    if traced.references.numel() or not theta.numel():
        return None
    a, b = ca.SX.sym("a", theta.numel()), ca.SX.sym("b", n)
    given = ca.substitute(traced.predicted, flow.given, x)
    grown = [
        ca.jtimes(flow.rates, theta, a * theta) + ca.jtimes(flow.rates, x, b * x) - b * flow.rates,
        ca.jtimes(flow.start, theta, a * theta) - b * flow.start,
        ca.jtimes(given, theta, a * theta) + ca.jtimes(given, x, b * x),
    ]
    wanted = ca.vertcat(flow.rates, ca.SX.zeros(n + given.numel()))
    rows = ca.jacobian(ca.vertcat(*grown), ca.vertcat(a, b))
    sample = sample_symbol(model, traced)
    look = ca.Function("look", [x, theta, sample], [ca.densify(rows), ca.densify(wanted)])
    rng, found = np.random.default_rng(0), []
    for _ in range(LOOKS):
        at = (rng.uniform(0.2, 2.0, size) for size in (n, theta.numel(), sample.numel()))
        both = np.hstack([np.array(part) for part in look(*at)])
        found.append(both[np.isfinite(both).all(axis=1)])
    system = np.vstack(found)
    size = np.linalg.norm(system, axis=1)
    system = system[size > 0] / size[size > 0, None]
    return system if len(system) else None


def turning(problem: Problem, point: Point) -> float:
    """Half turns of what is predicted between neighbouring rows: 1 is Nyquist's limit.

    How often a reading of the course goes up after it went down, or down after up. The mean of the
    rows, the fastest run and reading; none where the integrator's steps are too few for one between
    two rows, infinite where the equations cannot be followed.
    """
    fastest = 0.0
    for r in range(len(problem.runs)):
        steps = _steps(problem, point, r)
        if steps is not None and steps.sum() < STEPS * len(steps):
            continue
        course = None if steps is None else _course(problem, point, r, steps)
        if course is None:
            return float("inf")
        sample = np.tile(problem.samples[r].dense[:1], (len(course.x), 1))
        given = np.hstack([sample, course.x])
        y = _predicted(problem.model)(problem.parameters(point, r), given)[0][:, :, 0]
        rise = np.diff(y, axis=0)
        rise[np.abs(rise) <= 1e-9 * np.abs(y).max(axis=0)] = 0.0
        turns = np.sum(rise[1:] * rise[:-1] < 0, axis=0)
        fastest = max(fastest, float(np.max(turns)) / max(len(problem.runs[r]) - 1, 1))
    return fastest


def slowed(problem: Problem, point: Point, fastest: float) -> Point:
    """The point, so much slower that it turns no faster than `fastest` (half turns a row)."""
    pace = pace_of(problem.model)
    turns = 0.0 if pace is None else turning(problem, point)
    if pace is None or not fastest < turns < np.inf:
        return point
    there = pace.at(problem, point, fastest / turns)
    return Point(problem.inside(there.x), there.references)


def slower(problem: Problem, best: Outcome) -> list[Outcome]:
    """Where the course of the best fits the readings as well when it is passed through more slowly.

    Empty where less than half a turn lies between two rows, or the equations have no pace.
    """
    pace = pace_of(problem.model)
    if pace is None or not np.isfinite(best.cost) or turning(problem, best.point) < NYQUIST:
        return []
    found, lowest = list[Outcome](), best.cost
    for s in _where(problem, best.point, pace):
        there = pace.at(problem, best.point, s)
        lower, upper = problem.bounds
        if np.any((there.x < lower) | (there.x > upper)):
            continue
        end = trust_region(problem, there, damping=LITTLE, tolerance=slight(problem))
        if end.cost <= lowest * (1 + ALIKE):
            # The slowest of all comes first.
            return [*found, trust_region(problem, end.point, damping=LITTLE)]
        found.append(end)
    return found


@dataclass(frozen=True)
class _Course:
    """States (K, n) at times (K,) from where a run begins, in s."""

    time: Array
    x: Array


def _steps(problem: Problem, point: Point, r: int) -> Index | None:
    """Steps in each interval between rows of a run; None where it cannot be followed."""
    mesh, time = Mesh(), np.asarray(problem.runs[r].time, float)
    x, _ = _follow(problem.model).along(problem.parameters(point, r), _free(time), mesh)
    if mesh.counts is None or mesh.stiff or not np.isfinite(x).all():
        return None
    return mesh.counts


def _course(
    problem: Problem, point: Point, r: int, steps: Index, sign: float = 1.0
) -> _Course | None:
    """A run followed at FINER times as many times as it takes steps; None where these are too many.

    With a `sign` below zero it is followed back from where it begins.
    """
    if not 0 < steps.sum() <= MOST:
        return None
    follow, knots = _follow(problem.model), np.asarray(problem.runs[r].time, float)
    if follow.flow.anchored and knots[0] > 0:
        knots = np.concatenate([[0.0], knots])
    length = np.repeat(np.diff(knots) / (steps * FINER), steps * FINER)
    time = np.concatenate([[0.0], np.cumsum(length)])
    free = replace(follow, flow=replace(follow.flow, anchored=False)) if sign < 0 else follow
    x, _ = free.along(problem.parameters(point, r), _free(sign * time), Mesh())
    return _Course(time, x)


def _free(time: Array) -> Course:
    """Times of equations without inputs."""
    return Course(time, np.zeros((len(time), 0)), np.zeros((len(time), 0, 0)))


@lru_cache(maxsize=64)
def _follow(model: Model) -> Integrator:
    """The model's equations without slopes."""
    flow = model.staged.stages[0]
    assert isinstance(flow, Flow)
    return Integrator(model.staged, flow, ())


def _where(problem: Problem, point: Point, pace: Pace) -> Iterator[float]:
    """Paces from -1 to 1 at which the readings are met about as well as anywhere, slowest first.

    Neighbouring ones differ by a step of the integrator at the end of the record.
    """
    paces: list[Array] = []
    costs: list[Array] = []
    steps = [_steps(problem, point, r) for r in range(len(problem.runs))]
    for sign in (1.0, -1.0) if pace.whole else (1.0,):
        courses = [
            None if own is None else _course(problem, point, r, own, sign)
            for r, own in enumerate(steps)
        ]
        count = max((len(c.time) // FINER for c in courses if c is not None), default=0)
        if not count or any(c is None for c in courses):
            continue
        s = np.arange(1, count + 1) / count
        paces.append(sign * s)
        each = [_costs(problem, point, r, c, s) for r, c in enumerate(courses) if c is not None]
        costs.append(np.asarray(np.sum(each, axis=0)))
    if not paces:
        return
    whole = np.concatenate(costs)
    usual = float(np.median(whole[np.isfinite(whole)])) if np.isfinite(whole).any() else 0.0
    found = list[tuple[float, float]]()
    for s, cost in zip(paces, costs, strict=True):
        low = np.flatnonzero((cost[1:-1] <= cost[:-2]) & (cost[1:-1] <= cost[2:])) + 1
        ends = [len(s) - 1] if s[-1] < 0 and len(s) > 1 and cost[-1] < cost[-2] else []
        found += [(float(s[k]), float(cost[k])) for k in [*low, *ends] if np.isfinite(cost[k])]
    least = min((cost for _, cost in found), default=0.0)
    good = [s for s, cost in found if cost <= max(NEAR * least, USUAL * usual) and cost < usual]
    yield from sorted(good, key=abs)[:FOLLOWED]


def _costs(problem: Problem, point: Point, r: int, course: _Course, s: Array) -> Array:
    """Sums of squares (S,) of a run whose course is passed through s times as fast."""
    samples, time = problem.samples[r].dense, np.asarray(problem.runs[r].time, float)
    # At random: every k-th of even rows would be met by slower courses that the others are not.
    rows = np.sort(np.random.default_rng(0).permutation(len(time))[:ROWS])
    begins = 0.0 if _follow(problem.model).flow.anchored else time[0]
    samples, time, present = samples[rows], time[rows] - begins, problem.present[r]
    there = np.ones((len(rows), len(problem.model.axes)), bool)
    there = there if present is None else present[rows]
    parameters, residual = problem.parameters(point, r), _residual(problem.model)
    found = np.empty(len(s))
    for first in range(0, len(s), max(ONCE // len(rows), 1)):
        own = s[first : first + max(ONCE // len(rows), 1)]
        wanted = np.outer(own, time).ravel()
        x = np.column_stack([np.interp(wanted, course.time, column) for column in course.x.T])
        given = np.hstack([np.tile(samples, (len(own), 1)), x])
        e = residual(parameters, given)[0][:, :, 0].reshape(len(own), *there.shape)
        found[first : first + len(own)] = np.sum(np.where(there, e, 0.0) ** 2, axis=(1, 2))
    return np.where(np.isfinite(found), found, np.inf)


@lru_cache(maxsize=64)
def _residual(model: Model) -> Replay:
    return _of_states(model, model.staged.expression)


@lru_cache(maxsize=64)
def _predicted(model: Model) -> Replay:
    return _of_states(model, model.staged.predicted)


def _of_states(model: Model, expression: ca.SX) -> Replay:
    """(parameters, samples with the states behind) -> the expression at each."""
    traced = model.staged
    sample = ca.vertcat(sample_symbol(model, traced), traced.stages[0].given)
    parameters = ca.vertcat(traced.coordinates, traced.references)
    inputs = [parameters, sample]
    return Replay(
        ca.Function("of", inputs, [ca.densify(expression)], ["parameters", "sample"], ["e"])
    )
