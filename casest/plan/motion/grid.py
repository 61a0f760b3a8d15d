"""Times of a motion: nodes, and the knots that its inputs are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array


@dataclass(frozen=True)
class Grid:
    """Nodes (K + 1,) in s, and inputs there as sums of those at knots (P, size each).

    begin, end (K, P): inputs at both ends of every interval; they differ from interval to interval
    where inputs are held.
    """

    time: Array
    knots: Array
    held: bool

    @staticmethod
    def of(duration: float, pieces: int, nodes: int, held: bool) -> Grid:
        """So many pieces of inputs, and at least so many intervals, a whole number in each."""
        each = -(-nodes // pieces)
        time = np.linspace(0.0, duration, pieces * each + 1)
        return Grid(time, time[: -1 if held else None : each], held)

    def finer(self, times: int) -> Grid:
        """The same inputs with so many times the nodes."""
        count = times * (len(self.time) - 1)
        return Grid(np.linspace(0.0, self.time[-1], count + 1), self.knots, self.held)

    @property
    def step(self) -> float:
        """Between two nodes, s."""
        return float(self.time[1] - self.time[0])

    def at(self, time: Array, before: bool = False) -> Array:
        """Weights (N, P) of the knots at times; of held inputs `before` they change there."""
        eye = np.eye(len(self.knots))
        if not self.held:
            return np.column_stack([np.interp(time, self.knots, column) for column in eye.T])
        inside = time - 1e-6 * self.step if before else time + 1e-6 * self.step
        place = np.searchsorted(self.knots, inside, "right") - 1
        return np.asarray(eye[np.clip(place, 0, len(eye) - 1)])
