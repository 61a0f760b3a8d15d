"""Functions of unknowns that are known though the unknowns are not: sums, products, polynomials.

A function φ is determined, locally, if and only if no hidden direction changes it: ∇φ·N = 0 at
every point. For a sum of given terms with unknown coefficients these are linear equations, and
enough points give all such functions and no other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations_with_replacement
from math import gcd, lcm

import numpy as np

from casest.dynamics.structural.field import PRIME, Echelon, Residues, fraction, inverse, spanned

#: Terms of a polynomial that are tried at once: that many equations cost that many points.
TERMS = 60

#: Orders of the terms in which short functions are looked for.
ORDERS = 12

#: Coefficients and powers of what is called a short formula.
LARGEST = 6


@dataclass(frozen=True)
class Combinations:
    """Functions that are determined, independent of each other; `more` are others, without a
    formula that was found."""

    formulas: tuple[str, ...]
    more: int


@dataclass(frozen=True)
class Group:
    """Unknowns that are tied together: `touched`, by `hidden` directions."""

    touched: tuple[int, ...]
    hidden: tuple[int, ...]


def groups(basis: Residues) -> list[Group]:
    """Unknowns that hidden directions (n, k) tie together, apart from each other."""
    found: list[Group] = []
    for k in range(basis.shape[1]):
        touched, hidden = set(np.flatnonzero(basis[:, k]).tolist()), {k}
        apart = []
        for group in found:
            if touched & set(group.touched):
                touched |= set(group.touched)
                hidden |= set(group.hidden)
            else:
                apart.append(group)
        found = [*apart, Group(tuple(sorted(touched)), tuple(sorted(hidden)))]
    return found


@dataclass(frozen=True)
class _Found:
    """A function and its gradient by the group's unknowns at one point."""

    formula: str
    gradient: Residues
    length: tuple[int, int]


#: Points and bases of hidden directions there: states (count, n), nulls (count, n, k).
Sampled = Callable[[int], tuple[Residues, Residues]]


def combinations(
    group: Group, names: Sequence[str], settled: Sequence[int], sampled: Sampled
) -> Combinations:
    """What is known of a group of unknowns. `settled` are unknowns that are determined."""
    wanted = len(group.touched) - len(group.hidden)
    independent, chosen = Echelon(len(group.touched)), list[str]()
    for search in (_sums, _products, _polynomials):
        if len(chosen) == wanted:
            break
        found = search(group, names, settled, sampled)
        for one in sorted(found, key=lambda f: f.length):
            if independent.add(one.gradient):
                chosen.append(one.formula)
    return Combinations(tuple(chosen), wanted - len(chosen))


def _sums(
    group: Group, names: Sequence[str], settled: Sequence[int], sampled: Sampled
) -> Iterator[_Found]:
    """Σ cᵢ·xᵢ."""
    own = list(group.touched)
    _, nulls = sampled(_enough(len(own), group))
    equations = nulls[:, own][:, :, list(group.hidden)]
    for c in _solutions(equations):
        formula = _sum([names[i] for i in own], c)
        yield _Found(formula, np.array(c) % PRIME, (sum(map(bool, c)), sum(map(abs, c))))


def _products(
    group: Group, names: Sequence[str], settled: Sequence[int], sampled: Sampled
) -> Iterator[_Found]:
    """Π xᵢ to the power cᵢ."""
    own = list(group.touched)
    states, nulls = sampled(_enough(len(own), group))
    over = inverse(states[:, own])
    equations = nulls[:, own][:, :, list(group.hidden)] * over[:, :, None] % PRIME
    for c in _solutions(equations):
        gradient = np.array(c) * over[0] % PRIME
        length = (sum(map(bool, c)), sum(map(abs, c)))
        yield _Found(_product([names[i] for i in own], c), gradient, length)


def _polynomials(
    group: Group, names: Sequence[str], settled: Sequence[int], sampled: Sampled
) -> Iterator[_Found]:
    """Sums of unknowns and of products of two, one of which may be determined."""
    own = list(group.touched)
    terms: list[tuple[int, ...]] = [(i,) for i in own]
    terms += list(combinations_with_replacement(own, 2))
    if len(terms) > TERMS:
        return
    mixed = [(i, j) for j in settled for i in own]
    terms += mixed if len(terms) + len(mixed) <= TERMS else []
    states, nulls = sampled(_enough(len(terms), group))
    slopes = np.array([_slope(t, states, own) for t in terms])  # (terms, points, own)
    of = nulls[:, own][:, :, list(group.hidden)]
    products = [slopes[:, :, i, None] * of[:, i] % PRIME for i in range(len(own))]
    equations = np.moveaxis(sum(products[1:], products[0]) % PRIME, 0, 1)
    labels = [_product(names, [t.count(i) for i in range(len(names))]) for t in terms]
    for c in _solutions(equations):
        gradient = (np.array(c)[:, None] % PRIME * slopes[:, 0] % PRIME).sum(axis=0) % PRIME
        size = sum(len(t) for t, own_c in zip(terms, c, strict=True) if own_c)
        yield _Found(_sum(labels, c), gradient, (size, sum(map(abs, c))))


def _slope(term: tuple[int, ...], states: Residues, own: Sequence[int]) -> Residues:
    """∂ of a product of one or two unknowns by the group's, (points, own)."""
    found = np.zeros((len(states), len(own)), np.int64)
    for place, i in enumerate(own):
        for k, factor in enumerate(term):
            if factor == i:
                rest = [states[:, j] for q, j in enumerate(term) if q != k]
                found[:, place] += rest[0] if rest else 1
    return found % PRIME


def _enough(terms: int, group: Group) -> int:
    """Points that make more equations than there are terms: no function fits them by chance."""
    return -(-terms // len(group.hidden)) + 3


def _solutions(equations: Residues) -> Iterator[list[int]]:
    """Short whole coefficients c with Σ cᵢ·equations[:, i] = 0, (points, terms, k)."""
    terms = equations.shape[1]
    null = spanned(np.moveaxis(equations, 1, 2).reshape(-1, terms)).null()
    rng, seen = np.random.default_rng(0), set[tuple[int, ...]]()
    orders = [range(terms), range(terms - 1, -1, -1)]
    for order in [*orders, *(rng.permutation(terms) for _ in range(ORDERS))] if null.size else []:
        rows = spanned(null[list(order)].T).rows[:, np.argsort(list(order))]
        for row in rows:
            c = _whole([fraction(int(v)) for v in row])
            if c and max(map(abs, c)) <= LARGEST and tuple(c) not in seen:
                seen.add(tuple(c))
                yield c


def _whole(values: Sequence[Fraction | None]) -> list[int] | None:
    """The same as whole numbers without a common factor, the first one positive."""
    numbers = [v for v in values if v is not None]
    if len(numbers) < len(values):
        return None
    under = lcm(*(v.denominator for v in numbers))
    found = [int(v * under) for v in numbers]
    first = next(v for v in found if v)
    return [v // (gcd(*found) * (1 if first > 0 else -1)) for v in found]


def _sum(labels: Sequence[str], c: Sequence[int]) -> str:
    words = ""
    for label, k in zip(labels, c, strict=True):
        if k:
            sign = ("- " if k < 0 else "+ ") if words else ("-" if k < 0 else "")
            words += (" " if words else "") + sign + ("" if abs(k) == 1 else f"{abs(k)}*") + label
    return words


def _product(labels: Sequence[str], c: Sequence[int]) -> str:
    def factors(sign: int) -> list[str]:
        return [n if k * sign == 1 else f"{n}^{k * sign}"
                for n, k in zip(labels, c, strict=True) if k * sign > 0]  # fmt: skip

    above, below = factors(1), factors(-1)
    under = "*".join(below) if len(below) < 2 else f"({'*'.join(below)})"
    return "*".join(above) + (f"/{under}" if below else "")
