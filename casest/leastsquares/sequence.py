"""Effects on the sequence of samples: predictions that depend on the sample before.

A filter in the sensor makes the reading a recursion y[k] = F(y[k−1], x[k], dt[k]; θ) over the
model's prediction x. Its derivative follows the same recursion (forward sensitivity), and CasADi
runs both in one accumulated map.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import function_of, sample_symbol
from casest.engine import Replay
from casest.errors import DataError

#: Samples per accumulated map: long enough to hide the call, short enough to build at once.
CHUNK = 512


@dataclass(frozen=True)
class Recursion:
    """Residual and Jacobian of an explicit model with an effect on the sequence of samples."""

    model: Model

    @cached_property
    def _both_sides(self) -> Replay:
        """Prediction and reading of one sample, with their Jacobians."""
        t = self.model.traced
        outputs = {
            "x": ca.densify(t.predicted),
            "Jx": ca.jacobian(t.predicted, t.coordinates),
            "z": ca.densify(t.reading),
            "Jz": ca.jacobian(t.reading, t.coordinates),
        }
        return Replay(function_of(self.model, outputs))

    @cached_property
    def _steps(self) -> Any:
        """(state, inputs, parameters) -> state, state = [y, dy/dθ], over CHUNK samples."""
        t = self.model.traced
        m, n = t.predicted.numel(), t.coordinates.numel()
        y, S = ca.SX.sym("y", m), ca.SX.sym("S", m, n)
        x, J, dt = ca.SX.sym("x", m), ca.SX.sym("J", m, n), ca.SX.sym("dt")
        attached = next(a for a in self.model.effects if a.kind == "sequence")
        new = ca.vec(ca.SX(attached.apply(x, t.symbols, previous=y, dt=dt)))
        slope = ca.jacobian(new, x) @ J + ca.jacobian(new, y) @ S + ca.jacobian(new, t.coordinates)
        inputs = ca.vertcat(x, ca.vec(J), dt, sample_symbol(self.model))
        step = ca.Function(
            "step",
            [ca.vertcat(y, ca.vec(S)), inputs, ca.vertcat(t.coordinates, t.references)],
            [ca.vertcat(new, ca.vec(slope))],
        )
        return step.mapaccum("steps", CHUNK)

    def rows(self, parameters: Array, samples: Array, run: Run) -> tuple[Array, Array]:
        """Residuals (N, m) and Jacobians (N, m, n) with the recursion applied block by block."""
        if run.time is None:
            raise DataError(
                f"{run.file}: a sequence effect needs time: give a time column or --rate"
            )
        x, Jx, z, Jz = self._both_sides(parameters, samples)
        dt = np.diff(run.time, prepend=run.time[:1])
        y, S = np.empty_like(x[:, :, 0]), np.empty_like(Jx)
        for block in np.unique(run.block):
            own = np.flatnonzero(run.block == block)
            # The first sample of a block starts from a settled filter.
            dt[own[0]] = np.median(np.diff(run.time[own])) if len(own) > 1 else 0.0
            y[own], S[own] = self._block(x[own, :, 0], Jx[own], dt[own], samples[own], parameters)
        return z[:, :, 0] - y, Jz - S

    def _block(
        self, x: Array, J: Array, dt: Array, samples: Array, parameters: Array
    ) -> tuple[Array, Array]:
        count, m, n = J.shape
        state = np.concatenate([x[0], J[0].T.ravel()])
        inputs = np.hstack([x, J.transpose(0, 2, 1).reshape(count, -1), dt[:, None], samples])
        padded = -count % CHUNK
        inputs = np.vstack([inputs, np.repeat(inputs[-1:], padded, axis=0)])
        constants = np.repeat(parameters[:, None], CHUNK, axis=1)
        found = []
        for k in range(0, len(inputs), CHUNK):
            states = np.array(self._steps(state, inputs[k : k + CHUNK].T, constants))
            found.append(states.T)
            state = states[:, -1]
        states = np.vstack(found)[:count]
        return states[:, :m], states[:, m:].reshape(count, n, m).transpose(0, 2, 1)
