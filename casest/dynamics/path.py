"""The trajectory along which a nonlinear record is judged: one that the model can go.

Smoothed states are moved by noise too. A Gramian along them takes that motion for known, and what
the model cannot show becomes visible by it: the false observability of an extended filter whose
Jacobians lie along states that no motion connects (Huang, Mourikis & Roumeliotis 2010). Where one
beginning and the inputs alone lead through the readings, the states that follow from them are taken
in place of the smoothed ones, and Φ is the Jacobian of the very map that they follow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.extended import Sampled
from casest.dynamics.filter import filtered, trajectory
from casest.dynamics.inputs import estimates

#: By how much of their variance readings may be further from what is foretold without driving noise
#: than from what is foretold with it, for the record to be led through by its inputs alone.
NEAR = 1.0

#: Φ and W of steps, and the covariance of the motion that nobody knows, where there is one.
Parts = tuple[Array, Array, Array | None]


@dataclass(frozen=True)
class Path:
    """A nonlinear model along states x (N, n), inputs of the `run` as they most likely were.

    `noisy`: is the noise of inputs known? Other driving noise is no matter of a trajectory.
    """

    sampled: Sampled
    run: Run
    x: Array
    noisy: bool

    @staticmethod
    def of(model: Dynamics, run: Run) -> Path:
        """Without driving noise from one beginning on: that of the smoothed states, or the most
        likely one; the smoothed states themselves where the record leaves both."""
        along = Path.along(model, run, filtered(model, run).smoothed)
        with np.errstate(all="ignore"):
            for begun in along.beginnings():
                own = along.sampled.followed(begun)
                if along.near(own):
                    return replace(along, x=own)
        return along

    @staticmethod
    def along(model: Dynamics, run: Run, x: Array) -> Path:
        """Along states (N, n)."""
        calm = estimates(model, run)
        quiet = replace(run, signals={**run.signals, **calm})
        alone = model.driven(**{s.name: 0.0 for s in model.states})
        noisy = model.input_noise is not None
        return Path(Sampled.of(alone, quiet, calm=calm), quiet, x, noisy)

    def beginnings(self) -> Iterator[Array]:
        """States (n,) at the first sample, the next one where that before leads astray."""
        yield self.x[0]
        model = self.sampled.model
        quiet = model.sensing(**{name: 0.0 for name in model.noisy_inputs})
        yield trajectory(quiet, self.run, self.x)[0][0]

    def near(self, other: Array) -> bool:
        """Do states `other` (N, n) lead through the readings too?"""
        if not np.isfinite(other).all():
            return False
        return self._left(other) <= max(self._left(self.x), 1.0) + NEAR

    def _left(self, x: Array) -> float:
        """Mean square of the readings less what states (N, n) foretell, in their variances."""
        C, d, y = self.sampled.read(x)
        return float(np.nanmean((y - d - (C @ x[:, :, None])[:, :, 0]) ** 2 / self.sampled.R))

    def steps(self, first: int, last: int) -> Parts:
        """Φ, W and Q of the single steps from sample `first` to `last`, (last − first, n, n)."""
        Phi, _, Q = self.sampled.moved(self.x[first:last], first)
        C, _, y = self.sampled.read(self.x[first : last + 1], first)
        rows = np.where(np.isfinite(y), 1 / self.sampled.R[first : last + 1], 0.0)
        told = C.transpose(0, 2, 1) @ (rows[:, :, None] * C)
        W = 0.5 * (told[:-1] + Phi.transpose(0, 2, 1) @ told[1:] @ Phi)
        return Phi, W, Q if self.noisy else None
