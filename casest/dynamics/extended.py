"""Nonlinear models step by step: the motion between two samples, and the extended Kalman filter.

Between samples the state follows two fourth-order Runge-Kutta steps, more where the motion is fast,
inputs being straight lines; Φ is the Jacobian of that very map, so that filter, smoother and least
squares speak of one problem.
Readings are linearised at the prediction and again where they lead to (Jazwinski 1970, 8.3).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics import factors
from casest.dynamics.between import balance, noise_of
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import Steps
from casest.dynamics.factors import Factors
from casest.dynamics.inputs import as_read, at_estimates, estimates, slopes, uncertain
from casest.dynamics.samples import AtSamples
from casest.dynamics.stepping import entries, packed, reach, unpacked
from casest.dynamics.transition import (
    Pace,
    acting,
    checked_record,
    checked_time,
    linearised,
    lost,
    shares,
    variances,
    with_lost,
)
from casest.engine import Recursion
from casest.errors import DataError

#: ‖A‖h of a piece that Runge-Kutta follows well, pieces at least and at most, and ‖A‖h that it
#: cannot follow.
PIECE, FEWEST, MOST, UNSTABLE = 0.5, 2, 16, 2.5

#: Samples that are linearised at once.
_BLOCK = 4096

#: Rounds of the filter's update where a reading is no linear function of the state.
ITERATIONS = 4


@dataclass(frozen=True)
class Sampled:
    """A record as a nonlinear model takes it, to be linearised along states piece by piece.

    `ends`: inputs at both ends of every step; `steps` (N − 1, 1) their lengths, `shares` what part
    of the usual one the readings there stand for; `R` (N, m); `signals`: (N, …) each, uncertain
    ones as estimated behind; `parts`: into how many pieces a step is cut; `noise` (N − 1, k): what
    uncertain inputs are more than they were read, in each step, about which they are linearised.
    """

    model: Dynamics
    pace: Pace
    ends: tuple[Array, Array]
    steps: Array
    shares: Array
    R: Array
    signals: tuple[Array, ...]
    parts: int
    noise: Array

    @classmethod
    def of(
        cls,
        model: Dynamics,
        run: Run,
        pace: Pace | None = None,
        calm: Mapping[str, Array] | None = None,
    ) -> Sampled:
        """`pace`: how the whole record is read where this is a part of it; `calm`: the estimates of
        uncertain inputs, where they are known already."""
        time, calm = checked_record(model, run), estimates(model, run) if calm is None else calm
        u, step, pace = _inputs(model, run, calm), np.diff(time), pace or Pace.of(model, run)
        signals = (*(run.signals[s.name] for s in model.signals), *calm.values())
        return cls(
            model,
            pace,
            (u[:-1], _at_ends(model, u)),
            step[:, None],
            _stood_for(step, pace),
            variances(model, step, pace),
            signals,
            pieces(model, run, pace),
            np.zeros((len(step), len(shifted(model)))),
        )

    def at(self, run: Run, noise: Array, calm: Mapping[str, Array]) -> Sampled:
        """The same linearised about other noise and estimates of uncertain inputs."""
        u = _inputs(self.model, run, calm)
        signals = (*(run.signals[s.name] for s in self.model.signals), *calm.values())
        ends = u[:-1], _at_ends(self.model, u)
        return replace(self, ends=ends, signals=signals, noise=noise)

    def moved(self, along: Array, first: int = 0) -> tuple[Array, Array, Array]:
        """Φ, forced step and Q of the steps from states (K, n), that of sample `first` before."""
        where = slice(first, first + len(along))
        given = [part[where] for part in (*self.ends, self.steps, self.shares, self.noise)]
        step = _step(self.model, self.parts)
        Phi, forced, Q = step([np.ascontiguousarray(along), *given])
        return Phi, forced[:, :, 0], Q

    def after(self, x: Array, sample: int) -> Array:
        """The state a step after x (n,) at a sample."""
        given = [part[sample] for part in (*self.ends, self.steps, self.shares)]
        return np.array(motion(self.model, self.parts)(x, *given)[0], float).ravel()

    def followed(self, x: Array) -> Array:
        """States (N, n) without noise from x (n,) at the first sample."""
        (after,) = _following(self.model, self.parts)(x, [*self.ends, self.steps, self.shares])
        return np.vstack([x, after])

    def read(self, along: Array, first: int = 0) -> tuple[Array, Array, Array]:
        """C, d and y at states (K, n), that of sample `first` before."""
        own = [part[first : first + len(along)] for part in self.signals]
        return _rows(self.model, own, along)

    def along(self, states: Array, first: int = 0) -> Steps:
        """Samples from `first` on, linearised along states (K, n)."""
        Phi, forced, Q = self.moved(states[:-1], first)
        last = first + len(states) - 1
        pace = self.pace.part(slice(first, last + 1))
        Q = with_lost(self.model, self.steps[first:last, 0], Phi, Q, pace)
        C, d, y = self.read(states, first)
        R, of_C = self.R[first : last + 1], entries(self.model.traced.C)
        return Steps(Phi, forced, Q, C, d, R, y, reach(self.model.traced.A), of_C)


def relinearised(model: Dynamics, run: Run, along: Array, pace: Pace | None = None) -> Steps:
    """The record in discrete time, linearised along states (N, n).

    `pace`: how the whole record is read where this is a part of it.
    """
    return Sampled.of(model, run, pace).along(along)


def with_errors(steps: Steps, model: Dynamics, run: Run, along: Array, errors: Array) -> Steps:
    """Steps along states (N, n) on whose errors, of covariances (N, n, n), noise of inputs acts."""
    added = acting(model, run, along, errors)
    step = np.diff(np.asarray(run.time, float))[:, None, None]
    return replace(steps, Q=steps.Q + 0.5 * step * (added[1:] + added[:-1]))


def _rows(model: Dynamics, signals: Sequence[Array], along: Array) -> tuple[Array, Array, Array]:
    """Readings as rows: C, d and y."""
    C, d, y = (part[:, :, 0] if k else part for k, part in enumerate(
        _outputs(model)([np.ascontiguousarray(along), *signals])))  # fmt: skip
    return C, d, model.traced.nearest(y, C, d, along)


@lru_cache(maxsize=8)
def _step(model: Dynamics, count: int) -> AtSamples:
    x, (u, v, h, share) = model.traced.x, two_samples(model)
    w = ca.SX.sym("w", len(shifted(model)))
    end, Phi, Q = motion(model, count)(x, *at_noise(model, u, v, w), h, share)
    forced = end - Phi @ x - ca.jacobian(end, w) @ w
    return AtSamples(ca.vertcat(x, u, v, h, share, w), [Phi, forced, Q])


@lru_cache(maxsize=8)
def _following(model: Dynamics, count: int) -> Recursion:
    """(x, numbers of one step) -> x after it."""
    x, numbers = ca.SX.sym("x", model.size), two_samples(model)
    after = motion(model, count)(x, *numbers)[0]
    return Recursion(ca.Function("follow", [x, *numbers], [after], {"cse": True}))


@lru_cache(maxsize=8)
def _outputs(model: Dynamics) -> AtSamples:
    t = model.traced
    signals = [flat(t.symbols[s.name]) for s in model.signals]
    (C,), as_was = at_estimates(model, [t.C])
    return AtSamples(ca.vertcat(t.x, *signals, *as_was), [C, t.h - C @ t.x, t.reading])


def extended(model: Dynamics, run: Run) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Extended Kalman filter: x, P after each reading and before it, innovations, their S."""
    n, m, (parts, present) = model.size, model.traced.h.numel(), given(model, run)
    state = beginning(model)
    steps = extended_step(model, pieces(model, run))
    _, after, before, said = steps(state, parts, keep=False)
    return *unpacked(after, n), *unpacked(before, n), *told(said, present, m)


def beginning(model: Dynamics) -> Array:
    """What is known before the first sample: x and the factors of P."""
    root = np.zeros(model.size * (model.size - 1) // 2)
    return np.concatenate([model.start, np.diag(model.start_covariance), root])


def told(said: Array, present: NDArray[np.bool_], m: int) -> tuple[Array, Array]:
    """Innovations and their S, NaN where a reading is missing."""
    S = said[:, m:].reshape(-1, m, m).transpose(0, 2, 1)
    S = np.where(present[:, :, None] & present[:, None, :], S, np.nan)
    return np.where(present, said[:, :m], np.nan), S


def given(
    model: Dynamics, run: Run, pace: Pace | None = None
) -> tuple[list[Array], NDArray[np.bool_]]:
    """What every step of the extended filter is given, (N, …) each; which readings there are.

    `pace`: how the whole record is read where this is a part of it.
    """
    time, calm = checked_record(model, run), estimates(model, run)
    u, step, pace = _inputs(model, run, calm), np.diff(time), pace or Pace.of(model, run)
    n, m = model.size, model.traced.h.numel()
    signals = [*(run.signals[s.name] for s in model.signals), *calm.values()]
    at = np.concatenate(signals, axis=1)
    y = _rows(model, signals, np.broadcast_to(model.start, (len(time), n)))[2][:, :m]
    present = np.isfinite(y)
    parts = [
        np.concatenate([u[:1], u[:-1]]),
        np.concatenate([u[:1], _at_ends(model, u)]),
        np.concatenate([[0.0], step])[:, None],
        np.concatenate([[[1.0]], _stood_for(step, pace)]),
        np.concatenate([np.zeros((1, n)), lost(model, step, pace)]),
        np.nan_to_num(at),
        variances(model, step, pace),
        np.nan_to_num(y),
        present.astype(float),
    ]
    return parts, present


@lru_cache(maxsize=8)
def extended_step(model: Dynamics, count: int) -> Recursion:
    """(x and factors of P, numbers of one sample) -> (the same; x and P; and before the reading;
    innovation and S)."""
    t, n = model.traced, model.size
    u, v, h, share = two_samples(model)
    both, gap = ca.SX.sym("both", factors.size(n)), ca.SX.sym("gap", n)
    signals = ca.SX.sym("signals", _extended_outputs(model).numel_in(1))
    R, y, there = (ca.SX.sym(name, t.h.numel()) for name in ("R", "y", "there"))
    moved = extended_move(model, count)(both, u, v, h, share, gap)
    before_x, before = factors.unpacked(moved, n)
    before_P = factors.multiplied(before)
    found = extended_read(model)(moved, signals, R, y, there)
    after_x, after = factors.unpacked(found, n)
    said, C = _extended_outputs(model)(before_x, signals)
    told = ca.vertcat(t.wrapped(y - said), ca.vec(ca.densify(C @ before_P @ C.T + ca.diag(R))))
    numbers = [u, v, h, share, gap, signals, R, y, there]
    outputs = [
        found,
        packed(after_x, factors.multiplied(after)),
        packed(before_x, before_P),
        told,
    ]
    return Recursion(ca.Function("step", [both, *numbers], outputs, {"cse": True}))


@lru_cache(maxsize=8)
def extended_move(model: Dynamics, count: int) -> Any:
    """(x and factors of P, inputs at both ends, h, share, variances of a gap) -> (the same)."""
    n, (u, v, h, share) = model.size, two_samples(model)
    both, gap = ca.SX.sym("both", factors.size(n)), ca.SX.sym("gap", n)
    x, P = factors.unpacked(both, n)
    end, Phi, Q = motion(model, count)(x, u, v, h, share)
    Q += h * share * _acting(model, x, u, factors.multiplied(P))
    lost = ca.diag(gap)
    before = factors.moved(P, Phi, factors.factored(Phi @ lost @ Phi.T + Q + lost))
    return ca.Function("move", [both, u, v, h, share, gap], [factors.packed(end, before)])


@lru_cache(maxsize=8)
def extended_read(model: Dynamics) -> Any:
    """(x and factors of P, signals, R, y, which readings there are) -> (x and factors of P)."""
    t, n, predict = model.traced, model.size, _extended_outputs(model)
    both, signals = ca.SX.sym("both", factors.size(n)), ca.SX.sym("signals", predict.numel_in(1))
    R, y, there = (ca.SX.sym(name, t.h.numel()) for name in ("R", "y", "there"))
    x, P = factors.unpacked(both, n)
    reading = _Reading(lambda at: predict(at, signals), t.wrapped, y, R, there)
    rounds = ITERATIONS if ca.depends_on(t.C, t.x) else 1
    found = factors.packed(*reading.taken(x, P, rounds))
    return ca.Function("read", [both, signals, R, y, there], [found])


@lru_cache(maxsize=8)
def _extended_outputs(model: Dynamics) -> Any:
    """(x, signals and after them the uncertain ones as estimated) -> (h, C)."""
    t = model.traced
    (of_h,), as_was = at_estimates(model, [t.C])
    signals = ca.vertcat(*[flat(t.symbols[s.name]) for s in model.signals], *as_was)
    return ca.Function("predict", [t.x, signals], [t.h, of_h])


@dataclass(frozen=True)
class _Reading:
    """Readings y with variances R, as far as they are there; `predict(x)` says h(x) and C(x), and
    `wrapped` what of a difference is no full turn."""

    predict: Callable[[Any], tuple[Any, Any]]
    wrapped: Callable[[Any], Any]
    y: Any
    R: Any
    there: Any

    def taken(self, x: Any, P: Factors, rounds: int) -> tuple[Any, Factors]:
        """State and factors of its covariance after them, linearised where they lead to,
        round after round.

        Gauss-Newton on what the prediction and the readings say together (Bell & Cathey 1993); of
        all rounds the most probable state.
        """
        found, after, least = self._once(x, P, x)
        best = factors.packed(found, after)
        for _ in range(rounds - 1):
            found, after, cost = self._once(x, P, found)
            best = ca.if_else(cost < least, factors.packed(found, after), best)
            least = ca.if_else(cost < least, cost, least)
        return factors.unpacked(best, x.numel())

    def _once(self, x: Any, P: Factors, along: Any) -> tuple[Any, Factors, Any]:
        """The same linearised at `along`, and twice the negative log-density of the state."""
        said, C = self.predict(along)
        difference = self.wrapped(self.y - said)
        found, after, explained = x, P, ca.SX(0)
        for i in range(self.y.numel()):
            c = C[i, :].T * self.there[i]
            left = difference[i] * self.there[i] - ca.dot(c, found - along)
            after, gain, s = factors.read_with(after, c, self.R[i])
            found = found + gain * left
            explained += left**2 / s
        linear = difference - C @ (found - along)
        there = self.there / self.R
        bent = self.wrapped(self.y - self.predict(found)[0]) ** 2 - linear**2
        return found, after, explained + ca.dot(there, bent)


@lru_cache(maxsize=8)
def motion(model: Dynamics, count: int) -> Any:
    """(x, inputs at both ends, h, share of the usual step) -> (x after it, Φ, Q), as a function of
    symbols, in `count` pieces.

    Inputs as they were read, then the uncertain ones as estimated: Φ is taken at these,
    and noise moves along the inputs as they were read.
    """
    t, n = model.traced, model.size
    x, (u, v, h, share) = ca.SX.sym("x", n), two_samples(model)
    own = ca.vertcat(*[flat(t.symbols[name]) for name in input_names(model)])
    rate = ca.Function("rate", [t.x, own], [t.f])
    noise = ca.SX(ca.DM(model.process))
    noise = noise if model.input_noise is None else noise + share * model.input_noise
    slope, driven = (ca.Function("of", [t.x, own, share], [e]) for e in (t.A, noise))
    read, estimated = both_of(model)
    a, b = (ca.SX.sym(name, own.numel()) for name in "ab")
    piece = ca.Function("piece", [x, a, b, h], _with_jacobian(_runge_kutta(rate, x, a, b, h), x))
    end, Phi, Q, h_piece = x, ca.SX.eye(n), ca.SX(n, n), h / count
    for k in range(count):
        ends = [u + part / count * (v - u) for part in (k, k + 1)]
        calm, ends = ([both[where] for both in ends] for where in (estimated, read))
        Phi = piece(end, *calm, h_piece)[1] @ Phi
        before, (end, later) = end, piece(end, *ends, h_piece)
        A0, A1 = slope(before, ends[0], share), slope(end, ends[1], share)
        path = _path(before, end, rate(before, ends[0]), rate(end, ends[1]), h_piece)

        def intensity(tau: float, ends: Any = ends, path: Any = path, share: SX = share) -> Any:
            return driven(path(tau), ends[1] - tau * (ends[1] - ends[0]), share)

        Q = later @ Q @ later.T + noise_of(A1, A1 - A0, intensity, h_piece)
    return ca.Function("motion", [x, u, v, h, share], [end, Phi, Q], {"cse": True})


def pieces(model: Dynamics, run: Run, pace: Pace | None = None) -> int:
    """Into how many pieces a usual step is cut: as many as the motion at the start asks for.

    Raises DataError where that is more than can be followed.
    """
    time = checked_time(run)
    h, largest = (pace or Pace.of(model, run)).usual, np.zeros((model.size, model.size))
    for k in range(0, len(time) - 1, _BLOCK):
        own = run.take(slice(k, k + _BLOCK + 1))
        A = linearised(model, own, calm=as_read(model, own)).A
        largest = np.maximum(largest, np.abs(A).max(axis=0))
    fast = h * balance(largest)[1]
    count = int(
        2 ** np.clip(np.ceil(np.log2(max(fast, 1e-300) / PIECE)), np.log2(FEWEST), np.log2(MOST))
    )
    if not fast / count < UNSTABLE:
        raise DataError(
            f"{run.file or run.name}: {model.name} moves {fast:.3g} times faster than a step of "
            f"{h:.3g} s, more than a nonlinear model is followed ({UNSTABLE * MOST:g} times): "
            "sample faster, or leave its fast state out"
        )
    return count


def _path(x: SX, later: SX, rate: SX, later_rate: SX, h: SX) -> Callable[[float], SX]:
    """The state at τ, from the end back: the cubic through both ends with their rates."""

    def at(tau: float) -> SX:
        near = (1 - tau) ** 2 * ((1 + 2 * tau) * later - tau * h * later_rate)
        return near + tau**2 * ((3 - 2 * tau) * x + (1 - tau) * h * rate)

    return at


def _acting(model: Dynamics, x: SX, u: SX, P: SX) -> Any:
    """What noise of uncertain inputs adds to Ξ by acting on errors with covariance P."""
    t, n = model.traced, model.size
    own = ca.vertcat(*[flat(t.symbols[name]) for name in input_names(model)])
    found = ca.SX(n, n)
    for name, slope in slopes(model):
        N = ca.Function("slope", [t.x, own], [slope])(x, u[both_of(model)[0]])
        found += model.sensors[name] * (N @ P @ N.T)
    return found


def _with_jacobian(expression: SX, x: SX) -> list[SX]:
    return [expression, ca.jacobian(expression, x)]


def _runge_kutta(rate: Any, x: SX, u: SX, v: SX, h: SX) -> SX:
    middle = 0.5 * (u + v)
    a = rate(x, u)
    b = rate(x + 0.5 * h * a, middle)
    c = rate(x + 0.5 * h * b, middle)
    d = rate(x + h * c, v)
    return x + h / 6 * (a + 2 * b + 2 * c + d)


def input_names(model: Dynamics) -> list[str]:
    """Signals that drive the rates."""
    t = model.traced
    return [s.name for s in model.signals if ca.depends_on(t.f, flat(t.symbols[s.name]))]


def _stood_for(steps: Array, pace: Pace | None = None) -> Array:
    """What part of the usual step the readings at both ends of each stand for, (N − 1, 1)."""
    own = shares(steps, pace)
    return 0.5 * (own[1:] + own[:-1])[:, None]


def _inputs(model: Dynamics, run: Run, calm: Mapping[str, Array] | None = None) -> Array:
    """Inputs of the rates as they were read, and after them the uncertain ones as estimated."""
    calm = estimates(model, run) if calm is None else calm
    parts = [run.signals[n] for n in input_names(model)]
    parts += [calm[n] for n in input_names(model) if n in calm]
    return np.concatenate([np.zeros((len(run), 0)), *parts], axis=1)


def _at_ends(model: Dynamics, u: Array) -> Array:
    """`_inputs` u (N, k) at the end of every step, (N − 1, k): what is held has not changed yet."""
    names, noisy = input_names(model), uncertain(model)
    signals = {s.name: s for s in model.signals}
    held = [signals[n].held for n in (*names, *(n for n in names if n in noisy))
            for _ in range(signals[n].size)]  # fmt: skip
    return np.where(held, u[:-1], u[1:]) if any(held) else u[1:]


def both_of(model: Dynamics) -> tuple[list[int], list[int]]:
    """Where the inputs as they were read are in `_inputs`, and those to be linearised at."""
    noisy, names = uncertain(model), input_names(model)
    sizes = [int(model.traced.symbols[name].numel()) for name in names]
    read = list(range(sum(sizes)))
    estimated, later = list[int](), len(read)
    for name, size in zip(names, sizes, strict=True):
        if name in noisy:
            estimated += range(later, later + size)
            later += size
        else:
            estimated += range(len(estimated), len(estimated) + size)
    return read, estimated


def shifted(model: Dynamics) -> list[int]:
    """Where in `_inputs` the uncertain ones are, as they were read."""
    noisy, names = uncertain(model), input_names(model)
    every = [name for name in names for _ in range(model.traced.symbols[name].numel())]
    return [k for k, name in enumerate(every) if name in noisy]


def at_noise(model: Dynamics, u: SX, v: SX, w: SX) -> tuple[SX, SX]:
    """Inputs at both ends of a step, the uncertain ones `w` more than they were read."""
    more = ca.SX(u.numel(), 1)
    more[shifted(model)] = w
    return u + more, v + more


def two_samples(model: Dynamics) -> tuple[SX, SX, SX, SX]:
    """Inputs at both ends of a step, its length, and what share of the usual one they stand for."""
    size = len({i for part in both_of(model) for i in part})
    return ca.SX.sym("u", size), ca.SX.sym("v", size), ca.SX.sym("h"), ca.SX.sym("share")
