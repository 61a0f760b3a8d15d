"""Power series in time modulo a prime, each coefficient with its derivatives by the unknowns.

From ẋ = f(x, u) one coefficient after the other: x of order k + 1 is f of order k over k + 1.
A coefficient is a row: its value, then its derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from casest.dynamics.structural.field import PRIME, Residues, inverse
from casest.dynamics.structural.points import Points
from casest.dynamics.structural.program import Program


class Series:
    """Series of every step of a program at some points, up to `orders` coefficients.

    `inputs` (count, orders, m) are those of the inputs, from order 1 on; the inputs `free` are
    unknown: each of their coefficients is one more unknown, after the states.
    """

    def __init__(
        self, program: Program, points: Points, inputs: Residues, free: Sequence[int] = ()
    ) -> None:
        self.program, self.points, self.inputs = program, points, inputs
        count, n = points.states.shape
        self.orders = inputs.shape[1]
        self.free = {which: n + place * self.orders for place, which in enumerate(free)}
        self.unknowns = n + len(free) * self.orders
        steps = len(program.steps)
        self.rows = np.zeros((steps, count, self.orders, 1 + self.unknowns), np.int64)
        self.order = -1
        #: ẇ of what paths are functions of, and 1/b of what is divided by.
        self._rate: dict[int, Residues] = {}
        self._over: dict[int, Residues] = {}
        for step in program.steps:
            if step.do == "path" and step.operands[1] not in self._rate:
                self._rate[step.operands[1]] = np.zeros_like(self.rows[0])

    def output(self, which: int) -> Residues:
        """Derivatives (count, rows, unknowns) of the last coefficient of an output."""
        return self.rows[self.program.outputs[which], :, self.order, 1:].transpose(1, 0, 2)

    def forward(self) -> None:
        """One more coefficient of every step."""
        self.order += 1
        rates = self.program.outputs[0]
        k = self.order
        for i, step in enumerate(self.program.steps):
            if step.do == "state":
                self._state(i, step.index, rates)
            elif step.do == "input":
                self._input(i, step.index)
            elif step.do in ("constant", "pi"):
                self.rows[i, :, k, 0] = self.points.values[i] if k == 0 else 0
            else:
                self._DO[step.do](self, i, *step.operands)
            if i in self._rate:
                self._rate[i][:, k] = k * self.rows[i, :, k] % PRIME

    def _state(self, i: int, index: int, rates: Sequence[int]) -> None:
        k = self.order
        if k == 0:
            self.rows[i, :, 0, 0] = self.points.states[:, index]
            self.rows[i, :, 0, 1 + index] = 1
        else:
            rate = self.rows[rates[index], :, k - 1]
            self.rows[i, :, k] = rate * pow(k, -1, PRIME) % PRIME

    def _input(self, i: int, index: int) -> None:
        k = self.order
        given = self.points.inputs if k == 0 else self.inputs[:, k]
        self.rows[i, :, k, 0] = given[:, index]
        if index in self.free:
            self.rows[i, :, k, 1 + self.free[index] + k] = 1

    def _add(self, i: int, a: int, b: int) -> None:
        k = self.order
        self.rows[i, :, k] = (self.rows[a, :, k] + self.rows[b, :, k]) % PRIME

    def _sub(self, i: int, a: int, b: int) -> None:
        k = self.order
        self.rows[i, :, k] = (self.rows[a, :, k] - self.rows[b, :, k]) % PRIME

    def _mul(self, i: int, a: int, b: int) -> None:
        k, steps = self.order, self.program.steps
        for one, other in ((a, b), (b, a)):
            if steps[one].do in ("constant", "pi"):
                factor = self.points.values[one][:, None]
                self.rows[i, :, k] = self.rows[other, :, k] * factor % PRIME
                return
        self.rows[i, :, k] = convolved(self.rows[a], self.rows[b], k, 0, k)

    def _div(self, i: int, a: int, b: int) -> None:
        """c·b = a, solved for the last coefficient of c."""
        k = self.order
        if b not in self._over:
            over = np.zeros_like(self.rows[b, :, 0])
            over[:, :1] = inverse(self.rows[b, :, 0, :1])
            square = over[:, :1] * over[:, :1] % PRIME
            over[:, 1:] = -(square * self.rows[b, :, 0, 1:]) % PRIME
            self._over[b] = over
        left = self.rows[a, :, k]
        if k:
            left = (left - convolved(self.rows[i], self.rows[b], k, 0, k - 1)) % PRIME
        self.rows[i, :, k] = multiplied(left, self._over[b])

    def _path(self, i: int, slope: int, of: int) -> None:
        """ċ = slope·ẇ: k·c of order k is a sum that the slope of order k has no part in."""
        k, values = self.order, self.points.values
        if k == 0:
            self.rows[i, :, 0, 0] = values[i]
            self.rows[i, :, 0, 1:] = values[slope][:, None] * self.rows[of, :, 0, 1:] % PRIME
        else:
            total = convolved(self._rate[of], self.rows[slope], k, 1, k)
            self.rows[i, :, k] = total * pow(k, -1, PRIME) % PRIME

    _DO: ClassVar[dict[str, Callable[..., None]]] = {
        "add": _add,
        "sub": _sub,
        "mul": _mul,
        "div": _div,
        "path": _path,
    }


def multiplied(a: Residues, b: Residues) -> Residues:
    """Product of values with derivatives, (…, 1 + n)."""
    found = a[..., :1] * b % PRIME
    found[..., 1:] += a[..., 1:] * b[..., :1] % PRIME
    return np.asarray(found % PRIME)


def convolved(a: Residues, b: Residues, k: int, first: int, last: int) -> Residues:
    """Σ aᵢ·bₖ₋ᵢ for i from `first` to `last`, of series (count, orders, 1 + n)."""
    left = a[:, first : last + 1]
    right = b[:, k - last : k - first + 1][:, ::-1]
    found = (left[..., :1] * right % PRIME).sum(axis=1)
    found[..., 1:] += (left[..., 1:] * right[..., :1] % PRIME).sum(axis=1)
    return np.asarray(found % PRIME)
