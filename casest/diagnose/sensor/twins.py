"""Bends that are one: beside the declared unknowns each does what the other does.

Where all inputs have one sign |u| is u; a square of a polynomial's square is its cube.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.linear import Linear

#: Share of its length that may tell a bend's columns from another's: rounding, and an offset of the
#: sensor at nothing, by which inputs of one sign are a little of the other.
ROUNDING = 1e-3


def twins(linear: Linear, several: Iterable[tuple[Candidate, Array]]) -> dict[str, str]:
    """Labels of bends, given in their columns (N, m, p), with the one whose columns they have: a
    constant of the model, which has a name there, or an earlier one of the catalogue.

    What the unknowns do themselves is none: it stays invisible, under each of its names.
    """
    first: list[tuple[str, Array, Array]] = []
    found = {}
    for candidate, columns in sorted(several, key=lambda one: not one[0].freed):
        basis = _beside(linear, columns)
        alike = (label for label, own, its in first
                 if own.shape == columns.shape and _same(its, basis))  # fmt: skip
        label = next(alike, "")
        if label and not candidate.freed:
            found[candidate.label] = label
        elif basis.size:
            first.append((candidate.label, columns, basis))
    return found


def bend(candidate: Candidate) -> bool:
    """Is it a constant, or acts on what the sensor reads or gives and on nothing that is recorded
    or remembered?"""
    effect = candidate.effect
    if effect is None:
        return True
    return effect.kind == "quantity" and not (candidate.columns or effect.extras or effect.profile)


def _beside(linear: Linear, columns: Array) -> Array:
    """Orthonormal columns (N·m, k) of what the unknowns leave."""
    X = columns.reshape(linear.residual.size, -1)
    X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    X = X - linear.basis @ (linear.basis.T @ X)
    U, s, _ = np.linalg.svd(X, full_matrices=False)
    return np.asarray(U[:, s > linear.least])


def _same(one: Array, other: Array) -> bool:
    if one.shape != other.shape:
        return False
    return bool(np.linalg.norm(other - one @ (one.T @ other)) < ROUNDING)
