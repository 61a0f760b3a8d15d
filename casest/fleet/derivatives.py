"""Derivatives of every sample of many sensors, and sums of second ones."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import function_of
from casest.engine import Replay
from casest.fleet.linear import whole
from casest.fleet.sums import Sensors, SideBySide


@lru_cache(maxsize=64)
def _bends(model: Model) -> tuple[Replay, SideBySide]:
    """Σ r ∂²r of one sample, lower triangle: what the Hessian of ½rᵀr has beyond JᵀJ."""
    t = model.traced
    force = ca.SX.sym("force", t.expression.numel())
    second = ca.tril(ca.hessian(ca.dot(force, t.expression), t.coordinates)[0])
    replay = Replay(function_of(model, {"B": ca.substitute(second, force, t.expression)}))
    return replay, SideBySide(replay, replay.entries(0))


def bend(model: Model, x: Array, sensors: Sensors) -> Array:
    """The same summed over samples, both triangles, (n, n, W)."""
    replay, beside = _bends(model)
    row, column = replay.sparsity[0]
    total = np.zeros((len(x), *x.shape))
    for _, s, values in beside.chunks(x, sensors):
        total[row, column, s] += np.add.reduce(values, axis=1)
    return whole(total)


@lru_cache(maxsize=64)
def _beside(replay: Replay, output: int) -> SideBySide:
    return SideBySide(replay, replay.entries(output))


def dense(replay: Replay, x: Array, sensors: Sensors, output: int = 0) -> Array:
    """One output of every sample, (rows, columns, N, W)."""
    row, column = replay.sparsity[output]
    found = np.zeros((*replay.shapes[output], *sensors.samples.shape[1:]))
    for span, s, values in _beside(replay, output).chunks(x, sensors):
        found[row, column, span, s] = values
    return found
