"""How uncertain a corrected reading is: by the parameters, by its own noise, by the references.

To first order: c follows the parameters θ, the known numbers k and the reading x with slopes that
are derivatives of the correction, or of the step to its solution (which vanishes there). The three
parts are independent of each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casest.correction.inverse import Correction, correction_of, invertible
from casest.correction.program import Input, Program, steps_of
from casest.declaration.model import Model
from casest.declaration.noise import root_of
from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.estimate.estimate import Estimate
from casest.estimate.propagation import uncertain
from casest.leastsquares.sums import signal_noise

#: Standard deviations of a corrected reading, in the order of a program's outputs.
PARTS = ("parameters", "noise", "reference", "together")


@dataclass(frozen=True)
class Slopes:
    """Of the corrected quantity, as symbols of a sample and of itself.

    In all `unknowns` of the fit (m, n), in the uncertain known numbers (m, k), and in a sample's
    numbers (m, width).
    """

    sample: ca.SX
    value: ca.SX
    unknowns: ca.SX
    known: ca.SX
    reading: ca.SX
    inputs: tuple[Input, ...]


@dataclass(frozen=True)
class Opened:
    """A correction with its parameters and the uncertain known numbers left open.

    `function` of [coordinates, references] and the `whole` sample (and a trial value, for the kind
    newton); `coordinates` as fitted, which follow the unknowns of the fit with the slope `fitted`
    (p, n); of the known numbers they are at the places `known`.
    """

    correction: Correction
    kind: str
    function: Any
    coordinates: Array
    references: Array
    fitted: Array
    known: list[int]
    sample: ca.SX
    whole: ca.SX
    inputs: tuple[Input, ...]


def opened(estimate: Estimate, units: Mapping[str, str], model: Model | None = None) -> Opened:
    """Of a fit to one run, or whose parameters are shared by all; UsageError for others.

    `model`: what is left of the fitted one, if not all of it.
    """
    names = [c.name for c in uncertain(estimate.model)]
    model = invertible(_freed(model or estimate.model, names))[0]
    correction = correction_of(model)
    own = {p.name for p in model.parameters if p.scope == "run"} & correction.parameters
    if own and len(estimate.problem.runs) > 1:
        raise UsageError(f"{sorted(own)[0]} differs from run to run")
    kind, function = correction.as_function()
    values = {**_of_first(estimate), **{c.name: c.array for c in uncertain(estimate.model)}}
    coordinates, references = model.point(values)
    sample, inputs, whole = _sample(correction, units)
    places = _places(model)
    fitted = np.zeros((len(coordinates), estimate.problem.unknowns))
    for slot in estimate.problem.slots:
        if slot.run in (None, 0) and slot.parameter.name in places:  # else it is not undone
            fitted[places[slot.parameter.name], slot.x] = np.eye(slot.x.stop - slot.x.start)
    known = [i for name in names for i in range(places[name].start, places[name].stop)]
    return Opened(correction, kind, function, np.asarray(coordinates, dtype=float),
                  np.asarray(references, dtype=float), fitted, known, sample, whole,
                  inputs)  # fmt: skip


def slopes(estimate: Estimate, units: Mapping[str, str], model: Model | None = None) -> Slopes:
    """Of a fit to one run, or whose parameters are shared by all; UsageError for others."""
    found = opened(estimate, units, model)
    theta = ca.SX.sym("theta", len(found.coordinates))
    value = ca.SX.sym("value", found.correction.size)
    at = ca.vertcat(found.whole, value) if found.kind == "newton" else found.whole
    out = found.function(ca.vertcat(theta, ca.DM(found.references)), at)[: found.correction.size]
    of, sample = ca.DM(found.coordinates), found.sample
    here = [ca.substitute(ca.jacobian(out, x), theta, of) for x in (theta, sample)]
    fitted, known = ca.DM(found.fitted), here[0][:, found.known]
    return Slopes(sample, value, here[0] @ fitted, known, here[1], found.inputs)


def _freed(model: Model, names: Sequence[str]) -> Model:
    for name in names:
        model = model.freed(name).scoped(name, "all")
    return model.without_noise


def _of_first(estimate: Estimate) -> dict[str, Any]:
    """Values, of the first run where each has its own."""
    several = len(estimate.problem.runs) > 1
    return {
        p.name: estimate.values[p.name][0]
        if several and p.scope == "run"
        else estimate.values[p.name]
        for p in estimate.model.parameters
    }


def _places(model: Model) -> dict[str, slice]:
    found, at = {}, 0
    for p in model.parameters:
        found[p.name] = slice(at, at + p.shape.coordinates)
        at += p.shape.coordinates
    return found


def _sample(
    correction: Correction, units: Mapping[str, str]
) -> tuple[ca.SX, tuple[Input, ...], ca.SX]:
    """Symbols of what the correction needs, what they are, and a whole sample with zeros else."""
    needed = {s.name: ca.SX.sym(s.name, s.size) for s in correction.signals}
    inputs = tuple(Input(s.name, s.size, units.get(s.name, ""), s.kind) for s in correction.signals)
    whole = [needed.get(s.name, ca.SX.zeros(s.size)) for s in correction.model.signals]
    return ca.vertcat(*needed.values()), inputs, ca.vertcat(*whole)


def spread_program(
    estimate: Estimate, found: Slopes, units: Mapping[str, str], name: str
) -> Program:
    """Standard deviations (4·m,) of a corrected reading, its PARTS one after the other.

    What goes in is a sample's numbers, then the corrected ones.
    """
    random = np.nan_to_num(estimate.covariance)
    parts = [found.unknowns @ ca.DM(_factor(random - _carried(estimate)))]
    parts.append(found.reading @ ca.DM(reading_root(estimate, found.inputs)))
    inputs = estimate.inputs
    if inputs is not None:
        total = found.unknowns @ ca.DM(inputs.sensitivity) + found.known
        parts.append(total @ ca.DM(_factor(inputs.covariance)))
    else:
        parts.append(ca.SX.zeros(found.value.numel(), 1))
    squares = [ca.sum2(part**2) for part in parts]
    std = ca.sqrt(ca.vertcat(*squares, squares[0] + squares[1] + squares[2]))
    x = ca.SX.sym("x", found.sample.numel() + found.value.numel())
    body = ca.substitute(std, ca.vertcat(found.sample, found.value), x)
    function = ca.Function("spread", [x], [ca.densify(ca.simplify(body))])
    steps, registers = steps_of(function, "the standard deviation")
    unit = units.get(name, "")
    corrected = Input(name, found.value.numel(), unit)
    output = Input(f"std of {name}", len(PARTS) * found.value.numel(), unit)
    return Program(
        estimate.model.name, "direct", (*found.inputs, corrected), output, registers, steps
    )


def _carried(estimate: Estimate) -> Array | float:
    return 0.0 if estimate.inputs is None else estimate.inputs.carried


def _factor(covariance: Array) -> Array:
    """L with LLᵀ the covariance, its empty columns left out."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-14 * max(values.max(initial=0.0), 1e-300)
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def reading_root(estimate: Estimate, inputs: Sequence[Input]) -> Array:
    """R (width, width) with RRᵀ the covariance of one reading's noise.

    As it was stated; else as rest intervals show it, else as the residual does.
    """
    width, first = sum(i.size for i in inputs), 0
    found = np.zeros((width, width))
    for i in inputs:
        root = _signal_root(estimate, i.name, i.size)
        found[first : first + i.size, first : first + root.shape[1]] = root
        first += i.size
    return _with_correlations(estimate, inputs, found)


def _with_correlations(estimate: Estimate, inputs: Sequence[Input], root: Array) -> Array:
    """The root with what signals share whose noise was stated together."""
    stated = estimate.model.noise
    if stated is None or not stated.groups:
        return root
    covariance, places, first = root @ root.T, dict[str, range](), 0
    for i in inputs:
        places[i.name], first = range(first, first + i.size), first + i.size
    for group in (g for g in stated.groups if len(g) > 1):
        whole, own, first = _of_one_reading(estimate, group), list[int](), 0
        kept = list[int]()
        for name in group:
            size = estimate.model[name].size
            if name in places:
                own += places[name]
                kept += range(first, first + size)
            first += size
        covariance[np.ix_(own, own)] = whole[np.ix_(kept, kept)]
    found = np.zeros_like(root)
    factor = _factor(covariance)
    found[:, : factor.shape[1]] = factor
    return found


def _of_one_reading(estimate: Estimate, group: tuple[str, ...]) -> Array:
    """Mean covariance (k, k) of one reading's noise of signals together, as it was stated."""
    size, matrices = sum(estimate.model[name].size for name in group), list[Array]()
    for run in estimate.problem.runs:
        root = run.signals[root_of(group)]
        if root.shape[1] == size:
            root = root[:, :, None] * np.eye(size)
        root = root.reshape(-1, size, size) * np.sqrt(run.count)[:, None, None]
        matrices.append(root @ np.swapaxes(root, 1, 2))
    return np.asarray(np.mean(np.concatenate(matrices), axis=0))


def _signal_root(estimate: Estimate, name: str, size: int) -> Array:
    runs, model = estimate.problem.runs, estimate.model
    if model.noise is not None:
        if (name,) not in model.noise.together:
            return np.zeros((size, size))
        return _factor(_of_one_reading(estimate, (name,)))
    if all(name in run.spread for run in runs):
        single = np.concatenate([run.spread[name] * np.sqrt(run.count)[:, None] for run in runs])
        return np.diag(np.sqrt(np.mean(single**2, axis=0)))
    if not model.implicit:
        noisy = name == model.traced.measured
        return np.eye(size) * (estimate.noise.sigma if noisy else 0.0)
    at = estimate.optimum or estimate.point
    each = signal_noise(estimate.problem, at, estimate.noise.sigma)
    place = [s.name for s in model.signals].index(name)
    return np.eye(size) * float(each[place])
