"""Arithmetic modulo a prime: exact, so that a rank needs no threshold."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

#: Residues, from 0 to PRIME - 1.
Residues = NDArray[np.int64]

#: The largest prime below 2³¹ of the form 2q + 1 with q prime: products of two residues fit into
#: 64 bits, and of every residue there is just one root of any odd degree.
PRIME = 2147483579

#: A fraction is believed of a residue if numerator and denominator are at most this: of all
#: residues one in a thousand is such a fraction by chance, and it must be so at every point.
SMALL = 1000


def power(base: Residues, exponent: int) -> Residues:
    """`base` to a whole power, entry by entry; 0 to a negative power is 0."""
    exponent %= PRIME - 1
    found, square = np.ones_like(base), base.copy()
    while exponent:
        if exponent & 1:
            found = found * square % PRIME
        square = square * square % PRIME
        exponent >>= 1
    return found


def inverse(a: Residues) -> Residues:
    """1/a, entry by entry; 0 where a is 0."""
    return power(a, PRIME - 2)


def root(a: Residues, degree: int) -> tuple[Residues, NDArray[np.bool_]]:
    """A root of that degree, entry by entry, and where there is one."""
    exists = np.ones(a.shape, bool)
    while degree % 2 == 0:
        # PRIME = 3 (mod 4), so that this is a root of `a` or of -a, and itself a square.
        half = power(a, (PRIME + 1) // 4)
        exists &= half * half % PRIME == a
        a, degree = half, degree // 2
    return power(a, pow(degree, -1, PRIME - 1)), exists


def residue(number: Fraction) -> int:
    """A fraction as a residue."""
    return number.numerator * pow(number.denominator, -1, PRIME) % PRIME


def fraction(value: int) -> Fraction | None:
    """The one small fraction that a residue is, if it is one (Wang 1981)."""
    before, now, factor, other = PRIME, int(value) % PRIME, 0, 1
    while now > SMALL:
        quotient = before // now
        before, now = now, before - quotient * now
        factor, other = other, factor - quotient * other
    if not 0 < abs(other) <= SMALL:
        return None
    return Fraction(now, other)


class Echelon:
    """Rows in reduced echelon form, to which more are added; `pivots` are their leading columns."""

    def __init__(self, columns: int) -> None:
        self.rows: Residues = np.zeros((0, columns), np.int64)
        self.pivots: list[int] = []

    @property
    def rank(self) -> int:
        """How many independent rows there are."""
        return len(self.pivots)

    def reduced(self, row: Residues) -> Residues:
        """What is left of a row when those that are there are taken off; 0: it depends on them."""
        if not self.pivots:
            return row
        off = (row[self.pivots][:, None] * self.rows % PRIME).sum(axis=0)
        return np.asarray((row - off) % PRIME)

    def add(self, row: Residues) -> bool:
        """Take a row in, and say whether it was independent of those before."""
        left = self.reduced(row)
        where = np.flatnonzero(left)
        if not where.size:
            return False
        pivot = int(where[0])
        left = left * pow(int(left[pivot]), -1, PRIME) % PRIME
        self.rows = (self.rows - self.rows[:, pivot : pivot + 1] * left) % PRIME
        self.rows = np.vstack([self.rows, left])
        self.pivots.append(pivot)
        return True

    def null(self) -> Residues:
        """Basis (columns, k) of what every row is orthogonal to, the identity on its free rows."""
        size = self.rows.shape[1]
        free = [i for i in range(size) if i not in self.pivots]
        found = np.zeros((size, len(free)), np.int64)
        found[free, range(len(free))] = 1
        found[self.pivots] = -self.rows[:, free] % PRIME
        return found


def spanned(rows: Residues) -> Echelon:
    """Echelon form of rows (m, n)."""
    found = Echelon(rows.shape[1])
    for row in rows:
        found.add(row)
        if found.rank == rows.shape[1]:
            break
    return found
