"""Rank of the readings' power series by the unknowns, in exact arithmetic modulo a prime.

Sedoglavic (2002): at a random point the rank modulo a prime is never more than the true one, and
less only where all its minors are multiples of the prime there, which is as likely as their degree
over the prime.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.physics import SX
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.structural.field import PRIME, Echelon, Residues, spanned
from casest.dynamics.structural.points import Points, points
from casest.dynamics.structural.program import Program, program_of
from casest.dynamics.structural.series import Series

#: Points at once: their series stay within a few hundred megabytes.
TOGETHER = 8


@dataclass(frozen=True)
class Question:
    """What is asked of a model: with inputs that vary or not, states that are known at the
    beginning, and inputs that nobody measures."""

    model: Dynamics
    varying: bool = True
    known: tuple[str, ...] = ()
    unmeasured: tuple[str, ...] = ()

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Signals that rates or outputs are computed from."""
        t = self.model.traced
        used = ca.vertcat(t.f, t.h, t.g)
        names = [s.name for s in self.model.signals]
        return tuple(n for n in names if ca.depends_on(used, flat(t.symbols[n])))

    @cached_property
    def free(self) -> dict[str, SX]:
        """What is free in each input: all its numbers, of a rotation three (Cayley)."""
        turned = {s.name for s in self.model.signals if s.kind == "rotation"}
        symbols = self.model.traced.symbols
        return {n: ca.SX.sym(n, 3) if n in turned else flat(symbols[n]) for n in self.inputs}

    def told(self, extra: SX | None) -> Any:
        """The function of states and of what is free in the inputs: rates, readings, `extra`."""
        t = self.model.traced
        told = [t.f, ca.vertcat(t.h, t.g), ca.SX(0, 1) if extra is None else extra]
        for name, c in self.free.items():
            if (symbol := t.symbols[name]).shape == (3, 3):
                told = ca.substitute(told, [flat(symbol)], [flat(_rotation(c))])
        u = ca.vertcat(*self.free.values()) if self.free else ca.SX(0, 1)
        return ca.Function("model", [t.x, u], [ca.densify(e) for e in told], {"cse": True})

    def places(self, names: Sequence[str]) -> list[int]:
        """Where the numbers of some inputs are among those of all inputs."""
        found, place = [], 0
        for name, symbol in self.free.items():
            size = symbol.numel()
            found += list(range(place, place + size)) if name in names else []
            place += size
        return found

    @property
    def measured(self) -> tuple[str, ...]:
        """Inputs that are known."""
        return tuple(name for name in self.inputs if name not in self.unmeasured)

    @cached_property
    def known_places(self) -> list[int]:
        """Where the states that are known at the beginning are among the unknowns."""
        where = self.model.slices()
        return [i for name in self.known for i in range(where[name].start, where[name].stop)]


def _rotation(c: SX) -> SX:
    """The rotation with Cayley's parameters c: rational in them, and almost every one."""
    square = ca.dot(c, c)
    return ((1 - square) * ca.SX.eye(3) + 2 * ca.skew(c) + 2 * c @ c.T) / (1 + square)


class Exact:
    """Answers about one model. Raises Inexact where it cannot be computed modulo a prime."""

    def __init__(self, asked: Question, seed: int, extra: SX | None = None) -> None:
        self.asked, self.n = asked, asked.model.size
        told = asked.told(extra)
        self.program: Program = program_of(told)
        self._rng = np.random.default_rng(seed)
        self.pool: Points = points(self.program, self.n, told.numel_in(1), self._rng)
        self._varied = self._series_of_inputs(self.n + 2)

    def _series_of_inputs(self, orders: int) -> Residues:
        count, m = self.pool.inputs.shape
        found = np.zeros((count, orders, m), np.int64)
        vary = range(m) if self.asked.varying else self.asked.places(self.asked.unmeasured)
        found[:, :, vary] = self._rng.integers(0, PRIME, (count, orders, len(vary)))
        clock = self.asked.places(["t"])
        found[:, 1:, clock] = 0
        found[:, 1, clock] = 1
        return found

    def series(self, which: slice, orders: int) -> Series:
        """Series at some points of the pool."""
        free = self.asked.places(self.asked.unmeasured)
        return Series(self.program, self.pool[which], self._varied[which, :orders], free)

    @cached_property
    def reached(self) -> int:
        """The order of the readings' derivatives from which on none adds to their rank.

        Of unmeasured inputs that order is n: what the readings say of the states, whatever these
        were, no later derivative adds to (Di Benedetto, Grizzle & Moog 1989).
        """
        series = self.series(slice(0, 1), self.n + 1)
        found = Echelon(series.unknowns)
        free = bool(self.asked.unmeasured)
        for order in range(self.n + 1):
            before = found.rank
            series.forward()
            for row in series.output(1)[0]:
                found.add(row)
            # Once an order adds nothing, none after it does: each derivative of the rows is then
            # a combination of those before it.
            if not free and (found.rank == before or found.rank == series.unknowns):
                return order
        return self.n

    def hidden(self, which: slice) -> list[Residues]:
        """At each of some points a basis (n, k) of how the unknowns change without a trace."""
        found = [null[: self.n] for null in self._nulls(which)]
        return [spanned(null.T).rows.T for null in found] if self.asked.unmeasured else found

    def hidden_inputs(self) -> tuple[str, ...]:
        """Unmeasured inputs that no record determines, number by number."""
        names = [
            name if size == 1 else f"{name}[{i}]"
            for name in self.asked.unmeasured
            for size in [self.asked.free[name].numel()]
            for i in range(size)
        ]
        null = self._nulls(slice(0, 1))[0][self.n :: self.reached + 1]
        return tuple(n for n, row in zip(names, null, strict=True) if row.any())

    def _nulls(self, which: slice) -> list[Residues]:
        series = self.series(which, self.reached + 1)
        rows = []
        for _ in range(self.reached + 1):
            series.forward()
            rows.append(series.output(1))
        stacked = np.concatenate(rows, axis=1)
        return [self._null(own) for own in stacked]

    def _null(self, rows: Residues) -> Residues:
        known = np.zeros((len(self.asked.known_places), rows.shape[1]), np.int64)
        known[range(len(known)), self.asked.known_places] = 1
        return spanned(np.concatenate([known, rows])).null()

    def gradients(self, which: slice) -> Residues:
        """Of the extra functions at some points, (count, rows, n)."""
        series = self.series(which, 1)
        series.forward()
        return series.output(2)[..., : self.n]
