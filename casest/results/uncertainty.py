"""Where the uncertainty of a fit comes from: covariance of the values, and what each input gives.

Named by the entries of the parameters, `scale[1,0]`: directions and rotations too, whose entries
follow from fewer unknowns.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from casest.declaration.shapes import Array
from casest.estimate.estimate import Estimate
from casest.results.file import plain
from casest.results.result import Number
from casest.results.units import entry_units, unit_table


class Covariance(Struct, frozen=True):
    """Covariance of all entries of all parameters; null where the data do not determine one."""

    names: list[str]
    units: list[str]
    matrix: list[list[Number]]


class Input(Struct, frozen=True):
    """A known number that is not exact: what moves with it, and by how much.

    `sensitivity` of each entry to it, in the entry's unit over its own; `share` of each entry's
    variance. Shares of correlated numbers may be negative.
    """

    name: str
    value: Number
    std: float
    unit: str
    sensitivity: dict[str, Number]
    share: dict[str, Number]


def covariance_of(estimate: Estimate) -> Covariance:
    """Covariance of the values, in the order of the declaration, run by run."""
    names, units, slope = _entries(estimate)
    unknown = np.isnan(np.diag(estimate.covariance))
    matrix = slope @ np.where(np.isnan(estimate.covariance), 0.0, estimate.covariance) @ slope.T
    lost = (slope != 0) @ unknown
    matrix[lost, :] = matrix[:, lost] = np.nan
    return Covariance(names, units, plain(0.5 * (matrix + matrix.T)))


def inputs_of(estimate: Estimate) -> list[Input]:
    """Every uncertain number that the model takes as known; none where all are exact."""
    inputs = estimate.inputs
    if inputs is None:
        return []
    names, _, slope = _entries(estimate)
    sensitivity = slope @ inputs.sensitivity
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = np.diag(slope @ estimate.covariance @ slope.T)
        shares = sensitivity * (sensitivity @ inputs.covariance) / whole[:, None]
    units = unit_table(estimate.model, estimate.problem.runs)
    return [
        Input(
            name,
            plain(inputs.values[j]),
            float(inputs.std[j]),
            units.get(name) or units.get(name.partition("[")[0], inputs.units[j]),
            {n: plain(s) for n, s in zip(names, sensitivity[:, j], strict=True)},
            {n: plain(s) for n, s in zip(names, shares[:, j], strict=True)},
        )
        for j, name in enumerate(inputs.names)
    ]


def _entries(estimate: Estimate) -> tuple[list[str], list[str], Array]:
    """Name and unit of every entry, and its slope (entries, n) in the unknowns."""
    problem, point = estimate.problem, estimate.optimum or estimate.point
    known = unit_table(problem.model, problem.runs)
    several = len(problem.runs) > 1
    names, units, parts = list[str](), list[str](), [np.zeros((0, problem.unknowns))]
    for slot in problem.slots:
        run = f" ({problem.runs[slot.run].name})" if slot.run is not None and several else ""
        part = np.zeros((slot.parameter.shape.size, problem.unknowns))
        part[:, slot.x] = problem.chart_slope(slot, point)
        names += [name + run for name in slot.parameter.entry_names]
        units += entry_units(slot.parameter, known)
        parts.append(part)
    return names, units, np.vstack(parts)
