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
class Curve:
    """Samples `values` (N, k) at `time` (N,) in s, of the stretches that `stretch` (N,) numbers.

    Of a rotation k is 9, and what is interpolated is its quaternion, made a unit one again: that
    is the same curve in whatever frames the rotation is written, for steps well below half a turn.
    """

    time: Array
    stretch: NDArray[np.int_]
    pieces: tuple[Callable[[Array, int], Array], ...]
    rotation: bool

    @classmethod
    def through(
        cls, time: Array, values: Array, block: NDArray[np.int_], *, rotation: bool = False
    ) -> Curve:
        """A curve through the samples of one record: `block` and gaps in time cut it."""
        stretch = blocks(time, block, np.arange(len(time)))
        numbers = quaternions(values) if rotation else values
        ends = np.searchsorted(stretch, np.arange(stretch[-1] + 2))
        pieces = [_piece(time[a:b], numbers[a:b]) for a, b in pairwise(ends)]
        return cls(time, stretch, tuple(pieces), rotation)

    def at(self, wanted: Array) -> tuple[Array, Array]:
        """Values and their rates of change per s, (N, k) each, at one time for each sample.

        Each within its own stretch. Beyond an end it goes straight on for REACH samples, and then
        holds: what was there nobody recorded.
        """
        ends = np.searchsorted(self.stretch, np.arange(len(self.pieces) + 1))
        found = [
            self._within(piece, self.time[a:b], wanted[a:b])
            for piece, (a, b) in zip(self.pieces, pairwise(ends), strict=True)
        ]
        value, rate = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return (value, rate)

    def _within(
        self, piece: Callable[[Array, int], Array], time: Array, wanted: Array
    ) -> tuple[Array, Array]:
        reach = REACH * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        held = np.clip(wanted, time[0] - reach, time[-1] + reach)
        inside = np.clip(held, time[0], time[-1])
        rate = piece(inside, 1)
        value = piece(inside, 0) + rate * (held - inside)[:, None]
        rate = np.where((held == wanted)[:, None], rate, 0.0)
        return turned(value, rate) if self.rotation else (value, rate)


def _piece(time: Array, values: Array) -> Callable[[Array, int], Array]:
    if len(time) > 1:
        from scipy.interpolate import CubicSpline  # imported late: SciPy loads slowly

        spline = CubicSpline(time, values, axis=0)
        return lambda t, order: np.asarray(spline(t, order))
    return lambda t, order: np.repeat(values if order == 0 else 0 * values, len(t), axis=0)


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
