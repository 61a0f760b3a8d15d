"""How large an effect is in practice, where somebody knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from casest.declaration.dimensions import size_of
from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter
from casest.diagnose.candidates.candidates import Candidate
from casest.leastsquares.problem import Point, Problem

#: Inputs for which the catalogue says how much a response bends: of an accelerometer, in m/s².
EARTH = 9.80665
#: What is as wide as a part of the range, too.
WIDTHS = ("threshold", "band")


def typical_sizes(
    candidate: Candidate,
    parameters: Sequence[Parameter],
    model: Model,
    largest: Mapping[str, float],
) -> Array | None:
    """A typical size of each of its unknowns (packed), or None where nobody knows one.

    `largest`: how large each quantity gets in the data. A response bends by as much of the range,
    whatever the range is.
    """
    if candidate.freed:
        value = model[candidate.freed].array
        return None if value.ndim or not np.any(value) else np.array([0.01 * abs(float(value))])
    effect = candidate.effect
    assert effect is not None
    typical = dict(effect.typical)
    units = {n: d.unit for n, d in effect.declarations if isinstance(getattr(d, "unit", None), str)}
    found = list[Array]()
    for p in parameters:
        own = p.name.rpartition(".")[2]
        if own not in typical:
            return None
        range_ = largest.get(effect.on, 0.0)
        size = typical[own] * _of_range(effect, units.get(own, ""), range_)
        if dict(effect.profile).get(own) in WIDTHS and range_ > 0:
            size *= range_ / EARTH
        found.append(np.full(p.shape.coordinates, size))
    return np.concatenate(found)


def _of_range(effect: Effect, unit: str, largest: float) -> float:
    """By what a size changes whose unit goes down with that of what the effect acts on."""
    columns, powers = dict(effect.columns), size_of(unit, {}).powers or {}
    # "[u]", the argument that it acts on: not s, nor a column.
    power = sum(float(p) for b, p in powers.items() if b[0] == "[" and b[1:-1] not in columns)
    return (largest / EARTH) ** power if power < 0 < largest else 1.0


def largest_of(problem: Problem, point: Point) -> dict[str, float]:
    """How large each quantity of the model gets in the data, in its own unit."""
    every = {name: q.declared for name, q in problem.model.along.quantities.items()}
    flat = {name: ca.densify(ca.vec(declared)) for name, declared in every.items()}
    found = dict.fromkeys(flat, 0.0)
    for pieces in problem.evaluated_pieces(point, flat):
        for name, values in zip(flat, pieces, strict=True):
            size = np.abs(values[np.isfinite(values)]).max(initial=0.0)
            found[name] = max(found[name], float(size))
    return found
