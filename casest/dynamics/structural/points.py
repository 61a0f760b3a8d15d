"""Random points of a model modulo a prime: states, inputs, and where its functions begin.

exp(w) is a residue of its own, algebraically independent of w, unless w is a combination of other
exponents and logarithms with rational coefficients (Ax 1971; Rosenlicht 1976). Such combinations
are looked for in tangents at many points at once, and kept: exp(2w) is exp(w)², cosine and sine of
a sum are those of its terms put together, and a root of a product is made of their roots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import lcm

import numpy as np
from numpy.typing import NDArray

from casest.dynamics.structural.field import (
    PRIME,
    Residues,
    fraction,
    inverse,
    power,
    residue,
    root,
    spanned,
)
from casest.dynamics.structural.program import Begin, Inexact, Program
from casest.dynamics.structural.turns import multiple, times, turn

#: Points in a pool without roots, and how many must be left. Even roots double the pool, up to so
#: many: each exists at every second point.
POOL, LEFT, ROOTS = 128, 70, 8


@dataclass(frozen=True)
class Points:
    """`states` (count, n), `inputs` (count, m) and every step's `values` (steps, count)."""

    states: Residues
    inputs: Residues
    values: Residues

    def __getitem__(self, which: slice) -> Points:
        """Some of them."""
        return Points(self.states[which], self.inputs[which], self.values[:, which])


def points(program: Program, states: int, inputs: int, rng: np.random.Generator) -> Points:
    """The random points of a pool at which everything exists, about POOL of them."""
    begins = program.begins.values()
    even = sum(b.kind == "angle" or b.exponent.denominator % 2 == 0 for b in begins)
    if even > ROOTS:
        raise Inexact(f"{even} square roots: a point that has them all is not found")
    scales: dict[int, int] = {}
    while True:
        start = _Start(program, states, inputs, POOL << even, rng, scales)
        try:
            found = start.points()
        except _Halved as again:
            # A later exponent is a fraction of an earlier one: the earlier begins as a power.
            scales[again.path] = scales.get(again.path, 1) * again.times
            continue
        if len(found.states) < LEFT:
            raise Inexact("there are too few points at which nothing is divided by zero")
        return found


class _Halved(Exception):
    def __init__(self, path: int, times: int) -> None:
        self.path, self.times = path, times


@dataclass(frozen=True, eq=False)
class _Root:
    """A root e of what is independent of all others, and its logarithmic tangent."""

    path: int
    value: Residues
    tangent: Residues

    @property
    def e(self) -> tuple[Residues, ...]:
        """As that of an exponent."""
        return (self.value,)


@dataclass(frozen=True, eq=False)
class _Basis:
    """An exponent l that others are combinations of, with e = exp(l), at every point.

    `group` is "real" or "circle" (e is cosine and sine, of an angle a multiple of both).
    """

    begin: Begin
    group: str
    exponent: Residues
    e: tuple[Residues, ...]
    tangent: Residues

    @property
    def path(self) -> int:
        """Where it begins."""
        return self.begin.paths[0]


@dataclass
class _Start:
    """Values and tangents of all steps at a pool of points, as far as they are asked for."""

    program: Program
    states: int
    inputs: int
    count: int
    rng: np.random.Generator
    scales: dict[int, int]
    good: NDArray[np.bool_] = field(init=False)
    basis: list[_Basis] = field(default_factory=list)
    roots: list[_Root] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.good = np.ones(self.count, bool)
        self.x, self.u = self.random(self.states), self.random(self.inputs)
        self.dx, self.du = self.random(self.states), self.random(self.inputs)
        self._values: dict[int, Residues] = {}
        self._tangents: dict[int, Residues] = {}
        self._constants: dict[Fraction, tuple[Residues, ...]] = {}

    def random(self, *shape: int) -> Residues:
        return np.asarray(self.rng.integers(1, PRIME, (*shape, self.count), dtype=np.int64))

    def points(self) -> Points:
        """Points at which every step has a value."""
        values = []
        for i in range(len(self.program.steps)):
            values.append(self.value(i))
            if self.program.begins:  # in order: asked for at the end of a long sum, it would nest
                self.tangent(i)
        stacked = np.array(values, np.int64).reshape(len(values), self.count)
        kept = self.good
        return Points(self.x[:, kept].T, self.u[:, kept].T, stacked[:, kept])

    # -- one step ------------------------------------------------------------------------------

    def value(self, i: int) -> Residues:
        if i not in self._values:
            step = self.program.steps[i]
            if step.do == "path":
                self._begin(self.program.begins[i])
            else:
                self._values[i] = self._computed(i)
        return self._values[i]

    def _computed(self, i: int) -> Residues:
        step = self.program.steps[i]
        if step.do == "constant":
            assert step.constant is not None
            return np.full(self.count, residue(step.constant))
        if step.do == "pi":
            return np.full(self.count, int(self.rng.integers(1, PRIME)))
        if step.do in ("state", "input"):
            return np.asarray((self.x if step.do == "state" else self.u)[step.index])
        a, b = (self.value(k) for k in step.operands)
        if step.do == "div":
            self.good &= b != 0
            return a * inverse(b) % PRIME
        found = {"add": a + b, "sub": a - b, "mul": a * b}[step.do]
        return np.asarray(found % PRIME)

    def tangent(self, i: int) -> Residues:
        """How a step changes along the random direction of each point."""
        if i not in self._tangents:
            self._tangents[i] = self._turned(i)
        return self._tangents[i]

    def _turned(self, i: int) -> Residues:
        step = self.program.steps[i]
        if step.do in ("constant", "pi"):
            return np.zeros(self.count, np.int64)
        if step.do in ("state", "input"):
            return np.asarray((self.dx if step.do == "state" else self.du)[step.index])
        a, b = step.operands
        if step.do == "path":
            return self.value(a) * self.tangent(b) % PRIME
        da, db = self.tangent(a), self.tangent(b)
        if step.do == "mul":
            return (self.value(a) * db % PRIME + da * self.value(b)) % PRIME
        if step.do == "div":
            rest = da - self.value(i) * db % PRIME
            return rest % PRIME * inverse(self.value(b)) % PRIME
        return (da + db if step.do == "add" else da - db) % PRIME

    # -- where paths begin ---------------------------------------------------------------------

    def _begin(self, begin: Begin) -> None:
        group = "circle" if begin.kind in ("circle", "angle") else "real"
        tangent = self._exponent_tangent(begin)
        if not np.any(tangent[self.good]):
            raise Inexact(f"{begin.kind} of what does not vary")
        if begin.kind == "root":
            self._begin_roots(begin.paths[0], begin.of, tangent)
            return
        own = [k for k, b in enumerate(self.basis) if b.group == group]
        shares = self._shares([self.basis[k].tangent for k in own], tangent)
        if begin.kind in ("log", "angle"):
            if shares is not None:
                raise Inexact("one logarithm or angle is a combination of others")
            found, e = self.random(), tuple(self.value(k) for k in begin.of)
            self._values[begin.paths[0]] = found
            self.basis.append(_Basis(begin, group, found, e, tangent))
        elif shares is not None:
            self._keep(begin, self._combined(begin, group, dict(zip(own, shares, strict=True))))
        else:
            self._begin_free(begin, group, tangent)

    def _exponent_tangent(self, begin: Begin) -> Residues:
        """The tangent of the exponent l, where e = exp(l) is given or l itself."""
        d = [self.tangent(k) for k in begin.of]
        if begin.kind in ("exp", "circle"):
            return d[0]
        v = self.value(begin.of[-1])
        if begin.kind == "angle":  # that of v/1
            return d[1] * inverse((1 + v * v % PRIME) % PRIME) % PRIME
        return d[0] * inverse(v) % PRIME

    def _shares(self, basis: Sequence[Residues], tangent: Residues) -> list[Fraction] | None:
        """Rational shares of other tangents in one; None: it is independent of them.

        The others stay independent also with irrational shares, so that these are the only ones.
        """
        where = np.flatnonzero(self.good)[: 2 * len(basis) + 8]
        columns = np.array([b[where] for b in basis] + [tangent[where]])
        null = spanned(columns.T).null()
        if not null.size:
            return None
        shares = [fraction(int(-value % PRIME)) for value in null[:-1, 0]]
        rational = [s for s in shares if s is not None]
        if len(rational) < len(shares):
            raise Inexact("exponents or roots are in no simple proportion")
        return rational

    def _begin_roots(self, path: int, of: tuple[int, ...], tangent: Residues) -> None:
        """All constant powers of one value, from one root of it."""
        alike = [b for b in self.program.begins.values() if b.kind == "root" and b.of == of]
        degree = lcm(*(b.exponent.denominator for b in alike)) * self.scales.get(path, 1)
        found = self._rooted(path, self.value(of[0]), tangent, degree)
        for b in alike:
            self._values[b.paths[0]] = power(found, int(b.exponent * degree))

    def _rooted(self, path: int, v: Residues, tangent: Residues, degree: int) -> Residues:
        """A root of v; which of them does not matter while it is independent of all others."""
        self.good &= v != 0
        others: list[_Root | _Basis] = [b for b in self.basis if b.begin.kind == "exp"]
        others += self.roots
        shares = self._shares([b.tangent for b in others], tangent)
        if shares is not None:
            return self._dependent(v, degree, dict(zip(others, shares, strict=True)))
        found, exists = root(v, degree)
        if degree % 2 == 0 and exists[self.good].all():
            raise Inexact("the root of a square may have either sign")
        self.good &= exists
        self.roots.append(_Root(path, found, tangent * pow(degree, -1, PRIME) % PRIME))
        return found

    def _dependent(
        self, v: Residues, degree: int, shares: Mapping[_Root | _Basis, Fraction]
    ) -> Residues:
        """The root of a constant times powers of others: made of their roots."""
        found = np.ones(self.count, np.int64)
        for other, share in shares.items():
            if (share / degree).denominator != 1:
                raise _Halved(other.path, (share / degree).denominator)
            found = found * power(other.e[0], int(share / degree)) % PRIME
        rest = v * inverse(power(found, degree)) % PRIME
        left = {fraction(int(value)) for value in rest[self.good][:4]}
        number = left.pop()
        if left or number is None or number < 0:
            raise Inexact("roots differ by a constant that is no simple fraction")
        return found * _root_of(number, degree) % PRIME

    def _begin_free(self, begin: Begin, group: str, tangent: Residues) -> None:
        scale = self.scales.get(begin.paths[0], 1)
        part = pow(scale, -1, PRIME)
        free = self.random()
        e: tuple[Residues, ...] = turn(free) if group == "circle" else (free,)
        w = self.value(begin.of[0]) * part % PRIME
        self.basis.append(_Basis(begin, group, w, e, tangent * part % PRIME))
        self._keep(begin, multiple(e, scale))

    def _keep(self, begin: Begin, e: Sequence[Residues]) -> None:
        self._values.update(zip(begin.paths, e, strict=True))

    def _combined(
        self, begin: Begin, group: str, shares: dict[int, Fraction]
    ) -> tuple[Residues, ...]:
        """exp of a combination of exponents, from those of the basis."""
        one = np.ones(self.count, np.int64)
        rest = self.value(begin.of[0])
        e: tuple[Residues, ...] = (one, 0 * one) if group == "circle" else (one,)
        for k, share in shares.items():
            of = self.basis[k]
            if share.denominator != 1:
                if of.begin.kind in ("log", "angle"):
                    raise Inexact("an exponent is a fraction of a logarithm or an angle")
                raise _Halved(of.path, share.denominator)
            if share:
                e = times(e, multiple(self._of(of), share.numerator))
                rest = (rest - share.numerator * of.exponent) % PRIME
        return times(e, self._of_constant(rest, group))

    def _of(self, basis: _Basis) -> tuple[Residues, ...]:
        """exp(l): of an angle, the cosine and sine that it has."""
        if basis.begin.kind != "angle":
            return basis.e
        v = basis.e[1]
        square = (1 + v * v % PRIME) % PRIME
        growth = 2 * v * self.tangent(basis.begin.of[1]) % PRIME * inverse(square) % PRIME
        cos = inverse(self._rooted(basis.path, square, growth, 2))
        return cos, v * cos % PRIME

    def _of_constant(self, rest: Residues, group: str) -> tuple[Residues, ...]:
        """exp of what is left, the same number at all points: free unless it is 0."""
        left = {fraction(int(value)) for value in rest[self.good][:4]}
        number = left.pop()
        if left or number is None or (number and self._constants and number not in self._constants):
            raise Inexact("exponents differ by constants")
        one = np.ones(self.count, np.int64)
        if not number:
            return (one, 0 * one) if group == "circle" else (one,)
        free = one * int(self.rng.integers(1, PRIME))
        if number not in self._constants:
            self._constants[number] = turn(free) if group == "circle" else (free,)
        if len(self._constants[number]) != (2 if group == "circle" else 1):
            raise Inexact("exponents differ by constants")
        return self._constants[number]


def _root_of(number: Fraction, degree: int) -> int:
    """The positive root of a fraction where it is one, else any residue that is a root."""
    parts = [round(part ** (1 / degree)) for part in (number.numerator, number.denominator)]
    if Fraction(*parts) ** degree == number:
        return residue(Fraction(*parts))
    found, exists = root(np.array([residue(number)]), degree)
    if not exists[0]:
        raise Inexact(f"{number} has no root of degree {degree} modulo the prime")
    return int(found[0])
