"""An effect with memory along a record: what it gives at every sample, and the slopes of that.

s[k] = F(s[k−1], x[k], dt[k]; θ) and y[k] = h(s[k−1], x[k], dt[k]; θ), both from one function of the
effect. The slopes follow the same recursion (forward sensitivity): with S = ∂s/∂θ and X = ∂x/∂θ,
S[k] = F_s S[k−1] + F_x X[k] + F_θ. Each stretch of the record begins anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.declaration.effect import Attached
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import Stage
from casest.engine import Recursion


@dataclass(frozen=True)
class Memory:
    """One stage of a model, of an effect on the sequence of samples; `own` as in `Staged.rows`."""

    model: Model
    stage: Stage
    own: tuple[int, ...] | None = None

    @property
    def attached(self) -> Attached:
        """The effect, where it acts."""
        assert self.stage.attached is not None
        return self.stage.attached

    @property
    def size(self) -> int:
        """Numbers m that the effect gives at a sample."""
        return int(self.stage.given.numel())

    @property
    def unknowns(self) -> int:
        """Number n of the parameters that slopes are taken in."""
        return int(self._coordinates.numel())

    @property
    def _coordinates(self) -> SX:
        every = self.model.staged.coordinates
        return every if self.own is None else every[list(self.own)]

    def along(
        self, parameters: Array, x: Array, X: Array, time: Array, block: NDArray[np.int_]
    ) -> tuple[Array, Array]:
        """What it gives (N, m) and its slopes (N, m, n), of what it takes (N, k) and its slopes."""
        count, m, n = len(x), self.size, self.unknowns
        first = np.r_[True, block[1:] != block[:-1]]
        parts = [x, X, _steps(time, first), first.astype(float)]
        of_all = [parameters]
        if self.attached.spanned:
            of_all = [*_span(x[:, :m], X[:, :m]), parameters]
        parts += [np.broadcast_to(part, (count, len(part))) for part in of_all]
        start = np.zeros(self._recursion.sizes[0])
        found = self._recursion(start, parts, keep=False)[1]
        return found[:, :m], found[:, m:].reshape(count, n, m).transpose(0, 2, 1)

    @cached_property
    def _recursion(self) -> Recursion:
        """([s, S], numbers of a sample) -> the next [s, S], and what it gives with its slopes."""
        traced, m, n = self.model.staged, self.size, self.unknowns
        s = ca.SX.sym("s", m * len(self.attached.keeps))
        x, span = ca.SX.sym("x", self.stage.taken.numel()), ca.SX.sym("span", m)
        dt, first = ca.SX.sym("dt"), ca.SX.sym("first")
        S, Y = (ca.SX.sym(name, of.numel(), n) for name, of in (("S", s), ("Y", span)))
        rows = ca.SX.sym("X", n, x.numel())  # as NumPy holds slopes: row by row
        X = rows.T
        begin = self._beginning(x)
        # Where a stretch begins, s and S are its own; slopes are those of the function of s.
        slopes = ca.if_else(first, ca.jacobian(begin, x) @ X, S)
        given, after = self._function(s, x, dt, span)
        outputs = []
        for found in (after, given):
            slope = ca.jacobian(found, s) @ slopes + ca.jacobian(found, x) @ X
            slope += ca.jacobian(found, span) @ Y + ca.jacobian(found, self._coordinates)
            outputs.append(ca.densify(ca.vertcat(found, ca.vec(ca.densify(slope)))))
        outputs = ca.substitute(outputs, [s], [ca.if_else(first, begin, s)])
        reach = [span, ca.vec(Y)] if self.attached.spanned else []
        parameters = ca.vertcat(traced.coordinates, traced.references)
        numbers = [x, ca.vec(rows), dt, first, *reach, parameters]
        return Recursion(ca.Function("step", [ca.vertcat(s, ca.vec(S)), *numbers], outputs))

    def _beginning(self, x: SX) -> SX:
        """What is kept before the first sample of a stretch: as if it had always been like that."""
        m = self.size
        starts = [start for _, start in self.attached.keeps]
        return ca.vertcat(*(x[:m] if isinstance(v, str) else v * ca.SX.ones(m) for v in starts))

    def _function(self, s: SX, x: SX, dt: SX, span: SX) -> tuple[SX, SX]:
        """What the effect gives and what it keeps, of what it kept and what it takes."""
        attached, m, shape = self.attached, self.size, self.stage.shape
        kept = {
            name: ca.reshape(s[i * m : (i + 1) * m], *shape)
            for i, (name, _) in enumerate(attached.keeps)
        }
        symbols, place = dict(self.model.staged.symbols), m
        for name, own in self.stage.read:
            end = place + own[0] * own[1]
            # Signals that are matrices lie row by row.
            part = x[place:end]
            symbols[name] = ca.reshape(part, 3, 3).T if own == (3, 3) else ca.reshape(part, *own)
            place = end
        value, reach = ca.reshape(x[:m], *shape), ca.reshape(span, *shape)
        given, *after = attached.step(value, symbols, kept, dt, reach)
        return ca.vec(given), ca.vertcat(*map(ca.vec, after))


def _steps(time: Array, first: NDArray[np.bool_]) -> Array:
    """Time since the sample before, (N,) in s; that of a stretch's first is the stretch's usual."""
    dt = np.diff(time, prepend=time[:1])
    starts = np.flatnonzero(first)
    for a, b in zip(starts, [*starts[1:], len(time)], strict=True):
        dt[a] = np.median(dt[a + 1 : b]) if b - a > 1 else 0.0
    return dt


def _span(x: Array, X: Array) -> tuple[Array, Array]:
    """How far each number goes in the run, (m,), and its slopes, flat."""
    high, low, column = x.argmax(axis=0), x.argmin(axis=0), np.arange(x.shape[1])
    slopes = X[high, column] - X[low, column]
    return x[high, column] - x[low, column], slopes.T.ravel()
