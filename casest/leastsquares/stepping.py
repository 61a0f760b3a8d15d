"""One step of differential equations and of their slopes, also where a rate jumps on the way.

Within a step every sign, absolute value, comparison, least and greatest is held at what it is where
the step begins (its mode), so that the rate is smooth there. Where one of them changes on the way,
the step is made in two: to the place where it changes, found by Newton's method, and on from there.
The slopes jump there too: by (f₋ − f₊)·dτ, τ being the time of the change (M. Aizerman, F.
Gantmakher, 1958; "saltation").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from casest.declaration.flow import Flow
from casest.declaration.physics import SX
from casest.engine.graph import Graph
from casest.engine.operations import BY_CODE
from casest.engine.runge_kutta import step

#: Steps of Newton's method to the place of a change, and how near it must come, of the distance.
NEWTON, NEAR = 5, 1e-9
#: Mark of a step that ends where both modes lead back to the change.
HELD = 2


@dataclass(frozen=True)
class Switched:
    """Rates whose jumps and corners are held: `modes` (m,), −1 or 1, of what `turns` (m,) decide by
    its sign."""

    rates: SX
    modes: SX
    turns: SX


def switched(flow: Flow, parameters: SX) -> Switched:
    """The rates of a flow with a mode in the place of each sign of what changes along it."""
    sample = ca.vertcat(flow.x, flow.inputs)
    graph = Graph(ca.Function("rates", [parameters, sample], [ca.densify(flow.rates)]))
    built: list[SX] = []
    modes: dict[object, tuple[SX, SX]] = {}

    def mode(key: object, turn: SX) -> SX:
        return modes.setdefault(key, (ca.SX.sym("mode"), turn))[0]

    for value in graph.values:
        own = [built[i] for i in value.operands]
        if value.kind != "operation":
            inputs = {"parameter": parameters, "sample": sample}
            built.append(
                ca.SX(value.constant)
                if value.kind == "constant"
                else inputs[value.kind][value.code]
            )
        elif not value.per_sample or value.code not in _HELD:
            rebuilt = ca.SX.unary if BY_CODE[value.code].arity == 1 else ca.SX.binary
            built.append(rebuilt(value.code, *own))
        elif len(own) == 1:
            built.append(_HELD[value.code](mode(value.operands[0], own[0]), *own))
        else:  # of a comparison the difference decides
            built.append(_HELD[value.code](mode(value.operands, own[1] - own[0]), *own))
    found = ca.vertcat(*(built[i] for i in graph.outputs[0]))
    symbols, turns = ([pair[k] for pair in modes.values()] for k in (0, 1))
    return Switched(found, ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *turns))


#: What becomes of an operation in a mode s: of a sign that of its operand, of two operands a and b
#: that of b − a.
_HELD: dict[int, Callable[..., SX]] = {
    ca.OP_SIGN: lambda s, a: s,
    ca.OP_FABS: lambda s, a: s * a,
    ca.OP_LT: lambda s, a, b: (1 + s) / 2,
    ca.OP_LE: lambda s, a, b: (1 + s) / 2,
    ca.OP_FMIN: lambda s, a, b: (a + b - s * (b - a)) / 2,
    ca.OP_FMAX: lambda s, a, b: (a + b + s * (b - a)) / 2,
}


@dataclass(frozen=True)
class Inputs:
    """Inputs of a step (k,), how far they go in it, and the slopes (k, p) of both, U and faster."""

    u: SX
    du: SX
    U: SX
    faster: SX

    def at(self, c: SX | float) -> tuple[SX, SX]:
        """Inputs and their slopes at a share of the step."""
        return self.u + c * self.du, self.U + c * self.faster

    def between(self, first: SX, last: SX) -> Inputs:
        """Those of a part of the step."""
        u, U = self.at(first)
        return Inputs(u, (last - first) * self.du, U, (last - first) * self.faster)


@dataclass(frozen=True)
class Way:
    """How states x and their slopes X in the coordinates go on, in the modes of the rates."""

    flow: Flow
    held: Switched
    coordinates: SX
    fed: bool

    def step(self, x: SX, X: SX, given: Inputs, h: SX, modes: SX) -> tuple[SX, SX, SX]:
        """x and X after a step, and the differences (2n,) that tell its error."""
        n, p = X.shape
        f = self.held.rates
        every = [f, *(ca.jacobian(f, s) for s in (self.flow.x, self.coordinates, self.flow.inputs))]

        def rate(y: SX, c: float) -> SX:
            x, X = y[:n], ca.reshape(y[n:], n, p)
            u, U = given.at(c)
            now, A, B, G = self._put(every, x, u, modes)
            X = A @ X + B
            if self.fed:
                X = X + G @ U
            return ca.vertcat(ca.densify(now), ca.vec(ca.densify(X)))

        after, fifth, third = step(rate, ca.vertcat(x, ca.vec(X)), h)
        return after[:n], ca.reshape(after[n:], n, p), ca.vertcat(fifth[:n], third[:n])

    def moved(self, x: SX, given: Inputs, h: SX, modes: SX) -> SX:
        """x alone after a step."""

        def rate(y: SX, c: float) -> SX:
            return self._put([self.held.rates], y, given.at(c)[0], modes)[0]

        return step(rate, x, h)[0]

    def first_modes(self, x: SX, given: Inputs, h: SX) -> SX:
        """Modes where a step begins: what is just turning is where it turns to."""
        now = self.turns(x, given, 0.0, ca.SX.zeros(*self.held.modes.shape))
        faster = self._speeds(x, given, h, 0.0, ca.sign(now))[1]
        return ca.if_else(now == 0, ca.sign(faster), ca.sign(now))

    def turns(self, x: SX, given: Inputs, c: SX | float, modes: SX) -> SX:
        """What the modes are the signs of, at a share of a step."""
        return self._put([self.held.turns], x, given.at(c)[0], modes)[0]

    def crossed(self, x: SX, given: Inputs, modes: SX) -> SX:
        """Which modes (m,) are others at the end of a step that was made in them: 0 or 1."""
        return modes * self.turns(x, given, 1.0, modes) < 0

    def through(self, x: SX, X: SX, given: Inputs, h: SX) -> tuple[SX, SX, SX, SX]:
        """A step with at most one change of mode; its error's differences; 1 where it failed.

        NaN and HELD where both modes lead back: what comes to rest there is not followed.
        """
        modes = self.first_modes(x, given, h)
        far = self.moved(x, given, h, modes)
        change = self.crossed(far, given, modes)
        some = ca.sum1(change) > 0
        before, behind = (
            ca.dot(change * modes, self.turns(y, given, c, modes))
            for y, c in ((x, 0.0), (far, 1.0))
        )
        scale = before - behind
        share = ca.if_else(some, before / ca.if_else(some, scale, 1), 1)
        for _ in range(NEWTON):
            left, slope = self._to_change(x, given, h, share, modes, change)
            away = ca.if_else(some, left / ca.if_else(slope == 0, 1, slope), 0)
            share = ca.fmin(ca.fmax(share - away, 0), 1)
        left = self._to_change(x, given, h, share, modes, change)[0]
        first = given.between(0, share)
        at, slopes, error = self.step(x, X, first, h * share, modes)
        other = modes * (1 - 2 * change)
        slopes = slopes + self._jump(at, slopes, given, h, share, (modes, other), change)
        rest = given.between(share, 1)
        end, slopes, more = self.step(at, slopes, rest, h * (1 - share), other)
        held = ca.dot(change * other, self._speeds(at, given, h, share, other)[1]) < 0
        end = ca.if_else(ca.logic_and(some, held), ca.SX.nan(1, 1), end)
        again = other * self.turns(end, given, 1.0, other) < -NEAR * scale
        near = ca.fabs(left) <= NEAR * scale
        failed = ca.logic_or(
            ca.sum1(change) > 1, ca.logic_or(ca.sum1(again) > 0, ca.logic_not(near))
        )
        mark = ca.if_else(held, HELD, failed)
        return end, slopes, error + more, ca.if_else(some, mark, 0)

    def _to_change(
        self, x: SX, given: Inputs, h: SX, share: SX, modes: SX, change: SX
    ) -> tuple[SX, SX]:
        """How far what changes is from its change at a share of the step, and its slope there."""
        there = self.moved(x, given.between(0, share), h * share, modes)
        faster = self._speeds(there, given, h, share, modes)[1]
        which = change * modes
        return ca.dot(which, self.turns(there, given, share, modes)), h * ca.dot(which, faster)

    def _speeds(self, x: SX, given: Inputs, h: SX, c: SX | float, modes: SX) -> tuple[SX, SX]:
        """Rates, and how fast the turns (m,) change, at a share of a step."""
        turns = self.held.turns
        parts = [
            self.held.rates,
            ca.jacobian(turns, self.flow.x),
            ca.jacobian(turns, self.flow.inputs),
        ]
        f, A, G = self._put(parts, x, given.at(c)[0], modes)
        return f, A @ f + G @ (given.du / h)

    def _jump(
        self, x: SX, X: SX, given: Inputs, h: SX, c: SX, modes: tuple[SX, SX], change: SX
    ) -> SX:
        """By how much slopes (n, p) jump where modes change from the first to the second."""
        turns, (u, U) = self.held.turns, given.at(c)
        parts = [ca.jacobian(turns, s) for s in (self.flow.x, self.coordinates, self.flow.inputs)]
        A, B, G = self._put(parts, x, u, modes[0])
        later = change.T @ (A @ X + B + (G @ U if self.fed else 0))
        before, faster = self._speeds(x, given, h, c, modes[0])
        after = self._speeds(x, given, h, c, modes[1])[0]
        speed = ca.dot(change, faster)
        none = speed == 0
        return ca.if_else(none, 0, (after - before) / ca.if_else(none, 1, speed)) @ later

    def _put(self, parts: list[SX], x: SX, u: SX, modes: SX) -> list[SX]:
        own = [self.flow.x, self.flow.inputs, self.held.modes]
        found: list[SX] = ca.substitute(parts, own, [x, u, modes])
        return found


def numbers(inputs: int, unknowns: int) -> Inputs:
    """Symbols of the inputs of a step."""
    shapes = (("u", (inputs, 1)), ("du", (inputs, 1)), ("U", (inputs, unknowns)))
    u, du, U = (ca.SX.sym(name, *shape) for name, shape in shapes)
    return Inputs(u, du, U, ca.SX.sym("faster", inputs, unknowns))
