"""What exponentials of sums are made of: products of numbers, and of turns (cosine and sine)."""

from __future__ import annotations

from collections.abc import Sequence

from casest.dynamics.structural.field import PRIME, Residues, inverse, power


def turn(t: Residues) -> tuple[Residues, Residues]:
    """A point of the circle: cosine and sine of an angle with the tangent of its half t."""
    square = t * t % PRIME
    under = inverse((1 + square) % PRIME)
    return (1 - square) % PRIME * under % PRIME, 2 * t * under % PRIME


def times(a: Sequence[Residues], b: Sequence[Residues]) -> tuple[Residues, ...]:
    """exp(l) of a sum of exponents: product of numbers, or of turns."""
    if len(a) == 1:
        return (a[0] * b[0] % PRIME,)
    cos = (a[0] * b[0] % PRIME - a[1] * b[1] % PRIME) % PRIME
    return cos, (a[0] * b[1] % PRIME + a[1] * b[0] % PRIME) % PRIME


def multiple(e: Sequence[Residues], exponent: int) -> tuple[Residues, ...]:
    """exp(l) of a whole multiple of an exponent."""
    if len(e) == 1:
        return (power(e[0], exponent),)
    base = (e[0], e[1] if exponent > 0 else -e[1] % PRIME)
    found: tuple[Residues, ...] = base
    for _ in range(abs(exponent) - 1):
        found = times(found, base)
    return found
