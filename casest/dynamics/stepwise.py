"""One step of the online filter as two functions of fixed size: the motion, and the readings.

What `Estimator.step` computes, without anything of a whole record, so that it can run on a device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.data.timing import GAP
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics import factors
from casest.dynamics.between import balance, expressions
from casest.dynamics.declare import Dynamics
from casest.dynamics.extended import (
    FEWEST,
    extended_move,
    extended_read,
    input_names,
    pieces,
)
from casest.dynamics.inputs import as_read, uncertain
from casest.dynamics.stepping import packed
from casest.dynamics.transition import Pace, linearised, lost, variances
from casest.errors import UsageError

#: Terms of the series over one part of a step of a linear model, and ‖A‖h that they follow.
_TERMS, _SLOW = 12, 0.25
#: Parts at most into which a step is cut.
PARTS = 4096


@dataclass(frozen=True)
class Stepwise:
    """The filter of a model that is read every `period` s as a rule; a step beyond `gap` is one.

    All functions are of one vector, in this order: state (S,), signals at the sample before and at
    this one (W,) each, and the step's length h in s;
    move: those, then variances (n,) that are added before it and after it, and the part of the step
    that it is, from a to b of 0 to 1 -> the state after it;
    fast: signals before and now, and h -> ‖A‖h of the step, of a linear model alone: above `slow`
    it is to be cut into parts. `leads`: noise of inputs acts along the states of a filter of its
    own, which takes it at the start; x (n,) of that before and after the step then stand last;
    read: state, signals at this sample, readings (m,), 1 or 0 where each is there or not -> state;
    told: state -> x (n,) and P (n, n). `begin` (S,): what is known at first; `forgotten` (n,): what
    is added before and after a gap; `readings` (m,): where in the signals each reading is;
    `needed` (W,): which signals have to be there.
    """

    model: Dynamics
    period: float
    gap: float
    move: Any
    read: Any
    told: Any
    fast: Any | None
    slow: float
    begin: Array
    forgotten: Array
    readings: Sequence[int]
    needed: Sequence[bool]
    leads: bool


@lru_cache(maxsize=8)
def stepwise(model: Dynamics, period: float) -> Stepwise:
    """Raises UsageError where the period is none. What the model knows exactly is left out."""
    checked_period(model, period)
    n, pace = model.size, Pace(period, GAP * period)
    both = ca.SX.sym("both", factors.size(n))
    x, P = factors.unpacked(both, n)
    told = ca.Function("told", [both], [packed(x, factors.multiplied(P))])
    root = np.zeros(n * (n - 1) // 2)
    begin = np.concatenate([model.start, np.diag(model.start_covariance), root])
    step = np.array([2 * pace.gap])
    R = variances(model, step, pace)[0]
    move, fast, slow, leads = _linear(model, pace) if model.linear else _extended(model, pace)
    return Stepwise(
        model, period, pace.gap, move, _read(model, R), told, fast, slow, begin,
        lost(model, step, pace)[0], _readings(model), _needed(model), leads,
    )  # fmt: skip


def checked_period(model: Dynamics, period: float) -> float:
    """The usual time between two samples, s; UsageError where that is none."""
    if not 0 < period < np.inf:
        raise UsageError(f"{model.name}: the period {period:g} s must be positive and finite")
    return float(period)


def _samples(model: Dynamics) -> tuple[Any, Any, dict[str, Any], dict[str, Any]]:
    """All signals at the sample before and at this one; by name, held ones as they were before."""
    width = sum(s.size for s in model.signals)
    before, now = ca.SX.sym("before", width), ca.SX.sym("now", width)
    starts, ends, place = dict[str, Any](), dict[str, Any](), 0
    for s in model.signals:
        where = slice(place, place + s.size)
        starts[s.name] = before[where]
        ends[s.name] = before[where] if s.held else now[where]
        place += s.size
    return before, now, starts, ends


def _share(h: Any, pace: Pace) -> Any:
    """What part of the usual step a reading stands for; after a gap, or at first, a whole one."""
    return ca.if_else(h > pace.gap, 1, ca.if_else(h > 0, h / pace.usual, 1))


def _extended(model: Dynamics, pace: Pace) -> tuple[Any, None, float, bool]:
    n, h = model.size, ca.SX.sym("h")
    both, gap = ca.SX.sym("both", factors.size(n)), ca.SX.sym("gap", 2 * n)
    before, now, starts, ends = _samples(model)
    names, noisy = input_names(model), uncertain(model)
    names = [*names, *(name for name in names if name in noisy)]
    u, v = (ca.vertcat(ca.SX(0, 1), *[part[name] for name in names]) for part in (starts, ends))
    # A step is moved in one part: what is lost in a gap is the same before and after.
    found = extended_move(model, _count(model, pace))(both, u, v, h, _share(h, pace), gap[:n])
    ab = ca.SX.sym("ab", 2)
    return _function("move", [both, before, now, h, gap, ab], found), None, np.inf, False


def _count(model: Dynamics, pace: Pace) -> int:
    """In how many pieces a usual step is followed, by the motion at the start without inputs; as
    few as any where the model has no value there."""
    time = np.array([0.0, pace.usual])
    signals = {s.name: np.tile(_nothing(s.kind, s.size), (2, 1)) for s in model.signals}
    run = Run.raw("start", signals, units={}, time=time)
    still = np.isfinite(linearised(model, run, calm=as_read(model, run)).A).all()
    return pieces(model, run, pace) if still else FEWEST


def _nothing(kind: str, size: int) -> Array:
    return np.eye(3).ravel() if kind == "rotation" else np.zeros(size)


def _linear(model: Dynamics, pace: Pace) -> tuple[Any, Any, float, bool]:
    t, n, h = model.traced, model.size, ca.SX.sym("h")
    S = factors.size(n)
    signals = [flat(t.symbols[s.name]) for s in model.signals]
    start, noise = ca.DM(model.start), model.input_noise
    of = ca.Function("of", [t.x, ca.vertcat(*signals)], [t.A, t.f - t.A @ start])
    added = None if noise is None else ca.Function("noise", [t.x, ca.vertcat(*signals)], [noise])
    leads = noise is not None and ca.depends_on(noise, t.x)
    before, now, starts, ends = _samples(model)
    both, gap, ab = ca.SX.sym("both", S), ca.SX.sym("gap", 2 * n), ca.SX.sym("ab", 2)
    u, v = (ca.vertcat(*part.values()) for part in (starts, ends))
    (A0, c0), (A1, c1) = of(start, u), of(start, v)
    along = ca.SX.sym("along", 2 * n) if leads else ca.vertcat(start, start)
    share, Xi = _share(h, pace), ca.SX(ca.DM(model.process))
    # The noise of inputs acts along them as they are read, also where these are held.
    X0, X1 = (Xi if added is None else Xi + share * added(x, s)
              for x, s in ((along[:n], before), (along[n:], now)))  # fmt: skip
    a, b = ab[0], ab[1]

    def at(tau: Any) -> tuple[Any, list[Any]]:
        place = b - tau * (b - a)
        return c0 + place * (c1 - c0), [X0 + place * (X1 - X0)]

    x, P = factors.unpacked(both, n)
    here, later = (A0 + place * (A1 - A0) for place in (a, b))
    Phi, forced, (Q,) = expressions(later, later - here, at, (b - a) * h, _TERMS)
    Q += Phi @ ca.diag(gap[:n]) @ Phi.T + ca.diag(gap[n:])
    moved = factors.packed(Phi @ x + forced, factors.moved(P, Phi, factors.factored(Q)))
    arguments = [both, before, now, h, gap, ab, *([along] if leads else [])]
    return _function("move", arguments, moved), _fast(A0, A1, before, now, h), _SLOW, leads


def _fast(A0: Any, A1: Any, before: Any, now: Any, h: Any) -> Any:
    """‖A‖h in units in which it is small where no input acts."""
    still = ca.Function("A", [before, now], [A0])
    size = np.abs(np.asarray(still(0, 0), float))
    units = balance(np.where(np.isfinite(size), size, 0.0))[0]
    D = ca.diag(ca.DM(units))
    rows = [ca.sum2(ca.fabs(ca.inv(D) @ A @ D)) for A in (A0, A1)]
    largest = ca.mmax(ca.vertcat(*rows))
    return _function("fast", [before, now, h], largest * h)


def _read(model: Dynamics, R: Array) -> Any:
    t, n = model.traced, model.size
    both = ca.SX.sym("both", factors.size(n))
    m, width = t.h.numel(), sum(s.size for s in model.signals)
    now, y, there = ca.SX.sym("now", width), ca.SX.sym("y", m), ca.SX.sym("there", m)
    calm, place = [], 0
    for s in model.signals:
        if s.name in uncertain(model):
            calm.append(now[place : place + s.size])
        place += s.size
    if model.linear:
        of = ca.Function("of", [t.x, ca.vertcat(*[flat(t.symbols[s.name]) for s in model.signals])],
                         [t.C, t.h - t.C @ t.x])  # fmt: skip
        C, d = of(ca.DM(model.start), now)
        x, P = factors.unpacked(both, n)
        for i in range(m):
            c = C[i, :].T * there[i]
            left = (y[i] - d[i]) * there[i] - ca.dot(c, x)
            P, gain = factors.read(P, c, ca.DM(R)[i])
            x = x + gain * left
        found = factors.packed(x, P)
    else:
        found = extended_read(model)(both, ca.vertcat(now, *calm), ca.DM(R), y, there)
    return _function("read", [both, now, y, there], found)


def _function(name: str, arguments: Sequence[Any], found: Any) -> Any:
    """A function of one vector."""
    return ca.Function(name, [ca.vertcat(*arguments)], [ca.densify(found)], {"cse": True})


def _readings(model: Dynamics) -> list[int]:
    """Where in the signals, one after the other, each number of the readings is."""
    first, place = dict[str, int](), 0
    for s in model.signals:
        first[s.name], place = place, place + s.size
    sizes = {s.name: s.size for s in model.signals}
    return [first[name] + k for name in model.measured_signals for k in range(sizes[name])]


def _needed(model: Dynamics) -> list[bool]:
    return [s.name not in model.may_be_missing for s in model.signals for _ in range(s.size)]
