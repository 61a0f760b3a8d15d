"""Differential equations from many beginnings at once: multiple shooting (Bock 1983).

The record is cut; every part begins at states of its own, unknowns beside the parameters, where the
readings say. At first the ends of parts need not meet; they are pulled together harder and harder.
So no trajectory is followed further than a part from where readings hold it, which one of a chaotic
or unstable system could not be: a search goes to the right valley where single shooting sees a
cost without any (Voss, Timmer & Kurths 2004). What comes out is a start for the integrated
equations.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.flow import Flow
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import sample_symbol
from casest.leastsquares.flow import Course, Integrator, Mesh
from casest.leastsquares.problem import Point, Problem
from casest.solve.collocation import Parts, parts_of, states_by_readings
from casest.solve.outcome import Outcome

#: Parts of all runs, and samples of one at least; how hard ends are pulled together, beside what
#: readings say; steps for each, and gain over cost that is not worth a step.
PARTS, ROWS, PULLS, STEPS, GAIN = 25, 3, 10.0 ** np.arange(-2, 7), 15, 1e-3


def shot(problem: Problem, start: Point) -> Outcome | None:
    """Where multiple shooting ends from a start; None where the equations are not such.

    The cost is that of the integrated equations there.
    """
    parts = parts_of(problem.model)
    curved = any(s.parameter.shape.curved for s in problem.slots)
    if parts is None or curved:
        return None
    traced = problem.model.staged
    if ca.depends_on(parts.flow.taken, ca.vertcat(traced.coordinates, ca.SX.sym("none"))):
        return None
    began, count = time.perf_counter(), 0
    shooting = _Shooting.of(problem, start, parts)
    x, nodes = start.x, shooting.guess
    damping = 1e-3
    for pull in PULLS:
        now = shooting.at(x, nodes, pull)
        for _ in range(STEPS):
            count += 1
            step = now.step(damping)
            moved = np.clip(x + step[: len(x)], *problem.bounds)
            there = nodes + step[len(x) :].reshape(nodes.shape)
            tried = shooting.at(moved, there, pull)
            if not tried.cost < now.cost:
                damping *= 8
                if damping > 1e8:
                    break
                continue
            settled = tried.cost > (1 - GAIN) * now.cost
            x, nodes, now, damping = moved, there, tried, max(damping / 5, 1e-9)
            if settled:
                break
        damping = min(damping, 1e-2)
    point = Point(problem.inside(x), start.references)
    seconds = time.perf_counter() - began
    cost = problem.cost(point)
    return Outcome("multiple shooting", point, cost, count, count, True, "pulled together", seconds)


@dataclass(frozen=True)
class _Linear:
    """Rows [J r] of all readings and of the ends of parts at one place."""

    J: Array
    r: Array

    @property
    def cost(self) -> float:
        found = 0.5 * float(self.r @ self.r)
        return found if np.isfinite(found) else np.inf

    def step(self, damping: float) -> Array:
        """A damped Gauss-Newton step."""
        H = self.J.T @ self.J
        H[np.diag_indices_from(H)] += damping * np.maximum(np.diag(H), 1e-12 * np.diag(H).max())
        return np.asarray(-np.linalg.solve(H, self.J.T @ self.r))


@dataclass(frozen=True)
class _Part:
    """A part of run r: its samples from `first` to `last`, and which of all nodes it begins at,
    none where the run does."""

    r: int
    first: int
    last: int
    node: int | None
    mesh: Mesh


@dataclass(frozen=True)
class _Shooting:
    """All parts of a problem; `guess` (nodes, n), their `size` (n,), and a `unit` of residuals."""

    problem: Problem
    start: Point
    programs: _Programs
    parts: tuple[_Part, ...]
    guess: Array
    size: Array
    unit: float

    @classmethod
    def of(cls, problem: Problem, start: Point, parts: Parts) -> _Shooting:
        """Parts as even as may be, in which states begin where readings say."""
        found, guesses, spread, squares = list[_Part](), list[Array](), [], []
        for r, run in enumerate(problem.runs):
            at = problem.parameters(start, r)
            states, residual = states_by_readings(parts, problem.samples[r].dense, run, at)
            rows = max(ROWS, -(-len(run) * len(problem.runs) // PARTS))
            for first in range(0, max(len(run) - 1, 1), rows):
                last = min(first + rows, len(run) - 1)
                found.append(_Part(r, first, last, len(guesses) if first else None, Mesh()))
                guesses += [states[first]] if first else []
            spread.append(np.max(np.abs(states), axis=0))
            squares.append(np.nanmean(residual**2))
        size = np.max(spread, axis=0)
        return cls(
            problem,
            start,
            _programs(problem.model),
            tuple(found),
            np.array(guesses).reshape(len(guesses), len(size)),
            np.where(size > 0, size, 1.0),
            float(np.sqrt(np.mean(squares))) or 1.0,
        )

    def at(self, x: Array, nodes: Array, pull: float) -> _Linear:
        """Rows at parameters x and beginnings of parts, whose ends are pulled so hard."""
        point, n = Point(x, self.start.references), len(self.size)
        whole = len(x) + nodes.size
        rows: list[Array] = []
        for k, part in enumerate(self.parts):
            own, _ = self.problem.seen(part.r)
            states, slopes, begun = self._along(part, point, nodes)
            place = slice(0, 0)
            if part.node is not None:
                place = slice(len(x) + n * part.node, len(x) + n * (part.node + 1))
            wide = np.zeros((len(states), n, whole))
            wide[:, :, own] = slopes[:, :, : len(own)] + slopes[:, :, len(own) :] @ begun
            if part.node is not None:
                wide[:, :, place] = slopes[:, :, len(own) :]
            after = self.parts[k + 1] if k + 1 < len(self.parts) else None
            ends = after is None or after.r != part.r
            count = len(states) - (0 if ends else 1)
            rows.append(self._readings(part, point, states[:count], wide[:count], own))
            if after is not None and not ends and after.node is not None:
                off = np.column_stack([wide[-1], states[-1] - nodes[after.node]])
                there = len(x) + n * after.node
                off[:, there : there + n] -= np.eye(n)
                rows.append(np.sqrt(pull) * off / self.size[:, None])
        both = np.vstack(rows)
        return _Linear(both[:, :-1], both[:, -1])

    def _along(self, part: _Part, point: Point, nodes: Array) -> tuple[Array, Array, Array]:
        """States (K, n) of a part, slopes (K, n, p + n) in parameters and its beginning, and those
        (n, p) of that in parameters."""
        problem, programs = self.problem, self.programs
        parameters = problem.parameters(point, part.r)
        p = len(problem.seen(part.r)[0])
        where = slice(part.first, part.last + 1)
        if part.node is None:
            start, begun = (np.array(v, float) for v in programs.beginning(parameters))
        else:
            start, begun = nodes[part.node], np.zeros((len(self.size), p))
        samples = problem.samples[part.r].dense[where]
        inputs = np.array(programs.taken.map(len(samples))(samples.T)).T
        given = np.concatenate([parameters[:p], start.ravel(), parameters[p:]])
        time = np.asarray(problem.runs[part.r].time, float)[where]
        none = np.zeros((*inputs.shape, p + len(self.size)))
        follow = programs.first if part.node is None else programs.later
        found = follow.along(given, Course(time, inputs, none), part.mesh)
        return *found, begun.reshape(len(self.size), p)

    def _readings(self, part: _Part, point: Point, states: Array, wide: Array, own: Any) -> Array:
        """[J r] of the readings of a part."""
        where = slice(part.first, part.first + len(states))
        samples = self.problem.samples[part.r].dense[where]
        parameters = self.problem.parameters(point, part.r)
        function = self.programs.residual
        found = function.map(len(states))(
            states.T, samples.T, np.tile(parameters[:, None], (1, len(states)))
        )
        r, G, B = (np.array(e, float).reshape(-1, len(states), e.shape[1] // len(states))
                   .transpose(1, 0, 2) for e in found)  # fmt: skip
        J = G @ wide
        J[:, :, own] += B
        rows = np.concatenate([J, r], axis=2).reshape(-1, wide.shape[2] + 1)
        return np.where(np.isfinite(rows[:, -1:]), np.nan_to_num(rows), 0.0) / self.unit


@dataclass(frozen=True)
class _Programs:
    """Functions of a model: how a part is followed, the `first` of a run and a `later` one, what
    inputs rates take of a sample, the residual with its slopes, and where a run begins."""

    first: Integrator
    later: Integrator
    taken: Any
    residual: Any
    beginning: Any


@lru_cache(maxsize=8)
def _programs(model: Model) -> _Programs:
    traced = model.staged
    flow = traced.stages[0]
    assert isinstance(flow, Flow)
    node, sample = ca.SX.sym("node", flow.x.numel()), sample_symbol(model, traced)
    free = replace(traced, coordinates=ca.vertcat(traced.coordinates, node))
    parameters = ca.vertcat(traced.coordinates, traced.references)
    slopes = [ca.jacobian(traced.expression, v) for v in (flow.given, traced.coordinates)]
    outputs = [ca.densify(e) for e in (traced.expression, *slopes)]
    begin = [flow.start, ca.jacobian(flow.start, traced.coordinates)]
    return _Programs(
        Integrator(free, replace(flow, start=node)),
        Integrator(free, replace(flow, start=node, anchored=False)),
        ca.Function("taken", [sample], [ca.densify(flow.taken)]),
        ca.Function("residual", [flow.given, sample, parameters], outputs),
        ca.Function("beginning", [parameters], [ca.densify(e) for e in begin]),
    )
