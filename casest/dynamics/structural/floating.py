"""Structural rank in floating point, from Lie derivatives at random points.

For models that no power series modulo a prime can follow: corners, steps, rounded constants.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.structural.words import Hidden
from casest.errors import DeclarationError

#: A singular value of the Jacobian, its rows and columns brought to one size, counts as zero below
#: this share of the largest: rounding leaves about 1e-15, at orders up to ten.
NULL = 1e-10

#: Random points; the rank is the largest found, and what hides must hide at all of them.
POINTS = 4

#: Attempts to find a point where every derivative is finite.
ATTEMPTS = 50


@dataclass(frozen=True)
class Ranked:
    """Rank, order of the highest derivative, gap between what counts and what does not, the states
    that are not determined, and the hidden directions."""

    rank: int
    order: int
    gap: float
    undetermined: tuple[str, ...]
    hidden: tuple[Hidden, ...]


def finite(model: Dynamics) -> None:
    """Raise DeclarationError where no point is found at which rates and outputs are finite."""
    Lie(model, varying=True).points(np.random.default_rng(0), 1)


def ranked(model: Dynamics, varying: bool, seed: int, known: Sequence[int] = ()) -> Ranked:
    """Structural rank of a model, from Lie derivatives at random points.

    `known` are the places of states whose value at the beginning is known.
    """
    lie = Lie(model, varying)
    points = lie.points(np.random.default_rng(seed), POINTS)
    rank, order = 0, -1
    while True:
        order += 1
        found = [null_space(lie.jacobian(order, point)) for point in points]
        before, rank = rank, max(r for r, _, _ in found)
        # Once an order adds nothing, none after it does: each derivative of the Jacobian's rows is
        # then a combination of those before it.
        if rank in (before, model.size):
            break
    if known:  # each is one more reading, at the beginning alone
        beside = np.eye(model.size)[list(known)]
        stacked = [np.vstack([lie.jacobian(order, point), beside]) for point in points]
        found = [null_space(one) for one in stacked]
        rank = max(r for r, _, _ in found)
    best = [k for k, (r, _, _) in enumerate(found) if r == rank]
    nulls = [found[k][2] for k in best]
    hidden = np.max([np.linalg.norm(N, axis=1) for N in nulls], axis=0) > 1e-6
    states = np.array([points[k][: model.size] for k in best])
    vectors = [lie.vectors(points[k]) for k in best]
    return Ranked(
        rank,
        order,
        min(found[k][1] for k in best),
        tuple(n for n, h in zip(model.names, hidden, strict=True) if h),
        tuple(_laws(model, nulls, states, vectors)) if rank < model.size else (),
    )


class Lie:
    """Derivatives of the readings along the motion, as far as they are asked for."""

    def __init__(self, model: Dynamics, varying: bool) -> None:
        t = model.traced
        used = ca.vertcat(t.f, t.h, t.g)
        names = [s.name for s in model.signals]
        self.model, self.varying = model, varying
        self.inputs = tuple(n for n in names if ca.depends_on(used, flat(t.symbols[n])))
        self.clock = [s.name == "t" for s in model.signals if s.name in self.inputs]
        first = [flat(t.symbols[n]) for n in self.inputs]
        self.chain: list[SX] = [ca.vertcat(*first)] if first else [ca.SX(0, 1)]
        # What is known exactly is a reading too.
        self.derivatives: list[SX] = [ca.vertcat(t.h, t.g)]

    def _next(self) -> None:
        """One more derivative: ∂L/∂x·f + Σ ∂L/∂u⁽ʲ⁾·u⁽ʲ⁺¹⁾."""
        t, size = self.model.traced, self.chain[0].numel()
        self.chain.append(ca.SX.sym(f"u{len(self.chain)}", size))
        where, rate = ca.vertcat(t.x, *self.chain[:-1]), ca.vertcat(t.f, *self.chain[1:])
        self.derivatives.append(ca.cse(ca.jtimes(self.derivatives[-1], where, rate)))

    @cached_property
    def _sizes(self) -> list[int]:
        symbols = self.model.traced.symbols
        return [symbols[n].numel() for n in self.inputs]

    @cached_property
    def clocks(self) -> Array:
        """Which numbers of the inputs are time itself."""
        return np.repeat(self.clock, self._sizes).astype(bool)

    def vectors(self, point: Array) -> dict[str, Array]:
        """The inputs of three components at a point."""
        found, place = {}, self.model.size
        for name, size in zip(self.inputs, self._sizes, strict=True):
            if size == 3:
                found[name] = point[place : place + size]
            place += size
        return found

    def points(self, rng: np.random.Generator, count: int) -> list[Array]:
        """Points (state, inputs and their derivatives) at which all that may be asked is finite."""
        found: list[Array] = []
        n, size = self.model.size, self.chain[0].numel()
        spread = np.sqrt(np.diag(self.model.start_covariance))
        for attempt in range(ATTEMPTS):
            x = rng.uniform(0.5, 1.5, n)
            if attempt % 2:  # a model may hold near its own start only
                x = self.model.start + spread * rng.uniform(-1, 1, n)
            inputs = rng.uniform(0.5, 1.5, (n + 1, size))
            inputs[1:] *= self.varying * rng.choice([-1.0, 1.0], (n, size))
            inputs[1, self.clocks], inputs[2:, self.clocks] = 1.0, 0.0
            point = np.concatenate([x, inputs.ravel()])
            if self._holds(point):
                found.append(point)
            if len(found) == count:
                return found
        raise DeclarationError(
            f"dynamics {self.model.name}: rates or outputs are not finite at {ATTEMPTS} random "
            "points, some within the states' std of their start; give start= and std= where the "
            "model holds"
        )

    def _holds(self, point: Array) -> bool:
        t = self.model.traced
        values = ca.Function("values", [ca.vertcat(t.x, self.chain[0])], [ca.vertcat(t.f, t.h)])
        here = np.asarray(values(point[: values.numel_in()]))
        return bool(np.all(np.isfinite(here)) and np.all(np.isfinite(self.jacobian(1, point))))

    def jacobian(self, order: int, point: Array) -> Array:
        """Jacobian of all derivatives up to `order` by the state, at a point."""
        function = self.function(order)
        return np.asarray(function(point[: function.numel_in(0)]), float)

    def function(self, order: int) -> Any:
        """The same as a function of the point."""
        self._reach(order)
        t, links = self.model.traced, self.chain[: order + 1]
        stacked = ca.jacobian(ca.vertcat(*self.derivatives[: order + 1]), t.x)
        return ca.Function("lie", [ca.vertcat(t.x, *links)], [stacked], {"cse": True})

    def operations(self, order: int) -> int:
        """Of the derivative of that order."""
        self._reach(order)
        where = ca.vertcat(self.model.traced.x, *self.chain)
        return int(ca.Function("last", [where], [self.derivatives[order]]).n_instructions())

    def _reach(self, order: int) -> None:
        while len(self.derivatives) <= order:
            self._next()


def null_space(jacobian: Array, known: int | None = None) -> tuple[int, float, Array]:
    """Rank (unless it is `known`), gap and null space (n, k) of a Jacobian, whatever the units of
    rows and columns."""
    n = jacobian.shape[1]
    if not np.all(np.isfinite(jacobian)):
        return 0, 0.0, np.eye(n)
    even, columns = jacobian.copy(), np.ones(n)
    for _ in range(3):
        rows = np.linalg.norm(even, axis=1, keepdims=True)
        even = even / np.where(rows > 0, rows, 1.0)
        own = np.linalg.norm(even, axis=0)
        own = np.where(own > 0, own, 1.0)
        even, columns = even / own, columns / own
    _, found, right = np.linalg.svd(even)
    values = np.concatenate([found, np.zeros(n - len(found))])
    rank = int(np.sum(values > NULL * values[0])) if values[0] > 0 else 0
    rank = rank if known is None else known
    rest = max(values[rank] if rank < n else 0.0, 1e-16 * max(values[0], 1e-300))
    null = columns[:, None] * right[rank:].T
    null = null / np.maximum(np.linalg.norm(null, axis=0), 1e-300)
    return rank, float(values[rank - 1] / rest) if rank else 0.0, np.asarray(null)


def _laws(
    model: Dynamics,
    nulls: Sequence[Array],
    states: Array,
    vectors: Sequence[Mapping[str, Array]],
) -> Iterator[Hidden]:
    """The law of each hidden direction."""
    pivots = _pivots(nulls[0])
    bases = [N @ np.linalg.inv(N[pivots]) for N in nulls]
    for k, pivot in enumerate(pivots):
        directions = np.array([B[:, k] for B in bases])
        directions[np.abs(directions) < 1e-7 * np.abs(directions).max()] = 0.0
        touched = np.flatnonzero(np.abs(directions).max(axis=0))
        along = _along(model, directions, vectors)
        shift = directions[0] if _same(directions) else None
        growth = directions[:, touched] / states[:, touched] * states[:, pivot : pivot + 1]
        powers = growth[0] if _same(growth) else None
        yield Hidden(tuple(touched.tolist()), along, shift, powers)


def _same(values: Array) -> bool:
    return bool(np.ptp(values, axis=0).max() < 1e-6 * np.abs(values).max())


def _along(
    model: Dynamics, directions: Array, vectors: Sequence[Mapping[str, Array]]
) -> str | None:
    """The input that a direction follows: gravity and bias along the rate of turn."""
    own = {n: directions[:, w] for n, w in model.slices().items() if directions[:, w].any()}
    if any(parts.shape[1] != 3 for parts in own.values()):
        return None
    for name in vectors[0]:
        unit = np.array([v[name] / np.linalg.norm(v[name]) for v in vectors])
        if all(np.abs(np.cross(parts, unit)).max() < 1e-7 * np.abs(parts).max()
               for parts in own.values()):  # fmt: skip
            return name
    return None


def _pivots(null: Array) -> list[int]:
    """Rows that a basis of the null space can be the identity on."""
    from scipy.linalg import qr

    return sorted(int(i) for i in qr(null.T, pivoting=True)[2][: null.shape[1]])
