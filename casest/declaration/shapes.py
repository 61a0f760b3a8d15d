"""The forms a parameter's value can take, and the coordinates in which a solver moves it.

Most forms are plain arrays: the coordinates are the entries. A unit vector is a point on the
sphere and a rotation a point of SO(3): a solver moves those in a chart around a reference value
(stereographic, Cayley), which has no pole and no redundant coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from casest.errors import DeclarationError

Array = NDArray[np.float64]
Kind = Literal["array", "lower", "unit", "rotation", "each"]


def in_words(dims: tuple[int, ...]) -> str:
    """One number, a list of 3, a 3 by 3 matrix."""
    if len(dims) < 2:
        return f"a list of {dims[0]}" if dims else "one number"
    return f"a {' by '.join(map(str, dims))} matrix"


def _example(dims: tuple[int, ...]) -> str:
    """How a list or matrix is written, in brackets."""
    if len(dims) < 2:
        return f" ({','.join(str(k + 1) for k in range(dims[0]))})" if dims else ""
    rows = np.eye(dims[0], dims[-1])
    return f" ({';'.join(','.join(f'{x:g}' for x in row) for row in rows)})"


@dataclass(frozen=True)
class Shape:
    """Form of a parameter: `dims` is the shape of its value, `kind` its structure."""

    kind: Kind
    dims: tuple[int, ...]
    positive_diagonal: bool = False

    @cached_property
    def entries(self) -> tuple[tuple[int, ...], ...]:
        """Index of every stored entry, in order (a triangular matrix stores no zeros)."""
        indices = [tuple(int(k) for k in i) for i in np.ndindex(*self.dims)]
        if self.kind == "lower":
            indices = [i for i in indices if i[0] >= i[1]]
        return tuple(indices)

    @property
    def size(self) -> int:
        """Number of stored entries."""
        return len(self.entries)

    @property
    def coordinates(self) -> int:
        """Number of coordinates a solver moves (2 on the sphere, 3 for a rotation)."""
        return {"unit": 2, "rotation": 3}.get(self.kind, self.size)

    @property
    def curved(self) -> bool:
        """True where the value lives on a curved set and needs a chart."""
        return self.kind in ("unit", "rotation")

    def pack(self, value: Any) -> Array:
        """Stored entries (size,) of a value of shape `dims`."""
        array = np.asarray(value, dtype=float)
        square = len(self.dims) == 2 and self.dims[0] == self.dims[1]
        if array.ndim == 0 and self.dims:
            array = float(array) * np.eye(self.dims[0]) if square else np.full(self.dims, array)
        elif array.ndim == 1 and square and self.dims[0] == array.size:
            array = np.diag(array)
        if array.shape != self.dims:
            raise DeclarationError(
                f"it takes {in_words(self.dims)}{_example(self.dims)}, and "
                f"{in_words(array.shape)} is given"
            )
        if self.kind == "lower" and np.any(np.triu(array, 1)):
            raise DeclarationError("a lower triangular value must have zeros above its diagonal")
        array = self._on_the_set(array)
        return np.array([array[i] for i in self.entries], dtype=float)

    def _on_the_set(self, array: Array) -> Array:
        """A direction of length one, an orthonormal rotation; refused where far from it."""
        if self.kind == "unit":
            length = float(np.linalg.norm(array))
            if not abs(length - 1) <= 0.01:
                raise DeclarationError(
                    f"a direction has length 1, and {array.tolist()} has {length:.4g}"
                )
            return array / length
        if self.kind == "rotation":
            away = float(np.abs(array.T @ array - np.eye(3)).max())
            if not (away <= 0.01 and np.linalg.det(array) > 0):
                raise DeclarationError(
                    f"a rotation matrix has orthonormal columns and determinant 1; this one is off "
                    f"by {away:.4g}"
                )
            return self.reference(array).reshape(3, 3)
        return array

    def spread(self, value: Any) -> Array:
        """Stored entries of a bound: a number stands for all entries alike."""
        array = np.asarray(value, dtype=float)
        try:
            array = np.broadcast_to(array, self.dims)
        except ValueError:
            raise DeclarationError(
                f"a bound of shape {array.shape} does not fit shape {self.dims}"
            ) from None
        return np.array([array[i] for i in self.entries], dtype=float)

    def unpack(self, entries: Array) -> Array:
        """Value of shape `dims` from its stored entries."""
        value = np.zeros(self.dims)
        for index, entry in zip(self.entries, entries, strict=True):
            value[index] = entry
        return value

    def default(self) -> Array:
        """Neutral value: identity for square matrices and rotations, north for directions."""
        if self.kind == "unit":
            return np.array([0.0, 0.0, 1.0])
        if len(self.dims) == 2 and self.dims[0] == self.dims[1]:
            return np.eye(self.dims[0])
        return np.zeros(self.dims)

    def reference(self, value: Array) -> Array:
        """Numbers that describe the chart around `value`: the point itself, for a direction
        followed by an orthonormal basis of its tangent plane. Empty for plain arrays."""
        if self.kind == "unit":
            point = np.asarray(value, dtype=float)
            point = point / np.linalg.norm(point)
            # Rows 2 and 3 of Vᵀ complete the point to an orthonormal frame.
            basis = np.linalg.svd(point[None, :])[2][1:]
            return np.concatenate([point, basis[0], basis[1]])
        if self.kind == "rotation":
            u, _, vt = np.linalg.svd(np.asarray(value, dtype=float))
            return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).ravel()
        return np.zeros(0)

    def tangent(self, value: Array, reference: Array) -> Array:
        """Coordinates of a value near the reference, to first order: angles in rad."""
        if self.kind == "unit":
            return np.asarray(reference[3:].reshape(2, 3) @ value)
        turn = reference.reshape(3, 3).T @ value
        skew = 0.5 * (turn - turn.T)
        return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])

    def at_reference(self, reference: Array) -> Array:
        """The value in the middle of the chart that the reference describes."""
        return reference[:3] if self.kind == "unit" else reference.reshape(3, 3)

    def entry_names(self, name: str) -> tuple[str, ...]:
        """Names such as `gain[2]` or `scale[1,0]`, one per stored entry."""
        if not self.dims:
            return (name,)
        return tuple(f"{name}[{','.join(map(str, i))}]" for i in self.entries)


def array_shape(dims: int | tuple[int, ...] | Shape | None) -> Shape:
    """A shape from what `param` was given: nothing, a length, a pair, or a shape."""
    if isinstance(dims, Shape):
        return dims
    if dims is None:
        return Shape("array", ())
    if isinstance(dims, int):
        dims = (dims,)
    if not dims or any(not isinstance(d, int) or d < 1 for d in dims) or len(dims) > 2:
        raise DeclarationError(f"shape {dims!r} is not a length or a pair of lengths, all >= 1")
    return Shape("array", tuple(dims))


def diagonal(n: int) -> Shape:
    """A diagonal n×n matrix with positive entries, stored and given as its n entries."""
    return Shape("array", (n,), positive_diagonal=True)


def lower(n: int) -> Shape:
    """A lower triangular n×n matrix with positive diagonal."""
    return Shape("lower", (n, n), positive_diagonal=True)


def full(n: int) -> Shape:
    """A full n×n matrix with positive diagonal, which fixes its sign.

    The bounds at 0 are those of the entries on the diagonal alone; `bounds=` replaces them, and
    `param((n, n))` is a matrix without any.
    """
    return Shape("array", (n, n), positive_diagonal=True)


#: A direction: a point on the unit sphere in space (3 numbers, 2 unknowns).
unit_vector = Shape("unit", (3,))
#: A rotation matrix (9 numbers, 3 unknowns).
rotation_matrix = Shape("rotation", (3, 3))
#: In an effect: one entry for each component of the quantity it acts on.
each = Shape("each", ())


def in_digits(value: Array, digits: int) -> str:
    """A number, or numbers in brackets on one line, to so many digits: 1 and not 1."""
    form: Any = {"float_kind": f"{{:.{digits}g}}".format}
    return np.array2string(value, separator=", ", formatter=form).replace("\n", "")
