"""Expressions of one sample, evaluated at many."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.engine import Columns, Recursion, Replay, evaluated

#: Samples that are evaluated one after the other.
FEW = 200


class AtSamples:
    """Expressions of one sample, evaluated at many: over blocks of them at once, or of a `FEW` one
    after the other, for which a call of NumPy an operation takes longer."""

    def __init__(self, sample: SX, outputs: list[SX]) -> None:
        self.sample, self.outputs = sample, [ca.densify(e) for e in outputs]

    def __call__(self, columns: list[Array]) -> list[Array]:
        """Each expression at every sample, (N, …)."""
        if len(columns[0]) > FEW:
            return over_samples(self._blocks, columns)
        _, *found = self._singly(np.zeros(1), np.hstack(columns))
        shapes = [e.shape for e in self.outputs]
        return [part.reshape(-1, *shape) for part, shape in zip(found, shapes, strict=True)]

    @cached_property
    def _blocks(self) -> Replay:
        return replay(self.sample, self.outputs)

    @cached_property
    def _singly(self) -> Recursion:
        nothing = ca.SX.sym("nothing")
        rows = [by_rows(e) for e in self.outputs]
        return Recursion(ca.Function("at", [nothing, self.sample], [nothing, *rows]))


def replay(sample: SX, outputs: list[SX]) -> Replay:
    """Expressions of one sample, to be evaluated over many."""
    none = ca.SX.sym("none", 0)
    names = ["parameters", "sample"], [f"o{k}" for k in range(len(outputs))]
    dense = [ca.densify(e) for e in outputs]
    return Replay(ca.Function("replayed", [none, sample], dense, *names))


def over_samples(expressions: Replay, columns: list[Array]) -> list[Array]:
    """Each expression at every sample, (N, …)."""
    return evaluated(expressions, np.zeros(0), Columns(columns))


def by_rows(matrix: Any) -> Any:
    """The entries of a matrix row by row, as they lie in an array."""
    return ca.vec(ca.densify(matrix).T)
