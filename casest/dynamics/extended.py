"""Nonlinear models step by step: the motion between two samples, and the extended Kalman filter.

Between samples the state follows two fourth-order Runge-Kutta steps, inputs being straight lines;
Φ is the Jacobian of that very map, so that filter, smoother and least squares speak of one problem.
Readings are linearised at the prediction and again where they lead to (Jazwinski 1970, 8.3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import Steps
from casest.dynamics.inputs import at_estimates, estimates, on_errors, slopes, uncertain
from casest.dynamics.stepping import entries, packed, run_steps, symmetric, taken, unpacked
from casest.dynamics.transition import checked_record, lost, steps_to, with_lost
from casest.engine import Columns, Recursion, Replay

#: Rounds of the filter's update where a reading is no linear function of the state.
ITERATIONS = 4


def relinearised(model: Dynamics, run: Run, along: Array, errors: Array | None = None) -> Steps:
    """The record in discrete time, linearised along states (N, n).

    `errors` (N, n, n): covariances of what these are wrong by, on which noise of inputs acts.
    """
    time = checked_record(model, run)
    inputs = _inputs(model, run)
    columns = [np.ascontiguousarray(along[:-1]), inputs[:-1], inputs[1:], np.diff(time)[:, None]]
    Phi, forced, Q = over_samples(_step(model), columns)
    if errors is not None and uncertain(model):
        acting = on_errors(model, run, along, errors)
        Q += 0.5 * np.diff(time)[:, None, None] * (acting[1:] + acting[:-1])
    Q = with_lost(model, np.diff(time), Phi, Q)
    C, d, y = _rows(model, run, along)
    R = np.diag(model.noise)[None] / steps_to(np.diff(time))[:, None]
    return Steps(Phi, forced[:, :, 0], Q, C, d, R, y, of_C=entries(model.traced.C))


def _rows(model: Dynamics, run: Run, along: Array) -> tuple[Array, Array, Array]:
    """Readings as rows: C, d and y."""
    columns = [np.ascontiguousarray(along), *(run.signals[s.name] for s in model.signals)]
    columns += estimates(model, run).values()
    C, d, y = (part[:, :, 0] if k else part
               for k, part in enumerate(over_samples(_outputs(model), columns)))  # fmt: skip
    return C, d, model.traced.nearest(y, C, d, along)


@lru_cache(maxsize=8)
def _step(model: Dynamics) -> Replay:
    x, u, v, h = model.traced.x, *_two_samples(model), ca.SX.sym("h")
    end, Phi, Q = _motion(model)(x, u, v, h)
    return replay(ca.vertcat(x, u, v, h), [Phi, end - Phi @ x, Q])


@lru_cache(maxsize=8)
def _outputs(model: Dynamics) -> Replay:
    t = model.traced
    signals = [flat(t.symbols[s.name]) for s in model.signals]
    (C,), as_was = at_estimates(model, [t.C])
    return replay(ca.vertcat(t.x, *signals, *as_was), [C, t.h - C @ t.x, t.reading])


def replay(sample: SX, outputs: list[SX]) -> Replay:
    """Expressions of one sample, to be evaluated over many."""
    none = ca.SX.sym("none", 0)
    names = ["parameters", "sample"], [f"o{k}" for k in range(len(outputs))]
    dense = [ca.densify(e) for e in outputs]
    return Replay(ca.Function("replayed", [none, sample], dense, *names))


def over_samples(expressions: Replay, columns: list[Array]) -> list[Array]:
    """Each expression at every sample, (N, …)."""
    return list(expressions(np.zeros(0), Columns(columns)))


def extended(model: Dynamics, run: Run) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Extended Kalman filter: x, P after each reading and before it, innovations, their S."""
    time = checked_record(model, run)
    t, u = model.traced, _inputs(model, run)
    n, m = model.size, t.h.numel()
    step = np.diff(time)
    at = [*(run.signals[s.name] for s in model.signals), *estimates(model, run).values()]
    y = _rows(model, run, np.broadcast_to(model.start, (len(time), n)))[2][:, :m]
    present = np.isfinite(y)
    parts = [
        np.concatenate([u[:1], u[:-1]]),
        u,
        np.concatenate([[0.0], step])[:, None],
        np.concatenate([np.zeros((1, n)), lost(model, step)]),
        np.nan_to_num(np.concatenate(at, axis=1)),
        np.diag(model.noise)[None] / steps_to(step)[:, None],
        np.nan_to_num(y),
        present.astype(float),
    ]
    state = np.concatenate([model.start, model.start_covariance.T.ravel()])
    after, before, told = run_steps(_extended_step(model), state, parts)
    ours = np.where(present, told[:, :m], np.nan)
    S = told[:, m:].reshape(-1, m, m).transpose(0, 2, 1)
    S = np.where(present[:, :, None] & present[:, None, :], S, np.nan)
    return *unpacked(after, n), *unpacked(before, n), ours, S


@lru_cache(maxsize=8)
def _extended_step(model: Dynamics) -> Recursion:
    """(x and P, numbers of one sample) -> (x and P, also before the reading, innovation and S)."""
    t, n = model.traced, model.size
    u, v, h = *_two_samples(model), ca.SX.sym("h")
    x, P = ca.SX.sym("x", n), ca.SX.sym("P", n, n)
    end, Phi, Q = _motion(model)(x, u, v, h)
    gap = ca.SX.sym("gap", n)
    Q += h * _acting(model, x, u, P)
    before_x, before_P = end, symmetric(Phi @ (P + ca.diag(gap)) @ Phi.T + Q + ca.diag(gap))
    (of_h,), as_was = at_estimates(model, [t.C])
    signals = ca.vertcat(*[flat(t.symbols[s.name]) for s in model.signals], *as_was)
    R, y, there = (ca.SX.sym(name, t.h.numel()) for name in ("R", "y", "there"))
    predict = ca.Function("predict", [t.x, signals], [t.h, of_h])
    said, C = predict(before_x, signals)
    reading = _Reading(lambda at: predict(at, signals), t.wrapped, y, R, there)
    rounds = ITERATIONS if ca.depends_on(t.C, t.x) else 1
    after_x, after_P = reading.taken(before_x, before_P, rounds)
    numbers = ca.vertcat(u, v, h, gap, signals, R, y, there)
    told = ca.vertcat(t.wrapped(y - said), ca.vec(ca.densify(C @ before_P @ C.T + ca.diag(R))))
    outputs = [packed(after_x, after_P), packed(before_x, before_P), told]
    return Recursion(ca.Function("step", [packed(x, P), numbers], outputs, {"cse": True}))


@dataclass(frozen=True)
class _Reading:
    """Readings y with variances R, as far as they are there; `predict(x)` says h(x) and C(x), and
    `wrapped` what of a difference is no full turn."""

    predict: Callable[[Any], tuple[Any, Any]]
    wrapped: Callable[[Any], Any]
    y: Any
    R: Any
    there: Any

    def taken(self, x: Any, P: Any, rounds: int) -> tuple[Any, Any]:
        """State and covariance after them, linearised where they lead to, round after round.

        Gauss-Newton on what the prediction and the readings say together (Bell & Cathey 1993); of
        all rounds the most probable state.
        """
        best = found, after_P, cost = self._once(x, P, x)
        for _ in range(rounds - 1):
            found, after_P, cost = self._once(x, P, found)
            better = cost < best[2]
            best = tuple(
                ca.if_else(better, a, b) for a, b in zip((found, after_P, cost), best, strict=True)
            )
        return best[0], best[1]

    def _once(self, x: Any, P: Any, along: Any) -> tuple[Any, Any, Any]:
        """The same linearised at `along`, and twice the negative log-density of the state."""
        said, C = self.predict(along)
        difference = self.wrapped(self.y - said)
        found, after, explained = x, P, ca.SX(0)
        for i in range(self.y.numel()):
            c = C[i, :].T * self.there[i]
            left = difference[i] * self.there[i] - ca.dot(c, found - along)
            s = ca.dot(c, after @ c) + self.R[i]
            found, after = taken(found, after, c, left, s)
            explained += left**2 / s
        linear = difference - C @ (found - along)
        there = self.there / self.R
        bent = self.wrapped(self.y - self.predict(found)[0]) ** 2 - linear**2
        return found, after, explained + ca.dot(there, bent)


@lru_cache(maxsize=8)
def _motion(model: Dynamics) -> Any:
    """(x, inputs at both ends, h) -> (x after it, Φ, Q), as a function of symbols.

    Inputs as they were read, then the uncertain ones as estimated: Φ is taken at these.
    """
    t, inputs = model.traced, _input_names(model)
    x, h = ca.SX.sym("x", model.size), ca.SX.sym("h")
    u, v = _two_samples(model)
    own = ca.vertcat(*[flat(t.symbols[n]) for n in inputs])
    read, estimated = _both_of(model)
    rate = ca.Function("rate", [t.x, own], [t.f])
    noise = ca.SX(ca.DM(model.process))
    noise = noise if model.input_noise is None else noise + model.input_noise
    intensity = ca.Function("intensity", [t.x, own], [noise])
    a, b = (ca.SX.sym(name, own.numel()) for name in "ab")
    half = ca.Function("half", [x, a, b, h], _with_jacobian(_runge_kutta(rate, x, a, b, h), x))
    between = 0.5 * (u + v)
    middle, first = half(x, u[read], between[read], 0.5 * h)
    end, second = half(middle, between[read], v[read], 0.5 * h)
    Phi = second @ first
    ends = Phi @ intensity(x, u[read]) @ Phi.T + intensity(end, v[read])
    inner = second @ intensity(middle, between[read]) @ second.T
    Q = h / 6 * (ends + 4 * inner)
    if read != estimated:
        first = half(x, u[estimated], between[estimated], 0.5 * h)[1]
        Phi = half(middle, between[estimated], v[estimated], 0.5 * h)[1] @ first
    return ca.Function("motion", [x, u, v, h], [end, Phi, Q], {"cse": True})


def _acting(model: Dynamics, x: SX, u: SX, P: SX) -> Any:
    """What noise of uncertain inputs adds to Ξ by acting on errors with covariance P."""
    t, n = model.traced, model.size
    own = ca.vertcat(*[flat(t.symbols[name]) for name in _input_names(model)])
    found = ca.SX(n, n)
    for name, slope in slopes(model):
        N = ca.Function("slope", [t.x, own], [slope])(x, u[_both_of(model)[0]])
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


def _input_names(model: Dynamics) -> list[str]:
    """Signals that drive the rates."""
    t = model.traced
    return [s.name for s in model.signals if ca.depends_on(t.f, flat(t.symbols[s.name]))]


def _inputs(model: Dynamics, run: Run) -> Array:
    """Inputs of the rates as they were read, and after them the uncertain ones as estimated."""
    calm = estimates(model, run)
    parts = [run.signals[n] for n in _input_names(model)]
    parts += [calm[n] for n in _input_names(model) if n in calm]
    return np.concatenate([np.zeros((len(run), 0)), *parts], axis=1)


def _both_of(model: Dynamics) -> tuple[list[int], list[int]]:
    """Where the inputs as they were read are in `_inputs`, and those to be linearised at."""
    noisy, names = uncertain(model), _input_names(model)
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


def _two_samples(model: Dynamics) -> tuple[SX, SX]:
    size = len({i for part in _both_of(model) for i in part})
    return ca.SX.sym("u", size), ca.SX.sym("v", size)
