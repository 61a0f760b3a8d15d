"""A linear model's steps straight from the signals, as recursions take them.

What `transition` and `between` do in matrices, in one expression of both samples of a step: of Φ, Q
and C only what can differ from zero is ever written. Where a step asks for more (a gap, a fast
motion, noise that depends on states), there is none, and the matrices are made.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics import between
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import Packed
from casest.dynamics.inputs import uncertain
from casest.dynamics.samples import AtSamples
from casest.dynamics.stepping import Pattern, entries, own_factors, reach
from casest.dynamics.transition import Pace, lost, variances


def packed(model: Dynamics, run: Run, pace: Pace) -> Packed | None:
    """The steps of a checked record, read at this pace; None where they have to be made in full."""
    if not _plain(model):
        return None
    steps = np.diff(np.asarray(run.time, float))
    if lost(model, steps, pace).any():
        return None
    signals = [run.signals[s.name] for s in model.signals]
    order = between.order_of(_size(model, signals), steps)
    if order is None:
        return None
    found = _step(model, order)(
        [*(s[:-1] for s in signals), *(s[1:] for s in signals), steps[:, None]]
    )
    Phi, forced, noise, C, d, y, total = (part[:, :, 0] for part in found)
    if not np.isfinite(total).all():
        return None
    patterns = reach(model.traced.A), entries(model.traced.C)
    present, read = np.isfinite(y), y - d
    if not present.all():
        read = np.where(present, read, 0.0)
        C = np.where(present[:, [i for i, _ in patterns[1]]], C, 0.0)
    R = np.broadcast_to(variances(model, steps[:1], pace)[0], y.shape)
    return Packed(Phi, forced, noise, C, R, read, present, patterns)


@lru_cache(maxsize=8)
def _plain(model: Dynamics) -> bool:
    """Does noise depend on nothing but time, and can readings be taken as they are?"""
    t = model.traced
    along_states = uncertain(model) or model.input_noise is not None
    return model.linear and not along_states and not t.g.numel() and not t.turn.any()


def _size(model: Dynamics, signals: list[Array]) -> Array:
    """The largest size of every entry of A along a record, (n, n)."""
    found = np.zeros((model.size, model.size))
    pattern = entries(model.traced.A)
    if pattern:
        (values,) = _slopes(model)(signals)
        largest = np.maximum(values.max(axis=0), -values.min(axis=0))[:, 0]
        found[tuple(np.array(pattern).T)] = largest
    return found


def _picked(matrix: SX, pattern: Pattern) -> SX:
    return ca.densify(ca.vertcat(ca.SX(0, 1), *[matrix[i, j] for i, j in pattern]))


def _symbols(model: Dynamics, when: str = "") -> list[SX]:
    symbols = model.traced.symbols
    own = [flat(symbols[s.name]) for s in model.signals]
    return [ca.SX.sym(f"{when}{k}", e.numel()) for k, e in enumerate(own)] if when else own


@lru_cache(maxsize=8)
def _slopes(model: Dynamics) -> AtSamples:
    t = model.traced
    return AtSamples(ca.vertcat(*_symbols(model)), [_picked(t.A, entries(t.A))])


@lru_cache(maxsize=8)
def _step(model: Dynamics, order: int) -> AtSamples:
    """(signals at both samples, h) -> Φ, forced step, factors of Q; C, d and y of the second;
    the sum of all that the motion is."""
    t, h = model.traced, ca.SX.sym("h")
    own, first, last = _symbols(model), _symbols(model, "first"), _symbols(model, "last")
    ends = [f if s.held else e for s, f, e in zip(model.signals, first, last, strict=True)]
    c, d = ca.substitute([t.f - t.A @ t.x, t.h - t.C @ t.x], [t.x], [ca.SX(ca.DM(model.start))])
    A0, c0 = ca.substitute([t.A, c], own, first)
    A1, c1 = ca.substitute([t.A, c], own, ends)
    C, d, y = ca.substitute([t.C, d, t.reading], own, last)
    noise = ca.sparsify(ca.SX(ca.DM(model.process)))

    def at(tau: float) -> tuple[SX, list[SX]]:
        return c1 - tau * (c1 - c0), [noise]

    D = ca.sparsify(A1 - A0)
    Phi, forced, (Q,) = between.expressions(ca.sparsify(A1), D, at, h, order)
    of_Phi, of_C = reach(t.A), entries(t.C)
    motion = [_picked(Phi, of_Phi), ca.densify(forced), own_factors(Q)]
    total = ca.sum1(ca.vertcat(*motion))  # finite, if and only if they are and nothing overflows
    outputs = [*motion, _picked(C, of_C), d, y, total]
    return AtSamples(ca.vertcat(*first, *last, h), outputs)
