"""What hidden directions have in common at several points: shifts, scalings, inputs they follow."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction

import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.structural.field import PRIME, Residues, fraction, inverse, spanned
from casest.dynamics.structural.words import Hidden


def sparse(nulls: Sequence[Residues]) -> Residues:
    """Bases (points, n, k) of the same directions at several points, few states in each."""
    n = nulls[0].shape[0]
    rng = np.random.default_rng(0)
    best, least = None, n * nulls[0].shape[1] + 1
    for order in [range(n), range(n - 1, -1, -1), *(rng.permutation(n) for _ in range(8))]:
        found = [_echelon(null, list(order)) for null in nulls]
        terms = int(np.count_nonzero(found[0]))
        if terms < least:
            best, least = np.array(found), terms
    assert best is not None
    return best


def _echelon(null: Residues, order: Sequence[int]) -> Residues:
    """The reduced echelon form of a basis (n, k), for states in some order."""
    found = spanned(null[order].T)
    rows = found.rows[np.argsort(found.pivots)]
    return np.asarray(rows[:, np.argsort(order)].T)


def laws(
    model: Dynamics, bases: Residues, states: Residues, vectors: Mapping[str, Residues]
) -> Iterator[Hidden]:
    """The law of each direction of `bases` (points, n, k).

    `states` (points, n) are those of the points, `vectors` (points, 3) their inputs of that size.
    """
    for directions in np.moveaxis(bases, 2, 0):
        touched = tuple(np.flatnonzero(directions.any(axis=0)).tolist())
        along = _along(model, directions, touched, vectors)
        shift = None if along else _constant(directions)
        powers = None
        if not along and shift is None:
            first = touched[0]
            growth = directions * inverse(states) % PRIME * states[:, [first]] % PRIME
            scaled = inverse(directions[:, [first]]) * growth % PRIME
            powers = _constant(scaled[:, list(touched)])
        yield Hidden(touched, along, shift, powers)


def _along(
    model: Dynamics,
    directions: Residues,
    touched: Sequence[int],
    vectors: Mapping[str, Residues],
) -> str | None:
    """The input that a direction follows: gravity and bias along the rate of turn."""
    own = [w for w in model.slices().values() if any(w.start <= i < w.stop for i in touched)]
    if any(w.stop - w.start != 3 for w in own):
        return None
    for name, vector in vectors.items():
        if all(not _cross(directions[:, w], vector).any() for w in own):
            return name
    return None


def _cross(a: Residues, b: Residues) -> Residues:
    left, right = a[:, [1, 2, 0]] * b[:, [2, 0, 1]], a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
    return np.asarray((left % PRIME - right % PRIME) % PRIME)


def _constant(values: Residues) -> Array | None:
    """Fractions that are the same at all points, as numbers; None: they are not."""
    if (values != values[0]).any():
        return None
    found: list[Fraction | None] = [fraction(int(v)) for v in values[0]]
    numbers = [f for f in found if f is not None]
    return np.array(numbers, float) if len(numbers) == len(found) else None
