"""Corrected readings: invert what lies between the corrected quantity and the reading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.engine import Replay
from casest.errors import DataError, UsageError
from casest.modelling.model import Model
from casest.modelling.tracing import function_of, sample_symbol, trace


def corrected(model: Model, run: Run, values: Mapping[str, Any]) -> Array:
    """The model's corrected quantity for every sample of a run, (N, size).

    Explicit models: the reading is solved for the corrected quantity, in one step where it enters
    linearly, else by Newton's method from the reading itself. Implicit ones compute it directly.
    Raises DataError naming the row where there is no solution.
    """
    name = model.traced.corrected
    if name is None:
        raise UsageError(f"model {model.name} names no corrected quantity: Residual(corrected=…)")
    coordinates, references = model.point(values)
    parameters = np.concatenate([coordinates, references])
    samples = np.hstack([run.signals[s.name] for s in model.signals])
    if model.implicit:
        declared = model.traced.quantities[name].declared
        replay = Replay(function_of(model, {"c": ca.vec(declared)}))
        return replay(parameters, samples)[0][:, :, 0]
    return _inverted(model, name, run, parameters, samples)


def _inverted(model: Model, name: str, run: Run, parameters: Array, samples: Array) -> Array:
    cut = trace(model, cut=name)
    wanted = cut.quantities[name].declared
    rest = cut.expression
    slope = ca.jacobian(rest, wanted)
    if rest.numel() != wanted.numel():
        raise UsageError(
            f"model {model.name}: {rest.numel()} readings do not determine the "
            f"{wanted.numel()} components of {name}"
        )
    affine = not ca.depends_on(slope, wanted)
    sample = ca.vertcat(sample_symbol(model, cut), wanted)
    point = ca.vertcat(cut.coordinates, cut.references)
    step = -ca.solve(slope, rest)
    f = Replay(
        ca.Function("inverse", [point, sample], [step, rest], ["parameters", "sample"], ["s", "r"])
    )
    value = run.signals[str(model.traced.measured)].copy()
    for _ in range(1 if affine else 50):
        move, _ = (out[:, :, 0] for out in f(parameters, np.hstack([samples, value])))
        value = value + move
        if affine or np.all(np.abs(move) <= 1e-14 * (1 + np.abs(value))):
            break
    left = f(parameters, np.hstack([samples, value]))[1][:, :, 0]
    scale = 1e-9 * (1 + np.abs(samples).max())
    bad = ~np.all(np.isfinite(value) & (np.abs(left) <= scale), axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        reading = np.array2string(run.signals[str(model.traced.measured)][row], precision=6)
        raise DataError(
            f"{run.file}: row {int(run.rows[row])}: reading {reading} "
            f"has no {name} in the model ({int(bad.sum())} such rows): it lies outside the range "
            "that the model can produce"
        )
    return value
