"""Where the uncertainty of a fit comes from: covariance of the values, and what each input gives.

Named by the entries of the parameters, `scale[1,0]`: directions and rotations too, whose entries
follow from fewer unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import casadi as ca
import numpy as np
from msgspec import Struct

from casest.correction import runtime
from casest.correction.numpy_module import as_data
from casest.correction.program import Program
from casest.correction.spread import Slopes, reading_root
from casest.declaration.shapes import Array
from casest.estimate.estimate import UNLIMITED, Estimate
from casest.estimate.sources import sources
from casest.results.file import plain
from casest.results.result import Number
from casest.results.units import entry_units, resolved, unit_table


class Covariance(Struct, frozen=True):
    """Values and covariance of all entries of all parameters; null where there is none."""

    names: list[str]
    values: list[Number]
    units: list[str]
    matrix: list[list[Number]]


class Input(Struct, frozen=True):
    """Something uncertain that goes into a fit: what moves with it, and by how much.

    `kind` is reference (a known number, with its `sensitivity` of each entry in the entry's unit
    over its own), noise (of one reading, `std` in its unit), prior or curvature. `share` of each
    entry's variance: shares sum to one; those of correlated numbers may be negative.
    `degrees_of_freedom` is null where the standard uncertainty is as good as known.
    """

    name: str
    kind: str
    value: Number
    std: Number
    unit: str
    degrees_of_freedom: Number
    sensitivity: dict[str, Number]
    share: dict[str, Number]


class CorrectedBudget(Struct, frozen=True):
    """The same of one corrected reading, `at` a usual reading of the fit.

    `share` of the variance of each component, by input; what the reading's own noise has is
    called so. `degrees_of_freedom` are effective ones (Welch & Satterthwaite).
    """

    name: str
    unit: str
    at: list[float]
    value: list[Number]
    std: list[Number]
    degrees_of_freedom: list[Number]
    sensitivity: dict[str, list[Number]]
    share: dict[str, list[Number]]


def covariance_of(estimate: Estimate) -> Covariance:
    """Covariance of the values, in the order of the declaration, run by run."""
    names, units, slope = entries_of(estimate)
    unknown = np.isnan(np.diag(estimate.covariance))
    matrix = slope @ np.where(np.isnan(estimate.covariance), 0.0, estimate.covariance) @ slope.T
    lost = (slope != 0) @ unknown
    matrix[lost, :] = matrix[:, lost] = np.nan
    return Covariance(names, _values(estimate), units, plain(0.5 * (matrix + matrix.T)))


def _values(estimate: Estimate) -> list[Number]:
    """Every entry, in the order of `entries_of`."""
    found: list[Number] = []
    for slot in estimate.problem.slots:
        value, shape = estimate.values[slot.parameter.name], slot.parameter.shape
        if value.ndim > len(shape.dims):
            value = value[slot.run]
        found += [plain(value[i]) for i in shape.entries]
    return found


def inputs_of(estimate: Estimate) -> list[Input]:
    """Every known number that is not exact, then what is random."""
    names, _, slope = entries_of(estimate)
    units = unit_table(estimate.model, estimate.problem.runs)
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = np.diag(slope @ estimate.covariance @ slope.T)
        found = list(_references(estimate, names, slope, whole, units))
        for source in sources(estimate, units["residual"]):
            part = np.diag(slope @ source.covariance @ slope.T) / whole
            found.append(
                Input(
                    source.name,
                    source.name.partition(" ")[0],
                    None,
                    plain(source.std),
                    resolved(source.unit, units) if source.unit else "",
                    plain(source.degrees_of_freedom),
                    {},
                    _by_name(names, part),
                )
            )
    return found


def _references(
    estimate: Estimate, names: list[str], slope: Array, whole: Array, units: Mapping[str, str]
) -> Iterator[Input]:
    inputs = estimate.inputs
    if inputs is None:
        return
    sensitivity = slope @ inputs.sensitivity
    shares = sensitivity * (sensitivity @ inputs.covariance) / whole[:, None]
    for j, name in enumerate(inputs.names):
        yield Input(
            name,
            "reference",
            plain(inputs.values[j]),
            float(inputs.std[j]),
            units.get(name) or units.get(name.partition("[")[0], inputs.units[j]),
            plain(inputs.freedom[j]),
            _by_name(names, sensitivity[:, j]),
            _by_name(names, shares[:, j]),
        )


def _by_name(names: list[str], values: Array) -> dict[str, Number]:
    return {n: plain(v) for n, v in zip(names, values, strict=True)}


def freedom_of(estimate: Estimate) -> dict[str, Number]:
    """Effective degrees of freedom of each entry; null where its std is as good as known."""
    names, _, slope = entries_of(estimate)
    each = estimate.effective_freedom
    least = [min(each[i] for i in np.flatnonzero(row)) for row in slope]
    return {n: None if f >= UNLIMITED else float(f) for n, f in zip(names, least, strict=True)}


def corrected_budget(
    estimate: Estimate, found: Slopes, program: Program, readings: Array
) -> CorrectedBudget | None:
    """Of the one of these readings (N, width) whose length is the median; None without a value."""
    at = readings[np.argsort(np.linalg.norm(readings, axis=1))[len(readings) // 2]]
    units = unit_table(estimate.model, estimate.problem.runs)
    value = runtime.attempted(as_data(program), at[None])[0]
    if not np.isfinite(value).all():
        return None
    function = ca.Function("slopes", [found.sample, found.value],
                           [found.unknowns, found.known, found.reading])  # fmt: skip
    unknowns, known, reading = (np.array(part) for part in function(at, value))
    variance, sensitivity, freedom = (
        dict[str, Array](),
        dict[str, list[Number]](),
        dict[str, float](),
    )
    inputs = estimate.inputs
    if inputs is not None:
        total = unknowns @ inputs.sensitivity + known
        both = total * (total @ inputs.covariance)
        variance |= {n: both[:, j] for j, n in enumerate(inputs.names)}
        sensitivity = {n: plain(total[:, j]) for j, n in enumerate(inputs.names)}
        each = zip(inputs.names, inputs.freedom, strict=True)
        freedom = {n: float(f) for n, f in each if np.isfinite(f)}
    for source in sources(estimate, units["residual"]):
        own = np.nan_to_num(source.covariance)
        variance[source.name] = np.diag(unknowns @ own @ unknowns.T)
        if source.degrees_of_freedom is not None:
            freedom[source.name] = source.degrees_of_freedom
    root = reading @ reading_root(estimate, found.inputs)
    variance["the reading's own noise"] = np.sum(root**2, axis=1)
    whole = sum(variance.values())
    with np.errstate(invalid="ignore", divide="ignore"):
        left = sum(np.square(variance[n]) / np.float64(f) for n, f in freedom.items())
        effective = np.where(left > 0, np.square(whole) / left, np.inf)
        return CorrectedBudget(
            program.output.name,
            program.output.unit,
            plain(at),
            plain(value),
            plain(np.sqrt(whole)),
            plain(effective),
            sensitivity,
            {n: plain(v / whole) for n, v in variance.items()},
        )


def entries_of(estimate: Estimate) -> tuple[list[str], list[str], Array]:
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
