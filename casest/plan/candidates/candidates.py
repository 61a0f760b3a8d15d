"""Candidates of one model: what each would be, and the information that it would bring."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import UsageError
from casest.leastsquares.per_sample import slope_in_sample
from casest.leastsquares.problem import Problem

#: Kind of candidates that are the times of one run.
TIME = "time"


@dataclass(frozen=True)
class Noise:
    """Of one residual on each axis, or of single readings; `known`: somebody stated or measured it.

    residual: (m,) in the residual's unit. readings: by signal, in the model's units; these go
    before where they are given.
    """

    residual: Array
    readings: Mapping[str, float]
    known: bool = True


@dataclass(frozen=True)
class Candidates:
    """N measurements that could be made.

    factors (N, k, n): whitened slopes of what each measures in the unknowns `names`, so that its
    information is FᵀF. words: one sentence each. signals: what each is in the model's signals,
    (N, size); settings: the same of a run's own parameters. up (N, 3): directions of up, where
    they are poses. cost (N,): of each, in any unit.
    """

    kind: str
    factors: Array
    names: tuple[str, ...]
    words: tuple[str, ...]
    cost: Array
    signals: Mapping[str, Array]
    settings: Mapping[str, Array]
    up: Array | None = None
    run: Run | None = None

    def __len__(self) -> int:
        """How many there are."""
        return len(self.factors)

    @property
    def once(self) -> bool:
        """Can each be made once only? A run is read once at each time."""
        return self.kind == TIME


def factors_of(model: Model, values: Mapping[str, Any], run: Run, noise: Noise) -> Array:
    """Whitened slopes (N, m, n) of the residuals of a run's samples in the unknowns."""
    return whitened(model, values, run, noise)[1]


def whitened(
    model: Model, values: Mapping[str, Any], run: Run, noise: Noise
) -> tuple[Array, Array]:
    """Residuals (N, m) of a run's samples and their slopes (N, m, n), over the noise."""
    problem = Problem(model, (run,))
    point = problem.point(values)
    slopes = problem.jacobian(point).reshape(len(run), len(model.axes), problem.unknowns)
    residuals = problem.residuals(point)[0]
    if not np.isfinite(slopes).all():
        bad = int(np.argmax(~np.isfinite(slopes).all(axis=(1, 2))))
        raise UsageError(
            f"{model.name}: candidate {bad + 1} has no finite slope; give other --value or leave "
            "it out"
        )
    if not noise.readings:
        return residuals / noise.residual, np.asarray(slopes / noise.residual[:, None])
    G = slope_in_sample(model)(problem.parameters(point, 0), problem.samples[0])[0]
    std = np.concatenate([np.full(s.size, noise.readings.get(s.name, 0.0)) for s in model.signals])
    covariance = np.einsum("nik,k,njk->nij", G, std**2, G)
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        silent = [s.name for s in model.readings if s.name not in noise.readings]
        raise UsageError(
            f"{model.name}: the noise of {' and '.join(noise.readings)} alone leaves a residual "
            f"without noise; give that of {' and '.join(silent) or 'others'} too: --sensor-noise"
        ) from None
    both = np.linalg.solve(root, np.concatenate([slopes, residuals[:, :, None]], axis=2))
    return np.asarray(both[:, :, -1]), np.asarray(both[:, :, :-1])


def blank(model: Model, count: int, given: Mapping[str, Array]) -> Run:
    """A run of so many samples with what is given; other signals, and readings, are zero."""
    signals = {s.name: given.get(s.name, np.zeros((count, s.size))) for s in model.signals}
    units = {s.name: s.unit for s in model.signals}
    return Run.raw("planned", {**given, **signals}, units=units)


def predicted(model: Model, values: Mapping[str, Any], run: Run) -> Run:
    """The run with its readings as an explicit model predicts them."""
    problem = Problem(model, (run,))
    found = problem.evaluate(problem.point(values), {"p": model.along.predicted})[0][0][:, :, 0]
    signals = {**run.signals, str(model.traced.measured): found}
    made = Run.raw(run.name, signals, units=run.units, time=run.time)
    return made


def others(model: Model) -> tuple[Signal, ...]:
    """Signals that are neither readings of the body nor time nor an attitude."""
    measured = {str(model.traced.measured)}
    own = {s.name for s in model.readings} if model.implicit else measured
    return tuple(
        s for s in model.signals if s.name not in own and s.name != "t" and s.kind == "plain"
    )


def marginal(information: Array, kept: int) -> Array:
    """Information of the first unknowns, the others being unknown along with them."""
    if kept == len(information):
        return information
    own = information[kept:, kept:]
    across = information[:kept, kept:]
    return np.asarray(information[:kept, :kept] - across @ np.linalg.pinv(own) @ across.T)


def of_last_run(model: Model, name: str, value: Array) -> Array:
    """A parameter's value (of the last run, where it has a leading axis of runs)."""
    dims: tuple[int, ...] = model[name].shape.dims
    return np.asarray(value[-1] if value.ndim > len(dims) else value)
