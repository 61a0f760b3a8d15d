"""A recorded signal between its samples: cubic splines, never across a gap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casest.data.timing import blocks

Array = NDArray[np.float64]

#: Samples beyond the end of a stretch over which a signal is thought to go on as it did.
REACH = 3


@dataclass(frozen=True)
class Piece:
    """A stretch of a record without gaps: spline(t, 0) its values at times t, spline(t, 1) rates.

    `step` is the usual time between its samples, in s.
    """

    first: float
    last: float
    step: float
    spline: Callable[[Array, int], Array]

    def at(self, wanted: Array) -> tuple[Array, Array]:
        """Values and rates (N, k) at any time: straight on for REACH samples, and then held."""
        reach = REACH * self.step
        held = np.clip(wanted, self.first - reach, self.last + reach)
        inside = np.clip(held, self.first, self.last)
        rate = self.spline(inside, 1)
        value = self.spline(inside, 0) + rate * (held - inside)[:, None]
        return value, np.where((held == wanted)[:, None], rate, 0.0)


@dataclass(frozen=True)
class Curve:
    """The samples of a record, and what was between them: `stretch` (N,) is the piece of each.

    Of a rotation, nine numbers row by row, the quaternion is interpolated and made a unit one
    again: that is the same curve in whatever frames the rotation is written, for steps well below
    half a turn.
    """

    stretch: NDArray[np.int_]
    pieces: tuple[Piece, ...]
    rotation: bool

    @classmethod
    def through(
        cls, time: Array, values: Array, block: NDArray[np.int_], *, rotation: bool = False
    ) -> Curve:
        """A curve through samples `values` (N, k) at `time` (N,) in s, cut by `block` and gaps."""
        stretch = blocks(time, block, np.arange(len(time)))
        numbers = quaternions(values) if rotation else values
        ends = np.searchsorted(stretch, np.arange(stretch[-1] + 2))
        pieces = [_piece(time[a:b], numbers[a:b]) for a, b in pairwise(ends)]
        return cls(stretch, tuple(pieces), rotation)

    def at(self, wanted: Array, stretch: NDArray[np.int_]) -> tuple[Array, Array]:
        """Values and their rates of change per s, (N, k) each, at times (N,) in s.

        `stretch` (N,) says by which piece each is told; what was beyond its ends nobody recorded.
        """
        order = np.argsort(stretch, kind="stable")
        ends = np.searchsorted(stretch[order], np.arange(len(self.pieces) + 1))
        own = zip(self.pieces, pairwise(ends), strict=True)
        found = [piece.at(wanted[order[a:b]]) for piece, (a, b) in own]
        back = np.argsort(order)
        value, rate = (np.concatenate(parts)[back] for parts in zip(*found, strict=True))
        return turned(value, rate) if self.rotation else (value, rate)

    @property
    def _ends(self) -> tuple[Array, Array]:
        return np.array([p.first for p in self.pieces]), np.array([p.last for p in self.pieces])

    def nearest(self, wanted: Array) -> NDArray[np.int_]:
        """The piece that was recorded at each of the times (N,), or the next one to it."""
        first, last = (
            np.array([getattr(p, end) for p in self.pieces]) for end in ("first", "last")
        )
        middles = (last[:-1] + first[1:]) / 2
        return np.searchsorted(middles, wanted).astype(np.int_)

    def covers(self, wanted: Array) -> NDArray[np.bool_]:
        """Which of the times (N,) lie within a piece."""
        return self.tells(wanted, self.nearest(wanted), reach=0)

    def tells(
        self, wanted: Array, stretch: NDArray[np.int_], reach: float = REACH
    ) -> NDArray[np.bool_]:
        """Which of the times (N,) the piece of each tells of, some samples beyond its ends too."""
        first, last, step = (
            np.array([getattr(p, name) for p in self.pieces])[stretch]
            for name in ("first", "last", "step")
        )
        beyond = np.maximum(first - wanted, wanted - last)
        return np.asarray(beyond <= reach * step)


def _piece(time: Array, values: Array) -> Piece:
    first, last = float(time[0]), float(time[-1])
    if len(time) < 2:
        alone = lambda t, order: np.repeat(values if order == 0 else 0 * values, len(t), axis=0)  # noqa: E731
        return Piece(first, last, 0.0, alone)
    from scipy.interpolate import CubicSpline  # imported late: SciPy loads slowly

    spline = CubicSpline(time, values, axis=0)
    step = float(np.median(np.diff(time)))
    return Piece(first, last, step, lambda t, order: np.asarray(spline(t, order)))


def quaternions(rotations: Array) -> Array:
    """Unit quaternions x, y, z, w, (N, 4), of rotations (N, 9); each in the half of the last."""
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat()
    turns = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    return np.asarray(q * np.cumprod(np.concatenate([[1.0], turns]))[:, None])


def turned(q: Array, rate: Array) -> tuple[Array, Array]:
    """Rotations (N, 9) and their rates from quaternions (N, 4) of any length and theirs."""
    length = np.linalg.norm(q, axis=1, keepdims=True)
    unit = q / length
    rate = (rate - unit * np.sum(unit * rate, axis=1, keepdims=True)) / length
    # A rotation is a square of its unit quaternion: a product of both is a difference of squares.
    return _square(unit), (_square(unit + rate) - _square(unit - rate)) / 2


def _square(q: Array) -> Array:
    x, y, z, w = q.T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.stack([entry for row in rows for entry in row], axis=1)
