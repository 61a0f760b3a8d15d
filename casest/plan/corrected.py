"""How the corrected quantity depends on the unknowns, reading by reading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from casest.correction.inverse import invertible
from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import sample_symbol, trace
from casest.engine import Replay

#: Samples at which the range of readings is looked at.
LOOKED_AT = 60


def corrected_slopes(model: Model, values: Mapping[str, Any], run: Run) -> Array | None:
    """Slopes (n, samples·size) of the corrected quantity in the unknowns of one run.

    At samples spread evenly over the run; None where the model names nothing to correct.
    """
    if model.traced.corrected is None:
        return None
    model = invertible(model)[0]
    every = np.unique(np.linspace(0, len(run) - 1, LOOKED_AT).astype(int))
    samples = np.hstack([run.signals[s.name][every] for s in model.signals])
    f = _slopes(model)
    if f is None:
        return None
    found = Replay(f)(np.concatenate(model.point(dict(values))), samples)[0]
    return np.asarray(found.reshape(-1, found.shape[2]).T)


def _slopes(model: Model) -> Any:
    """∂c/∂x of one sample: of an explicit model by the implicit function theorem."""
    t, name = model.traced, str(model.traced.corrected)
    point = ca.vertcat(t.coordinates, t.references)
    if not model.implicit:
        return _at_prediction(model, name)
    slope = ca.jacobian(ca.vec(t.quantities[name].value), t.coordinates)
    return ca.Function(
        "slope", [point, sample_symbol(model)], [ca.densify(slope)], ["parameters", "sample"], ["s"]
    )


def _at_prediction(model: Model, name: str) -> Any:
    """The slope where the corrected quantity is what the model itself computes of it."""
    t, cut = model.traced, trace(model, cut=name)
    wanted = cut.quantities[name].declared
    if cut.expression.numel() != wanted.numel():
        return None
    slope = -ca.solve(
        ca.jacobian(cut.expression, wanted), ca.jacobian(cut.expression, cut.coordinates)
    )
    own = ca.vertcat(cut.coordinates, cut.references, sample_symbol(model, cut), ca.vec(wanted))
    f = ca.Function("slope_at", [own], [ca.densify(slope)])
    here = ca.vertcat(
        t.coordinates, t.references, sample_symbol(model), ca.vec(t.quantities[name].declared)
    )
    return ca.Function(
        "slope",
        [ca.vertcat(t.coordinates, t.references), sample_symbol(model)],
        [f(here)],
        ["parameters", "sample"],
        ["s"],
    )
