"""Differential equations as constraints: collocation, solved by IPOPT.

States at many times are unknowns beside the parameters, and begin where the readings say. So a
search does not follow a trajectory from a wrong beginning with wrong parameters: what makes a cost
of integrated equations hilly (oscillations, chaos, what grows without bound) is not met on the way
(Biegler 2010, ch. 10). What comes out is a start near the solution, as near as the polynomials are;
the integrated equations are fitted from there.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Index, Run
from casest.declaration.flow import Flow
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat, sample_symbol
from casest.interruption import held_back
from casest.leastsquares.problem import Point, Problem
from casest.solve.outcome import Outcome

#: Points of a polynomial piece (Radau), and pieces of all runs at least and at most.
DEGREE, FEWEST, MOST = 4, 60, 1500
#: Iterations, and seconds that a start may take at most.
ITERATIONS, SECONDS = 400, 30.0
#: Programs kept for the next problem of their kind.
KEPT = 4


@dataclass(frozen=True)
class Parts:
    """What collocation needs of a model: rates and residual as functions, and its one flow."""

    flow: Flow
    rates: Any
    residual: Any
    predicted: Any
    start: Any


@lru_cache(maxsize=32)
def parts_of(model: Model) -> Parts | None:
    """None for a model whose equations are fed by what looks at other samples, or that has none."""
    traced = model.staged
    if len(traced.stages) != 1 or not isinstance(traced.stages[0], Flow):
        return None
    flow = traced.stages[0]
    parameters = ca.vertcat(traced.coordinates, traced.references)
    sample = sample_symbol(model, traced)
    if not ca.depends_on(traced.expression, flow.given):
        return None
    reading = ca.vertcat(*(flat(traced.symbols[n]) for n in traced.readings))
    # Readings that are not there are told by their own symbols: their rows are left out.
    return Parts(
        flow,
        ca.Function("rates", [flow.x, flow.inputs, parameters], [ca.densify(flow.rates)]),
        ca.Function(
            "residual",
            [flow.given, sample, parameters],
            [traced.expression, ca.densify(reading), ca.densify(flow.taken)],
        ),
        ca.Function(
            "predicted",
            [flow.given, sample, parameters],
            [traced.predicted, ca.jacobian(traced.predicted, flow.given)],
        ),
        ca.Function("start", [parameters], [ca.densify(flow.start)]),
    )


def collocated(problem: Problem, start: Point, seconds: float = SECONDS) -> Outcome | None:
    """Where IPOPT ends on the collocated equations from a start; None where they are not such.

    The cost is that of the integrated equations there. IPOPT is given so many `seconds` at most.
    """
    parts = parts_of(problem.model)
    if parts is None or any(s.parameter.shape.curved for s in problem.slots):
        return None
    began = time.perf_counter()
    made = _Made(problem, parts, start)
    with held_back(), np.errstate(all="ignore"):
        found = made.solved(min(seconds, SECONDS))
    x = np.clip(found.x[: problem.unknowns] * made.scale, *problem.bounds)
    point = Point(problem.inside(x), start.references)
    return Outcome(
        "collocation",
        point,
        problem.cost(point),  # where slopes are too large for numbers there still is one
        found.iterations,
        found.iterations,
        found.success,
        found.status,
        time.perf_counter() - began,
    )


@dataclass(frozen=True)
class _Found:
    x: Array
    iterations: int
    success: bool
    status: str


@dataclass(frozen=True)
class _Kind:
    """All that the nonlinear program of a problem depends on but numbers, which it is given.

    `runs`: of each the unknowns that it sees, how many references, where in its pieces the samples
    are, and how many pieces.
    """

    model: Model
    unknowns: int
    runs: tuple[tuple[tuple[int, ...], int, tuple[int, ...], int], ...]
    seconds: float


class _Program:
    """IPOPT on the program of a kind."""

    def __init__(self, kind: _Kind) -> None:
        parts = parts_of(kind.model)
        assert parts is not None
        self._parts, self._kind = parts, kind
        v, scale = (ca.MX.sym(name, kind.unknowns) for name in ("v", "scale"))
        unit = ca.MX.sym("unit")
        self._unknowns, self._given = [v], [scale, unit]
        self._equalities: list[Any] = []
        self._cost: Any = 0.0
        for run in kind.runs:
            self._add(v * scale, *run)
        nlp = {
            "x": ca.vertcat(*self._unknowns),
            "p": ca.vertcat(*map(ca.vec, self._given)),
            "f": self._cost / unit,
            "g": ca.vertcat(*self._equalities),
        }
        settings = {
            "print_level": 0,
            "sb": "yes",
            "max_iter": ITERATIONS,
            "max_wall_time": kind.seconds,
            "tol": 1e-8,
            "mu_init": 1e-2,
        }
        options = {
            "ipopt": settings,
            "print_time": False,
            "show_eval_warnings": False,
            "calc_lam_p": False,
        }
        self.solver = ca.nlpsol("collocation", "ipopt", nlp, options)

    def _add(
        self, x: Any, own: tuple[int, ...], references: int, nodes: tuple[int, ...], pieces: int
    ) -> None:
        """One run: its states, what ties them together, and its residuals; numbers in the order of
        `Grid.numbers`."""
        parts, count = self._parts, pieces * DEGREE
        n, (inputs, _) = parts.flow.x.numel(), parts.rates.size_in(1)
        axes, (width, _) = parts.residual.size1_out(0), parts.residual.size_in(1)
        shapes = {
            "references": (references, 1),
            "steps": (1, pieces),
            "inputs": (inputs, count),
            "samples": (width, len(nodes)),
            "there": (axes, len(nodes)),
            "size": (n, 1),
        }
        given = {name: ca.MX.sym(name, *shape) for name, shape in shapes.items()}
        self._given += given.values()
        parameters = ca.vertcat(x[list(own)], given["references"])
        z, size = ca.MX.sym("x", n, count), given["size"]
        states = z * ca.repmat(size, 1, count)
        begin = parts.start(parameters)
        ends = states[:, DEGREE - 1 :: DEGREE]
        before = ca.horzcat(begin, ends[:, :-1])
        rates = parts.rates.map(count)(states, given["inputs"], ca.repmat(parameters, 1, count))
        slope, first = _radau()
        lengths = ca.repmat(given["steps"], n, 1) / ca.repmat(size, 1, pieces)
        for k in range(DEGREE):
            moved = first[k] * before
            for j in range(DEGREE):
                moved = moved + slope[j][k] * states[:, j::DEGREE]
            tied = moved / ca.repmat(size, 1, pieces) - rates[:, k::DEGREE] * lengths
            self._equalities.append(ca.vec(tied))
        seen = ca.horzcat(begin, ends)[:, list(nodes)]
        residual = parts.residual.map(len(nodes))(
            seen, given["samples"], ca.repmat(parameters, 1, len(nodes))
        )[0]
        self._cost += 0.5 * ca.sumsqr(residual * given["there"])
        self._unknowns.append(ca.vec(z))


_idle: dict[_Kind, list[_Program]] = {}


@contextmanager
def _program(kind: _Kind) -> Iterator[_Program]:
    """The program of this kind; making it takes longer than solving it, so it is kept.

    Taken off the shelf while in use: two threads never share one.
    """
    shelf = _idle.pop(kind, [])
    program = shelf.pop() if shelf else _Program(kind)
    yield program
    _idle[kind] = [*_idle.pop(kind, shelf), program]  # what was used last is the last
    while len(_idle) > KEPT:
        with suppress(KeyError, StopIteration):
            del _idle[next(iter(_idle))]


class _Made:
    """The numbers of a problem's nonlinear program, and where its unknowns begin."""

    def __init__(self, problem: Problem, parts: Parts, start: Point) -> None:
        self.problem, size = problem, np.abs(start.x)
        self.scale = np.where(size > 0, size, 1.0)
        every = range(len(problem.runs))
        grids = [Grid.of(problem, r, parts, problem.parameters(start, r)) for r in every]
        self.first = [start.x / self.scale, *((g.guess / g.size).ravel() for g in grids)]
        #: Half the squares of residuals as if states stayed where they begin.
        unit = max(sum(g.still for g in grids), 1e-300)
        self.given, kinds = [self.scale, np.array([unit])], []
        for r, grid in zip(every, grids, strict=True):
            own, ref = problem.seen(r)
            references = start.references[ref]
            self.given += [references, *grid.numbers()]
            nodes = tuple(grid.nodes.tolist())
            kinds.append((tuple(own.tolist()), len(references), nodes, grid.pieces))
        self.runs = tuple(kinds)

    def solved(self, seconds: float) -> _Found:
        """What IPOPT finds in this time, which is rounded up to whole seconds."""
        w0, lower_upper = np.concatenate(self.first), self.problem.bounds
        lower, upper = (b / self.scale for b in lower_upper)
        free = np.full(len(w0) - self.problem.unknowns, np.inf)
        kind = _Kind(self.problem.model, self.problem.unknowns, self.runs, float(np.ceil(seconds)))
        with _program(kind) as program:
            found = program.solver(
                x0=w0,
                p=np.concatenate(self.given),
                lbx=np.concatenate([lower, -free]),
                ubx=np.concatenate([upper, free]),
                lbg=0,
                ubg=0,
            )
            stats = program.solver.stats()
        return _Found(
            np.array(found["x"]).ravel(),
            int(stats.get("iter_count", 0)),
            bool(stats["success"]),
            str(stats["return_status"]),
        )


@dataclass(frozen=True)
class Grid:
    """Pieces of one run: their lengths, inputs at all their points, and samples at `nodes`.

    `nodes`: which ends of pieces the samples are, 0 the beginning; `there`: which readings are;
    `guess` (points, n): states as readings say them; `size` (n,) of these; `still`: cost of states
    that stay where they begin.
    """

    steps: Array
    inputs: Array
    nodes: Index
    samples: Array
    there: Any
    guess: Array
    size: Array
    still: float

    @property
    def pieces(self) -> int:
        """How many."""
        return len(self.steps)

    def numbers(self) -> list[Array]:
        """What the program is given of it, each matrix column by column."""
        there = self.there.astype(float)
        rows = self.steps, self.inputs, np.nan_to_num(self.samples), there, self.size
        return [np.ravel(part) for part in rows]

    @classmethod
    def of(cls, problem: Problem, r: int, parts: Parts, at: Array) -> Grid:
        """Pieces end at samples, all of them or some; long intervals are cut."""
        run, whole = problem.runs[r], problem.samples[r].dense
        time, room = np.asarray(run.time, float), MOST // len(problem.runs)
        chosen = np.unique(np.linspace(0, len(time) - 1, min(len(time), room + 1)).astype(int))
        samples, t = whole[chosen], time[chosen]
        zero = parts.flow.anchored and t[0] > 0
        knots = np.concatenate([[0.0], t]) if zero else t
        cut = max(1, -(-FEWEST // max(len(knots) - 1, 1)))
        steps = np.repeat(np.diff(knots) / cut, cut)
        starts = np.concatenate([[knots[0]], knots[0] + np.cumsum(steps)[:-1]])
        points = (starts[:, None] + steps[:, None] * _points()).ravel()
        residual, reading, taken = parts.residual.map(len(samples))(
            np.tile(np.array(parts.start(at)), (1, len(samples))),
            samples.T,
            np.tile(at[:, None], (1, len(samples))),
        )
        u = np.array(taken).T
        inputs = _inputs(parts.flow, t, u, points)
        y = np.array(reading).T
        guess = _guess(parts, samples, at, t, y, points)
        size = np.maximum(np.abs(guess).max(axis=0), 1e-300)
        nodes = (np.arange(len(t)) + zero) * cut
        still = 0.5 * float(np.nansum(np.array(residual) ** 2))
        return cls(steps, inputs, nodes, samples, np.isfinite(y), guess, _filled(size), still)


def _filled(size: Array) -> Array:
    """Sizes of states, those of nothing as large as the others."""
    real = size > 1e-12
    return np.where(real, size, np.median(size[real]) if real.any() else 1.0)


def _inputs(flow: Flow, t: Array, u: Array, points: Array) -> Array:
    """Inputs at the points (P, k): straight lines between samples, or held."""
    found = np.empty((len(points), u.shape[1]))
    before = np.clip(np.searchsorted(t, points, side="left") - 1, 0, len(t) - 1)
    for j in range(u.shape[1]):
        held = flow.held[j]
        found[:, j] = u[before, j] if held else np.interp(points, t, u[:, j])
        if j == flow.clock:
            found[:, j] += np.minimum(points - t[0], 0.0)
    return found


def _guess(parts: Parts, samples: Array, at: Array, t: Array, y: Array, points: Array) -> Array:
    """States (P, n) by readings, as far as these say it; else as they begin."""
    start = np.array(parts.start(at)).ravel()
    found = np.tile(start, (len(samples), 1))
    filled = np.column_stack([_between(t, y[:, j]) for j in range(y.shape[1])])
    for _ in range(3):
        h, C = parts.predicted.map(len(samples))(
            found.T, np.nan_to_num(samples).T, np.tile(at[:, None], (1, len(samples)))
        )
        away = filled - np.array(h).T
        slopes = np.array(C.full()).reshape(C.shape[0], len(samples), -1).transpose(1, 0, 2)
        step = np.linalg.pinv(np.nan_to_num(slopes), rcond=1e-8) @ np.nan_to_num(away)[:, :, None]
        found = found + step[:, :, 0]
    return np.column_stack([np.interp(points, t, found[:, i]) for i in range(len(start))])


def states_by_readings(parts: Parts, samples: Array, run: Run, at: Array) -> tuple[Array, Array]:
    """States (N, n) at samples as far as readings say them, else as they begin, and the residual
    (N, m) of these."""
    t = np.asarray(run.time, float)

    def residual(states: Array) -> Any:
        return parts.residual.map(len(samples))(
            states.T, np.nan_to_num(samples).T, np.tile(at[:, None], (1, len(samples)))
        )

    still = np.tile(np.array(parts.start(at)).ravel(), (len(samples), 1))
    y = np.array(parts.residual.map(len(samples))(
        still.T, samples.T, np.tile(at[:, None], (1, len(samples))))[1]).T  # fmt: skip
    return _guess(parts, samples, at, t, y, t), np.array(residual(still)[0], float).T


def _between(t: Array, y: Array) -> Array:
    """Readings, those that are missing as straight lines between the others."""
    there = np.isfinite(y)
    return np.interp(t, t[there], y[there]) if there.any() else np.zeros_like(y)


@lru_cache(maxsize=1)
def _points() -> Array:
    return np.array(ca.collocation_points(DEGREE, "radau"))


@lru_cache(maxsize=1)
def _radau() -> tuple[Array, Array]:
    """Slopes of the polynomial through a piece's points, at each: of its points, of its start."""
    tau = np.concatenate([[0.0], _points()])
    slopes = np.empty((DEGREE + 1, DEGREE + 1))
    for j in range(DEGREE + 1):
        p = np.poly1d([1.0])
        for i in range(DEGREE + 1):
            if i != j:
                p *= np.poly1d([1.0, -tau[i]]) / (tau[j] - tau[i])
        slopes[j] = np.polyder(p)(tau)
    return slopes[1:, 1:], slopes[0, 1:]
