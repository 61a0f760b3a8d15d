"""What the data could not determine: null directions in words, and weak ones with their cost.

The Jacobian's columns are scaled to unit length, so that ranks do not depend on units. A null
direction changes no residual at all; a weak one is determined, but `inflation` times worse than
its parameters would be alone (the root of the variance inflation factor).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.null_space import sparsest
from casest.leastsquares.problem import Point, Problem

#: Below this singular value (relative to the largest, unit columns) a direction is null. Rounding
#: leaves about 1e-15; real but poor motion stays above 1e-8.
NULL = 1e-10
#: From this inflation on a direction is called weak.
WEAK = 10.0


@dataclass(frozen=True)
class Weak:
    """A combination of parameters that the data determine poorly."""

    words: str
    inflation: float
    std: float
    unit: str


@dataclass(frozen=True)
class Identifiability:
    """Rank of the Jacobian among the unknowns, and what it lacks.

    `null` (n, k) is an orthonormal basis of the null space in the unknowns (unscaled); `touched`
    marks the unknowns that it moves; `least` (n,) is the direction of the smallest singular value,
    of columns of unit length, and `weakest` describes it.
    """

    rank: int
    unknowns: int
    singular_values: Array
    null: Array
    unobservable: tuple[str, ...]
    touched: Array
    least: Array
    weakest: str


def rank(R: Array) -> int:
    """How many directions a triangular factor (n, n) tells, its columns scaled to unit length."""
    norms = np.linalg.norm(R, axis=0)
    scaled = R / np.where(norms > 0, norms, 1.0)
    return _told(np.asarray(np.linalg.svd(scaled, compute_uv=False)))


def _told(singular: Array) -> int:
    largest = singular.max(initial=0.0)
    # A zero column keeps norm zero: its unit vector is a null direction as it stands.
    return int(np.sum(singular > NULL * largest)) if largest > 0 else 0


def identify(problem: Problem, point: Point, R: Array | None = None) -> Identifiability:
    """Rank and null directions, named, at a point."""
    R = problem.factor(point)[0] if R is None else R
    norms = np.linalg.norm(R, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    _, singular, Vt = np.linalg.svd(R / scale)
    rank = _told(singular)
    null = Vt[rank:].T
    words = tuple(_null_words(problem, point, null, scale))
    unscaled = null / scale[:, None]
    norms = np.linalg.norm(unscaled, axis=0)
    touched = np.linalg.norm(null, axis=1) > 1e-6
    for slot in problem.slots:
        # A rotation moves some entries of a matrix only to second order: they are not known either.
        if len(slot.parameter.shape.dims) == 2 and touched[slot.x].any():
            touched[slot.x] = True
    basis = unscaled / np.where(norms > 0, norms, 1)
    weakest = _combination(problem, Vt[-1], scale)
    return Identifiability(rank, problem.unknowns, singular, basis, words, touched, Vt[-1], weakest)


def _null_words(problem: Problem, point: Point, null: Array, scale: Array) -> Iterator[str]:
    """A sentence per null direction, rotations of a matrix first."""
    left = null
    for words, direction in _rotations(problem, point):
        candidate = direction * scale
        candidate = candidate / np.linalg.norm(candidate)
        inside = np.linalg.norm(null @ (null.T @ candidate) - candidate) < 1e-5
        new = left @ (left.T @ candidate)
        if inside and np.linalg.norm(new) > 1e-3:
            yield words
            left = _without(left, new / np.linalg.norm(new))
    for k in range(left.shape[1]):
        yield _combination(problem, sparsest(left)[:, k], scale)


def _rotations(problem: Problem, point: Point) -> Iterator[tuple[str, Array]]:
    """Small rotations from the left of every square matrix among the parameters."""
    for slot in problem.slots:
        shape = slot.parameter.shape
        if shape.kind != "array" or shape.dims != (3, 3):
            continue
        matrix = shape.unpack(point.x[slot.x])
        for axis, name in enumerate("xyz"):
            turn = np.cross(np.eye(3)[axis], matrix.T).T
            direction = np.zeros(problem.unknowns)
            direction[slot.x] = shape.pack(turn)
            yield (
                f"a rotation of the sensor frame about {name}: turning `{slot.parameter.name}` "
                "from the left changes no residual; declare it triangular, or give directions",
                direction,
            )


def _without(basis: Array, direction: Array) -> Array:
    """Orthonormal basis of the part of a space orthogonal to one of its directions."""
    rest = basis - np.outer(direction, direction @ basis)
    u, _, _ = np.linalg.svd(rest, full_matrices=False)
    return u[:, : basis.shape[1] - 1] if basis.shape[1] > 1 else u[:, :0]


def _combination(problem: Problem, scaled: Array, scale: Array) -> str:
    """The unknowns that move together, the largest movers first, in their own units."""
    # Those that move alike in the model's order, whatever their last digits.
    order = np.argsort(-np.abs(scaled).round(9), kind="stable")
    movers = [int(i) for i in order if abs(scaled[i]) > 0.02]
    names = [problem.names[i] for i in movers]
    if len(movers) == 1:
        return f"`{names[0]}` changes no residual{_where(problem, movers[0])}"
    change = scaled[movers] / scale[movers]
    change = change / change[0]
    ratio = ", ".join(f"{n} {c:+.3g}" for n, c in zip(names[1:], change[1:], strict=True))
    together = " and ".join([", ".join(f"`{n}`" for n in names[:-1]), f"`{names[-1]}`"])
    return f"{together} cannot be told apart ({names[0]} +1 goes with {ratio})"


def _where(problem: Problem, mover: int) -> str:
    """Does an unknown (by number) do nothing at all, or only where the fit has ended?"""
    with np.errstate(all="ignore"):
        begun = problem.normal(problem.start()).matrix[mover, mover]
    if np.isfinite(begun) and begun > 0:
        return (
            " at the best fit, though it does where the fit begins: the model fits these data best "
            "where it is none; check what is set, columns and units, or record more that differs"
        )
    return ": these data do not contain it"


def weak_directions(problem: Problem, R: Array, sigma: float, rank: int) -> tuple[Weak, ...]:
    """Directions, null ones aside, whose parameters are `WEAK` times worse than each alone."""
    norms = np.linalg.norm(R, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    _, singular, Vt = np.linalg.svd(R / scale)
    found = []
    for k in range(rank - 1, -1, -1):
        inflation = 1.0 / singular[k]
        if inflation < WEAK:
            break
        direction = Vt[k]
        movers = [int(i) for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.1][:6]
        first = movers[0]
        change = direction[movers] / scale[movers] * np.sign(direction[first])
        std = sigma * inflation * abs(direction[first]) / scale[first]
        ratios = change / change[0]
        together = ", ".join(
            f"{problem.names[i]} {c * std:+.2g}" for i, c in zip(movers, ratios, strict=True)
        )
        found.append(Weak(together, float(inflation), float(std), problem.units[first]))
    return tuple(found)
