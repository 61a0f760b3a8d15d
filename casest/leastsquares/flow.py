"""States that follow differential equations along a record, and their slopes in the parameters.

ẋ = f(x, u, θ) and Ẋ = f_x·X + f_u·U + f_θ (variational equations; X = ∂x/∂θ) are integrated
together by a Runge-Kutta method of eighth order, whose steps end at every sample: an input is
smooth between two, and what jumps at one is not smeared. X is the exact slope of the x computed.
Each step's error is told by two embedded solutions; where it is too large an interval is cut.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Index
from casest.declaration.flow import Flow
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import Traced
from casest.engine import Direct, Recursion
from casest.engine.runge_kutta import ORDER, error
from casest.leastsquares.stepping import HELD, Inputs, Switched, Way, numbers, switched
from casest.leastsquares.stiff import Stiff

#: Error of a step allowed, of the largest size that a state has along the record.
TOLERANCE = 1e-10
#: Steps of one run in all, from which on it is given up, the equations being stiff there; and from
#: which on implicit ones are tried, where they can be.
MOST, MANY = 300_000, 30_000
#: Rounds in which steps are cut; how much at most in one round; a little more than needed.
ROUNDS, CUT, MARGIN = 30, 8.0, 1.1
#: Difference that stands for a step which did not succeed.
FAILED = 1e100
#: An interval along which states are not finite is cut so much in one round, and so much in all.
BLIND, BLINDLY = 4, 1024
#: Processor time at which equations are followed no further.
_until: ContextVar[float] = ContextVar("_until", default=float("inf"))


class GivenUp(Exception):
    """The time that was given for following equations is over."""


@contextmanager
def for_seconds(seconds: float) -> Iterator[None]:
    """Within it equations are followed for so much processor time, and GivenUp is raised then."""
    token = _until.set(min(time.process_time() + seconds, _until.get()))
    try:
        yield
    finally:
        _until.reset(token)


def left() -> float:
    """Seconds for which equations may still be followed."""
    return _until.get() - time.process_time()


@dataclass
class Mesh:
    """Steps of one run: how many in each interval between samples; None before the first time.

    `stiff`: explicit ones would be too many, and implicit ones are made instead.
    """

    counts: Index | None = None
    stiff: bool = False
    _laid: Laid | None = None

    def laid(self, counts: Index, time: Array) -> Laid:
        """Where so many steps lie; what was asked for last is kept."""
        if self._laid is None or self._laid.counts is not counts:
            self._laid = Laid.of(counts, time)
        return self._laid


@dataclass(frozen=True)
class Laid:
    """Steps (S,) one after the other: the interval of each, its place there and its width as shares
    of that, its length in s; after how many of them each time (N,) is reached."""

    counts: Index
    reached: Index
    place: Index
    part: Array
    width: Array
    length: Array

    @classmethod
    def of(cls, counts: Index, time: Array) -> Laid:
        """So many steps in each interval between times (N,)."""
        reached = np.concatenate([[0], np.cumsum(counts)])
        place = np.repeat(np.arange(len(counts)), counts)
        part = (np.arange(len(place)) - reached[place]) / counts[place]
        width = 1.0 / counts[place]
        return cls(counts, reached, place, part, width, np.diff(time)[place] * width)


@dataclass(frozen=True)
class Course:
    """One record as equations see it: time (N,) in s, inputs (N, k), slopes of these (N, k, p)."""

    time: Array
    inputs: Array
    slopes: Array


@dataclass(frozen=True)
class Integrator:
    """One flow of a model; `own` as in `Staged.rows`; `fed`: its inputs have slopes."""

    traced: Traced
    flow: Flow
    own: tuple[int, ...] | None = None
    fed: bool = False

    @property
    def _coordinates(self) -> SX:
        every = self.traced.coordinates
        return every if self.own is None else every[list(self.own)]

    @cached_property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of states n, inputs k, and unknowns p that slopes are taken in."""
        return self.flow.x.numel(), self.flow.inputs.numel(), self._coordinates.numel()

    def along(
        self, parameters: Array, course: Course, mesh: Mesh, finer: int = 1
    ) -> tuple[Array, Array]:
        """States (N, n) and slopes (N, n, p) at every sample; NaN from where it could not go on.

        `finer`: every step is cut in so many.
        """
        if left() <= 0:
            raise GivenUp
        n = self.sizes[0]
        leads = self.flow.anchored and course.time[0] > 0
        course = self._from_zero(course) if leads else course
        if mesh.counts is None:
            mesh.counts = np.ones(len(course.time) - 1, dtype=int)
        (start,) = self._start(parameters)
        if mesh.stiff:
            found = self._implicit(start, parameters, course)
            mesh.stiff = not self._mild(found[:, :n], parameters, course)
            if np.isfinite(found).all():
                return self._unpacked(found[int(leads) :])
            mesh.counts = np.ones_like(mesh.counts)
        for _ in range(ROUNDS):
            counts = mesh.counts if finer == 1 else mesh.counts * finer
            laid = mesh.laid(counts, course.time)
            states, errors, held = self._run(start, parameters, course, laid)
            if finer > 1:
                break
            wanted = self._wanted(states[:, :n], errors, held, laid)
            settled, many = bool((wanted <= counts).all()), int(wanted.sum())
            if settled and many > 0.8 * (len(states) - 1):
                break
            if many > MANY + 4 * len(counts) and self._stiff is not None:
                found = self._implicit(start, parameters, course)
                mesh.stiff = bool(np.isfinite(found).all())
                if mesh.stiff:
                    return self._unpacked(found[int(leads) :])
            if many > MOST + len(counts):
                states = self._cut_off(states, laid, wanted)
                break
            mesh.counts = wanted
            if settled:
                break  # the next time with fewer
        return self._unpacked(states[laid.reached[int(leads) :]])

    def _unpacked(self, found: Array) -> tuple[Array, Array]:
        """States (N, n) and slopes (N, n, p) of [x, X] (N, n + n·p)."""
        n, _, p = self.sizes
        return found[:, :n], found[:, n:].reshape(len(found), p, n).transpose(0, 2, 1)

    def _mild(self, states: Array, parameters: Array, course: Course) -> bool:
        """Would explicit steps be few along these states, as fast as they change? Also where they
        could not be followed: the next time explicit steps are tried."""
        count, n = states.shape
        slopes = self._slope.map(count)(
            states.T, course.inputs.T, np.tile(parameters[:, None], (1, count))
        )
        A = np.array(slopes).T.reshape(count, n, n)
        if not np.isfinite(A).all():
            return True
        fastest = np.max(np.abs(np.linalg.eigvals(A)), axis=1)
        between = np.maximum(fastest[1:], fastest[:-1]) * np.diff(course.time)
        return bool(np.sum(between) < 0.5 * MANY)

    @cached_property
    def _slope(self) -> ca.Function:
        """(x, inputs, parameters) -> ∂f/∂x (n, n)."""
        parameters = ca.vertcat(self.traced.coordinates, self.traced.references)
        A = ca.jacobian(self.flow.rates, self.flow.x)
        return ca.Function("A", [self.flow.x, self.flow.inputs, parameters], [ca.densify(A)])

    def _implicit(self, start: Array, parameters: Array, course: Course) -> Array:
        """[x, X] at every sample by a method for stiff equations; NaN behind the first where it
        cannot go on, jumps, or is fed by inputs."""
        found = np.full((len(course.time), len(start)), np.nan)
        found[0] = start
        if self._stiff is None:
            return found
        clock = self.flow.clock
        late = 0.0 if clock is None else course.inputs[0, clock] - course.time[0]
        along = self._stiff.along(start, parameters, course.time + late)
        return found if along is None else along

    @cached_property
    def _stiff(self) -> Stiff | None:
        """The equations of [x, X] as a whole; None where they jump or are fed by inputs."""
        flow, (n, k, p) = self.flow, self.sizes
        if k > (flow.clock is not None) or self._held.modes.numel():
            return None
        X = ca.SX.sym("X", n, p)
        A, B = ca.jacobian(flow.rates, flow.x), ca.jacobian(flow.rates, self._coordinates)
        rate = ca.vertcat(flow.rates, ca.vec(A @ X + B))
        clock = None if flow.clock is None else flow.inputs[flow.clock]
        parameters = ca.vertcat(self.traced.coordinates, self.traced.references)
        return Stiff(ca.vertcat(flow.x, ca.vec(X)), ca.densify(rate), parameters, clock)

    def _from_zero(self, course: Course) -> Course:
        """The course from t = 0 on: inputs are as at the first sample until then."""
        first, clock = course.inputs[:1].copy(), self.flow.clock
        if clock is not None:
            first[0, clock] -= course.time[0]
        return Course(
            np.concatenate([[0.0], course.time]),
            np.vstack([first, course.inputs]),
            np.concatenate([course.slopes[:1], course.slopes]),
        )

    def _run(
        self, start: Array, parameters: Array, course: Course, laid: Laid
    ) -> tuple[Array, tuple[Array, Array], NDArray[np.bool_]]:
        """[x, X] at the start and after every step, of each its fifth- and third-order differences,
        and was it held?"""
        n, _, p = self.sizes
        held = np.array(self.flow.held, dtype=bool)
        columns, kinds = [laid.length[:, None]], []
        if held.size:
            kinds.append((course.inputs, held))
        if self.fed:
            kinds.append((course.slopes.reshape(len(course.time), -1), np.repeat(held, p)))
        for values, keep in kinds:
            rise = np.where(keep, 0.0, np.diff(values, axis=0))[laid.place]
            columns += [values[laid.place] + rise * laid.part[:, None], rise * laid.width[:, None]]
        given = np.hstack(columns) if len(columns) > 1 else columns[0]
        rows = [given, np.broadcast_to(parameters, (len(given), len(parameters)))]
        with np.errstate(all="ignore"):
            crosses = "_crossing" in vars(self)
            if not crosses:
                states, errors = self._recursion(start, rows)
                crosses = bool(np.any(errors[:, 2 * n] > 0))
            if crosses:
                states, errors = self._crossing(start, rows)
                errors[errors[:, 2 * n] == 1, :n] = FAILED
        states = np.concatenate([start[None], states])
        return states, (errors[:, :n], errors[:, n : 2 * n]), errors[:, 2 * n] == HELD

    def _wanted(
        self, x: Array, errors: tuple[Array, Array], held: NDArray[np.bool_], laid: Laid
    ) -> Index:
        """Steps for each interval by which errors are as large as allowed, at least one."""
        counts, ends, finite = laid.counts, laid.reached[1:], np.isfinite(x)
        bad = np.flatnonzero(~finite.all(axis=1)) if not finite.all() else np.zeros(0, int)
        steps = len(x) - 1 if not bad.size else int(bad[0]) - 1
        size = np.abs(x[: steps + 1]).max(axis=0)
        allowed = TOLERANCE * np.where(size > 0, size, 1.0)
        share = error(errors[0][:steps], errors[1][:steps], allowed)
        if bad.size:
            share = np.concatenate([share, np.zeros(len(x) - 1 - steps)])
        worst = np.maximum.reduceat(share, laid.reached[:-1])
        cut = np.minimum(MARGIN * worst ** (1 / ORDER), CUT)
        wanted: Index = np.maximum(np.ceil(counts * cut - 1e-9).astype(int), 1)
        if bad.size:
            first = int(np.searchsorted(ends, steps, side="right"))
            settled = bool(np.all(wanted[:first] <= counts[:first]))
            wanted[first:] = counts[first:] * (1 if held[steps] else BLIND)
            if wanted[first] > BLINDLY or (held[steps] and settled):
                wanted[first] = 2 * MOST
        return wanted

    @staticmethod
    def _cut_off(states: Array, laid: Laid, wanted: Index) -> Array:
        """Nothing from the first interval on that would take too many steps."""
        states = states.copy()
        first = int(np.argmax(wanted > laid.counts))
        states[int(laid.reached[first]) + 1 :] = np.nan
        return states

    @cached_property
    def _start(self) -> Direct:
        """θ -> [x, X] at the beginning."""
        both = [self.flow.start, ca.jacobian(self.flow.start, self._coordinates)]
        whole = ca.vertcat(*(ca.vec(ca.densify(part)) for part in both))
        parameters = ca.vertcat(self.traced.coordinates, self.traced.references)
        return Direct(ca.Function("start", [parameters], [ca.densify(whole)]))

    @cached_property
    def _held(self) -> Switched:
        """The rates, their jumps and corners held."""
        return switched(self.flow, ca.vertcat(self.traced.coordinates, self.traced.references))

    @cached_property
    def _recursion(self) -> Recursion:
        """([x, X], numbers of a step) -> the next, the differences of x, and: did a mode change?"""
        return Recursion(self._stepping(self._plain))

    @cached_property
    def _crossing(self) -> Recursion:
        """The same, where a mode changes through that change; the last says that it failed."""
        return Recursion(self._stepping(self._plain), self._stepping(Way.through))

    @staticmethod
    def _plain(way: Way, x: SX, X: SX, given: Inputs, h: SX) -> tuple[SX, SX, SX, SX]:
        modes = way.first_modes(x, given, h)
        x, X, differences = way.step(x, X, given, h, modes)
        return x, X, differences, ca.sum1(way.crossed(x, given, modes))

    def _stepping(self, through: Callable[..., tuple[SX, SX, SX, SX]]) -> ca.Function:
        n, k, p = self.sizes
        given, h = numbers(k, p), ca.SX.sym("h")
        y = ca.SX.sym("y", n + n * p)
        way = Way(self.flow, self._held, self._coordinates, self.fed)
        x, X, differences, mark = through(way, y[:n], ca.reshape(y[n:], n, p), given, h)
        after = ca.vertcat(x, ca.vec(X))
        # Slopes of inputs lie row by row, as arrays do.
        fed = [ca.vec(given.U.T), ca.vec(given.faster.T)] if self.fed else []
        parameters = ca.vertcat(self.traced.coordinates, self.traced.references)
        row = ca.vertcat(h, given.u, given.du, *fed)
        outputs = [ca.densify(after), ca.densify(ca.vertcat(differences, mark))]
        return ca.Function("step", [y, row, parameters], outputs)


def flows(stages: Sequence[object]) -> list[Flow]:
    """Those of the stages that are differential equations."""
    return [stage for stage in stages if isinstance(stage, Flow)]
