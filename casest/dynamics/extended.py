"""Nonlinear models step by step: the motion between two samples, and the extended Kalman filter.

Between samples the state follows two fourth-order Runge-Kutta steps, more where the motion is fast,
inputs being straight lines; Φ is the Jacobian of that very map, so that filter, smoother and least
squares speak of one problem.
Readings are linearised at the prediction (Jazwinski 1970, 8.3).
"""

from __future__ import annotations

from collections.abc import Callable
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
from casest.dynamics.stepping import entries, packed, run_steps, unpacked
from casest.dynamics.transition import (
    Pace,
    checked_record,
    checked_time,
    linearised,
    lost,
    pace_of,
    shares,
    variances,
    with_lost,
)
from casest.engine import Columns, Recursion, Replay
from casest.errors import DataError

#: ‖A‖h of a piece that Runge-Kutta follows well, pieces at most, and ‖A‖h that it cannot follow.
PIECE, MOST, UNSTABLE = 0.5, 16, 2.5


def relinearised(model: Dynamics, run: Run, along: Array) -> Steps:
    """The record in discrete time, linearised along states (N, n)."""
    time = checked_record(model, run)
    inputs = _input_names(model)
    columns = [
        np.ascontiguousarray(along[:-1]),
        *(run.signals[n][:-1] for n in inputs),
        *(run.signals[n][1:] for n in inputs),
        np.diff(time)[:, None],
        _stood_for(np.diff(time)),
    ]
    Phi, forced, Q = over_samples(_step(model, pieces(model, run)), columns)
    Q = with_lost(model, np.diff(time), Phi, Q)
    C, d, y = _rows(model, run, along)
    R = variances(model, np.diff(time))
    return Steps(Phi, forced[:, :, 0], Q, C, d, R, y, of_C=entries(model.traced.C))


def _rows(model: Dynamics, run: Run, along: Array) -> tuple[Array, Array, Array]:
    """Readings as rows: C, d and y."""
    columns = [np.ascontiguousarray(along), *(run.signals[s.name] for s in model.signals)]
    C, d, y = over_samples(_outputs(model), columns)
    return C, d[:, :, 0], y[:, :, 0]


@lru_cache(maxsize=8)
def _step(model: Dynamics, count: int) -> Replay:
    x, (u, v, h, share) = model.traced.x, _two_samples(model)
    end, Phi, Q = _motion(model, count)(x, u, v, h, share)
    return replay(ca.vertcat(x, u, v, h, share), [Phi, end - Phi @ x, Q])


@lru_cache(maxsize=8)
def _outputs(model: Dynamics) -> Replay:
    t = model.traced
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in model.signals])
    return replay(sample, [t.C, t.h - t.C @ t.x, t.reading])


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
    n, m, (parts, present) = model.size, model.traced.h.numel(), given(model, run)
    root = np.zeros(n * (n - 1) // 2)
    state = np.concatenate([model.start, np.diag(model.start_covariance), root])
    steps = extended_step(model, pieces(model, run))
    _, after, before, told = run_steps(steps, state, parts, keep=False)
    return *unpacked(after, n), *unpacked(before, n), *_told(told, present, m)


def _told(told: Array, present: NDArray[np.bool_], m: int) -> tuple[Array, Array]:
    """Innovations and their S, NaN where a reading is missing."""
    S = told[:, m:].reshape(-1, m, m).transpose(0, 2, 1)
    S = np.where(present[:, :, None] & present[:, None, :], S, np.nan)
    return np.where(present, told[:, :m], np.nan), S


def given(
    model: Dynamics, run: Run, pace: Pace | None = None
) -> tuple[list[Array], NDArray[np.bool_]]:
    """What every step of the extended filter is given, (N, …) each; which readings there are."""
    time = checked_record(model, run)
    inputs, step = _input_names(model), np.diff(time)
    n, m = model.size, model.traced.h.numel()
    u = np.concatenate([run.signals[name] for name in inputs] or [np.zeros((len(time), 0))], axis=1)
    at = np.concatenate([run.signals[s.name] for s in model.signals], axis=1)
    y = _rows(model, run, np.broadcast_to(model.start, (len(time), n)))[2][:, :m]
    present = np.isfinite(y)
    parts = [
        np.concatenate([u[:1], u[:-1]]),
        u,
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
    u, v, h, share = _two_samples(model)
    both = ca.SX.sym("both", factors.size(n))
    x, P = factors.unpacked(both, n)
    end, Phi, Q = _motion(model, count)(x, u, v, h, share)
    gap = ca.diag(ca.SX.sym("gap", n))
    before = factors.moved(P, Phi, factors.factored(Phi @ gap @ Phi.T + Q + gap))
    before_x, before_P = end, factors.multiplied(before)
    signals = ca.vertcat(*[flat(t.symbols[s.name]) for s in model.signals])
    R, y, there = (ca.SX.sym(name, t.h.numel()) for name in ("R", "y", "there"))
    predict = ca.Function("predict", [t.x, signals], [t.h, t.C])
    said, C = predict(before_x, signals)
    after_x, after = before_x, before
    for i in range(t.h.numel()):
        c = C[i, :].T * there[i]
        left = (y[i] - said[i]) * there[i] - ca.dot(c, after_x - before_x)
        after, gain = factors.read(after, c, R[i])
        after_x = after_x + gain * left
    numbers = ca.vertcat(u, v, h, share, ca.diag(gap), signals, R, y, there)
    told = ca.vertcat(y - said, ca.vec(ca.densify(C @ before_P @ C.T + ca.diag(R))))
    outputs = [
        factors.packed(after_x, after),
        packed(after_x, factors.multiplied(after)),
        packed(before_x, before_P),
        told,
    ]
    return Recursion(ca.Function("step", [both, numbers], outputs, {"cse": True}))


@lru_cache(maxsize=8)
def _motion(model: Dynamics, count: int) -> Any:
    """(x, inputs at both ends, h, share of the usual step) -> (x after it, Φ, Q), as a function of
    symbols, in `count` pieces."""
    t, n = model.traced, model.size
    x, (u, v, h, share) = ca.SX.sym("x", n), _two_samples(model)
    own = ca.vertcat(*[flat(t.symbols[name]) for name in _input_names(model)])
    rate = ca.Function("rate", [t.x, own], [t.f])
    noise = ca.SX(ca.DM(model.process))
    noise = noise if model.input_noise is None else noise + share * model.input_noise
    slope, driven = (ca.Function("of", [t.x, own, share], [e]) for e in (t.A, noise))
    piece = ca.Function("piece", [x, u, v, h], _with_jacobian(_runge_kutta(rate, x, u, v, h), x))
    end, Phi, Q, h_piece = x, ca.SX.eye(n), ca.SX(n, n), h / count
    for k in range(count):
        ends = [u + part / count * (v - u) for part in (k, k + 1)]
        before, (end, later) = end, piece(end, *ends, h_piece)
        A0, A1 = slope(before, ends[0], share), slope(end, ends[1], share)
        path = _path(before, end, rate(before, ends[0]), rate(end, ends[1]), h_piece)

        def intensity(tau: float, ends: Any = ends, path: Any = path, share: SX = share) -> Any:
            return driven(path(tau), ends[1] - tau * (ends[1] - ends[0]), share)

        Q = later @ Q @ later.T + noise_of(A1, A1 - A0, intensity, h_piece)
        Phi = later @ Phi
    return ca.Function("motion", [x, u, v, h, share], [end, Phi, Q], {"cse": True})


def pieces(model: Dynamics, run: Run, pace: Pace | None = None) -> int:
    """Into how many pieces a usual step is cut: as many as the motion at the start asks for.

    Raises DataError where that is more than can be followed.
    """
    A = linearised(model, run).A
    h = (pace or pace_of(np.diff(checked_time(run)))).usual
    fast = h * balance(np.abs(A).max(axis=0))[1]
    count = int(2 ** np.clip(np.ceil(np.log2(max(fast, 1e-300) / PIECE)), 1, np.log2(MOST)))
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


def _stood_for(steps: Array, pace: Pace | None = None) -> Array:
    """What part of the usual step the readings at both ends of each stand for, (N − 1, 1)."""
    own = shares(steps, pace)
    return 0.5 * (own[1:] + own[:-1])[:, None]


def _two_samples(model: Dynamics) -> tuple[SX, SX, SX, SX]:
    """Inputs at both ends of a step, its length, and what share of the usual one they stand for."""
    size = sum(int(model.traced.symbols[n].numel()) for n in _input_names(model))
    return ca.SX.sym("u", size), ca.SX.sym("v", size), ca.SX.sym("h"), ca.SX.sym("share")
