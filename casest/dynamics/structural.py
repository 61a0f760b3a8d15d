"""What any record could show: rank of the observability codistribution from Lie derivatives.

The readings and their derivatives along the motion, y, ẏ, ÿ, …, are functions of the state; where
their Jacobian has full rank at almost every point, the state is (locally) observable from suitable
data (Hermann & Krener 1977). Parameters are states without a rate, so that the same rank says
whether they are identifiable. Inputs are functions of time with derivatives of any size, or held
constant, which may show less (Villaverde et al. 2019).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.gramian import sentence
from casest.errors import DeclarationError

#: A singular value of the Jacobian, its rows and columns brought to one size, counts as zero below
#: this share of the largest: rounding leaves about 1e-15, at orders up to ten.
NULL = 1e-10

#: Random points; the rank is the largest found, and what hides must hide at all of them.
POINTS = 4

#: Attempts to find a point where every derivative is finite.
ATTEMPTS = 50


@dataclass(frozen=True)
class Structure:
    """Structural rank among n states and parameters.

    `undetermined` are those that no record can show, `unobservable` says in words how they may
    change without a trace; `order` is that of the highest derivative of the readings used;
    `gap` (smallest singular value that counts, over the largest that does not) shows how clear the
    rank is; `varying` whether inputs were free functions of time, `inputs` their names.
    """

    model: Dynamics
    rank: int
    order: int
    gap: float
    undetermined: tuple[str, ...]
    unobservable: tuple[str, ...]
    varying: bool
    inputs: tuple[str, ...]

    @property
    def unknowns(self) -> int:
        """Number n of states and parameters."""
        return self.model.size

    @property
    def observable(self) -> bool:
        """Can suitable data determine every state and parameter?"""
        return self.rank == self.unknowns


def structure(model: Dynamics, *, varying: bool = True, seed: int = 0) -> Structure:
    """Structural rank of a model, from Lie derivatives at random points.

    `varying`: inputs with free derivatives of every order; else constant. Raises DeclarationError
    where no point is found at which the readings' derivatives are finite.
    """
    lie = _Lie(model, varying)
    points = lie.points(np.random.default_rng(seed))
    rank, order = 0, -1
    while True:
        order += 1
        found = [_ranked(lie.jacobian(order, point)) for point in points]
        before, rank = rank, max(r for r, _, _ in found)
        # Once an order adds nothing, none after it does: each derivative of the Jacobian's rows is
        # then a combination of those before it.
        if rank in (before, model.size):
            break
    best = [k for k, (r, _, _) in enumerate(found) if r == rank]
    nulls = [found[k][2] for k in best]
    hidden = np.max([np.linalg.norm(N, axis=1) for N in nulls], axis=0) > 1e-6
    states = [points[k][: model.size] for k in best]
    vectors = [lie.vectors(points[k]) for k in best]
    return Structure(
        model,
        rank,
        order,
        min(found[k][1] for k in best),
        tuple(n for n, h in zip(model.names, hidden, strict=True) if h),
        tuple(_laws(model, nulls, states, vectors)) if rank < model.size else (),
        varying,
        lie.inputs,
    )


class _Lie:
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

    def vectors(self, point: Array) -> dict[str, Array]:
        """The inputs of three components at a point."""
        found, place = {}, self.model.size
        for name, size in zip(self.inputs, self._sizes, strict=True):
            if size == 3:
                found[name] = point[place : place + size]
            place += size
        return found

    def points(self, rng: np.random.Generator) -> list[Array]:
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
            clocks = np.repeat(self.clock, self._sizes).astype(bool)
            inputs[1, clocks], inputs[2:, clocks] = 1.0, 0.0
            point = np.concatenate([x, inputs.ravel()])
            if self._holds(point):
                found.append(point)
            if len(found) == POINTS:
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
        while len(self.derivatives) <= order:
            self._next()
        t, links = self.model.traced, self.chain[: order + 1]
        stacked = ca.jacobian(ca.vertcat(*self.derivatives[: order + 1]), t.x)
        arguments = ca.vertcat(t.x, *links)
        function = ca.Function("lie", [arguments], [stacked], {"cse": True})
        return np.asarray(function(point[: arguments.numel()]), float)


def _ranked(jacobian: Array) -> tuple[int, float, Array]:
    """Rank, gap and null space (n, k) of a Jacobian, whatever the units of rows and columns."""
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
    rest = max(values[rank] if rank < n else 0.0, 1e-16 * max(values[0], 1e-300))
    null = columns[:, None] * right[rank:].T
    null = null / np.maximum(np.linalg.norm(null, axis=0), 1e-300)
    return rank, float(values[rank - 1] / rest) if rank else 0.0, np.asarray(null)


def _laws(
    model: Dynamics,
    nulls: Sequence[Array],
    states: Sequence[Array],
    vectors: Sequence[Mapping[str, Array]],
) -> list[str]:
    """How the state may change without a trace, a sentence per hidden direction."""
    pivots = _pivots(nulls[0])
    bases = [N @ np.linalg.inv(N[pivots]) for N in nulls]
    found = []
    for k, pivot in enumerate(pivots):
        directions = np.array([B[:, k] for B in bases])
        directions[np.abs(directions) < 1e-7 * np.abs(directions).max()] = 0.0
        along = _along(model, directions, vectors)
        found.append(along or _law(model, directions, np.array(states), pivot))
    return found


def _along(
    model: Dynamics, directions: Array, vectors: Sequence[Mapping[str, Array]]
) -> str | None:
    """A direction that follows an input: gravity and bias along the rate of turn."""
    own = {n: directions[:, w] for n, w in model.slices().items() if directions[:, w].any()}
    if any(parts.shape[1] != 3 for parts in own.values()):
        return None
    for name in vectors[0]:
        unit = np.array([v[name] / np.linalg.norm(v[name]) for v in vectors])
        if all(np.abs(np.cross(parts, unit)).max() < 1e-7 * np.abs(parts).max()
               for parts in own.values()):  # fmt: skip
            names = list(own)
            if len(names) == 1:
                return f"{names[0]} along {name} changes no reading"
            return f"{_listed(names)} along {name} cannot be told apart"
    return None


def _pivots(null: Array) -> list[int]:
    """Rows that a basis of the null space can be the identity on."""
    from scipy.linalg import qr

    return sorted(int(i) for i in qr(null.T, pivoting=True)[2][: null.shape[1]])


def _law(model: Dynamics, directions: Array, states: Array, pivot: int) -> str:
    touched = np.flatnonzero(np.abs(directions).max(axis=0))
    names = [model.names[i] for i in touched]
    if len(touched) == 1:
        return f"{names[0]} changes no reading"
    if np.ptp(directions, axis=0).max() < 1e-6 * np.abs(directions).max():
        return sentence(model, directions[0])
    growth = directions[:, touched] / states[:, touched] * states[:, pivot : pivot + 1]
    if np.ptp(growth, axis=0).max() < 1e-6 * np.abs(growth).max():
        return _scaling(names, growth[0])
    return f"{_listed(names)} cannot all be told apart: only combinations of them are seen"


def _scaling(names: Sequence[str], powers: Array) -> str:
    """What is multiplied by λ to which power: `predator·λ, b/λ`."""
    if len(names) == 2 and np.allclose(powers, powers[0]):
        return f"only the quotient of {names[0]} and {names[1]} is seen"
    if len(names) == 2 and np.isclose(powers[0], -powers[1]):
        return f"only the product of {names[0]} and {names[1]} is seen"
    powers = np.round(powers / np.abs(powers).min() * np.sign(powers[0]), 6)
    terms = []
    for power in dict.fromkeys(powers.tolist()):
        same = [n for n, p in zip(names, powers, strict=True) if p == power]
        factor = {1.0: "λ", -1.0: "1/λ"}.get(power, f"λ^{power:.3g}")
        terms.append(f"{_listed(same)} by {factor}")
    return f"multiplying {_listed(terms)} changes no reading"


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
