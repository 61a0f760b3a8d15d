"""One least-squares problem from a model and its runs. The only place with index arithmetic.

The unknowns are one vector: parameters shared by all runs first (in the model's order), then the
parameters that each run has for itself, run after run. Every run sees its own selection of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaring.physics import chart
from casest.declaring.shapes import Array
from casest.declaring.symbols import Parameter
from casest.engine import Normal, Replay, cost, normal_equations, rows, triangular_factor
from casest.errors import DataError, UsageError
from casest.modelling.model import Model
from casest.modelling.tracing import function_of
from casest.persample import curvature, laplacian, residual_and_jacobian, slope_in_sample
from casest.sequence import Recursion


@dataclass(frozen=True)
class Slot:
    """One parameter's place: `x` in the unknowns, `ref` in the chart references."""

    parameter: Parameter
    run: int | None
    x: slice
    ref: slice


@dataclass(frozen=True)
class Point:
    """A place in parameter space: unknowns `x` (n,) and the charts they are measured in."""

    x: Array
    references: Array


@dataclass(frozen=True)
class Problem:
    """The sum of squares of a model's residuals over runs.

    `weights` (one (N, m) array per run, or None) multiply the squares. Residuals are in the
    model's residual unit. Jacobians are with respect to the unknowns `x`.
    """

    model: Model
    runs: tuple[Run, ...]
    weights: tuple[Array, ...] | None = None

    # -- layout --------------------------------------------------------------------------------

    @cached_property
    def slots(self) -> tuple[Slot, ...]:
        """Every parameter's place in the unknowns."""
        order: list[tuple[Parameter, int | None]] = [
            (p, None) for p in self.model.parameters if p.scope == "all"
        ]
        for k in range(len(self.runs)):
            order += [(p, k) for p in self.model.parameters if p.scope == "run"]
        slots, x, ref = [], 0, 0
        for p, run in order:
            width, numbers = p.shape.coordinates, len(p.shape.reference(p.shape.default()))
            slots.append(Slot(p, run, slice(x, x + width), slice(ref, ref + numbers)))
            x, ref = x + width, ref + numbers
        return tuple(slots)

    @property
    def unknowns(self) -> int:
        """Number n of unknowns."""
        return sum(s.parameter.shape.coordinates for s in self.slots)

    @property
    def residual_count(self) -> int:
        """Number of scalar residuals."""
        return sum(len(run) for run in self.runs) * len(self.model.axes)

    @cached_property
    def _selections(self) -> tuple[tuple[Any, Any], ...]:
        """For each run: which unknowns and which references its samples see, in model order."""
        selections = []
        for r in range(len(self.runs)):
            own = {s.parameter.name: s for s in self.slots if s.run in (None, r)}
            order = [own[p.name] for p in self.model.parameters]
            selections.append((_indices(s.x for s in order), _indices(s.ref for s in order)))
        return tuple(selections)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """A name for every unknown: `gain[2]`, `tilt (run2)`, `direction (tangent 0)`."""
        names: list[str] = []
        for s in self.slots:
            own = s.parameter.entry_names
            if s.parameter.shape.curved:
                own = tuple(
                    f"{s.parameter.name} (tangent {k})"
                    for k in range(s.parameter.shape.coordinates)
                )
            suffix = (
                f" ({self.runs[s.run].name})" if s.run is not None and len(self.runs) > 1 else ""
            )
            names += [name + suffix for name in own]
        return tuple(names)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of every unknown, placeholders left in."""
        units: list[str] = []
        for s in self.slots:
            curved = s.parameter.shape.curved
            units += ["rad"] * s.parameter.shape.coordinates if curved else list(s.parameter.units)
        return tuple(units)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bound of every unknown; data may tighten the declared ones."""
        lower, upper = np.full(self.unknowns, -np.inf), np.full(self.unknowns, np.inf)
        from_data = self.model.limiter(self.model, self.runs) if self.model.limiter else {}
        for s in self.slots:
            if s.parameter.shape.curved:
                continue
            lower[s.x], upper[s.x] = s.parameter.lower, s.parameter.upper
            if s.parameter.name in from_data:
                low, high = from_data[s.parameter.name]
                lower[s.x] = np.maximum(lower[s.x], s.parameter.shape.spread(low))
                upper[s.x] = np.minimum(upper[s.x], s.parameter.shape.spread(high))
        return lower, upper

    # -- points --------------------------------------------------------------------------------

    def point(self, values: Mapping[str, Any]) -> Point:
        """Point with the given parameter values; per-run ones with a leading run axis if several.

        Missing parameters take their declared start. Values outside the bounds are moved inside.
        """
        unknown = set(values) - {p.name for p in self.model.parameters}
        if unknown:
            raise UsageError(f"model {self.model.name} has no parameter {sorted(unknown)[0]!r}")
        x, references = np.zeros(self.unknowns), np.zeros(self._reference_count)
        for s in self.slots:
            value = values.get(s.parameter.name)
            if value is not None and s.run is not None and self._has_run_axis(s.parameter, value):
                value = np.asarray(value)[s.run]
            shape = s.parameter.shape
            packed = s.parameter.start_value() if value is None else shape.pack(value)
            if shape.curved:
                references[s.ref] = shape.reference(shape.unpack(packed))
            else:
                x[s.x] = packed
        return Point(self.inside(x), references)

    def _has_run_axis(self, parameter: Parameter, value: Any) -> bool:
        return np.ndim(value) == len(parameter.shape.dims) + 1

    @property
    def _reference_count(self) -> int:
        return self.slots[-1].ref.stop if self.slots else 0

    def inside(self, x: Array) -> Array:
        """The unknowns, moved strictly inside their bounds where they are not."""
        lower, upper = self.bounds
        width = np.where(np.isfinite(lower) & np.isfinite(upper), upper - lower, np.inf)
        margin = np.minimum(1e-8 * np.maximum(1.0, np.abs(x)), 0.1 * width)
        inside = np.where(x <= lower, lower + margin, x)
        return np.where(inside >= upper, upper - margin, inside)

    def start(self) -> Point:
        """The automatic start: the model's function of the data, else the declared values."""
        values = self.model.starter(self.model, self.runs) if self.model.starter else {}
        known = {p.name for p in self.model.parameters}
        return self.point({k: v for k, v in values.items() if k in known})

    def moved(self, point: Point, step: Array) -> Point:
        """The point after a step, with directions and rotations in a chart around themselves."""
        x, references = point.x + step, point.references.copy()
        for s in self.slots:
            shape = s.parameter.shape
            if shape.curved:
                value = self._charted(s, x[s.x], references[s.ref])
                references[s.ref], x[s.x] = shape.reference(value), 0.0
        return Point(x, references)

    def difference(self, point: Point, other: Point) -> Array:
        """Unknowns of `point` minus those of `other`, (n,); on curved sets in the latter's chart,
        to first order."""
        away = point.x - other.x
        for s in self.slots:
            shape = s.parameter.shape
            if shape.curved:
                here, there = (
                    self._charted(s, p.x[s.x], p.references[s.ref]) for p in (point, other)
                )
                away[s.x] = shape.tangent(here, shape.reference(there))
        return away

    def _charted(self, slot: Slot, x: Array, reference: Array) -> Array:
        value = ca.evalf(chart(slot.parameter.shape.kind, ca.SX(ca.DM(x)), ca.SX(ca.DM(reference))))
        return np.array(value).reshape(slot.parameter.shape.dims)

    def values(self, point: Point) -> dict[str, Array]:
        """Parameter values by name; per-run ones with a leading run axis if there are several."""
        found: dict[str, list[Array]] = {p.name: [] for p in self.model.parameters}
        for s in self.slots:
            shape = s.parameter.shape
            if shape.curved:
                value = self._charted(s, point.x[s.x], point.references[s.ref])
            else:
                value = shape.unpack(point.x[s.x])
            found[s.parameter.name].append(value)
        several = len(self.runs) > 1
        per_run = {p.name for p in self.model.parameters if p.scope == "run"}
        return {n: np.stack(v) if several and n in per_run else v[0] for n, v in found.items()}

    def spread(self, point: Point, covariance: Array) -> dict[str, Array]:
        """Standard deviation of every value, of the value's shape, from the covariance of x."""
        found: dict[str, list[Array]] = {p.name: [] for p in self.model.parameters}
        for s in self.slots:
            shape, block = s.parameter.shape, covariance[s.x, s.x]
            if shape.curved:
                jacobian = self._chart_jacobian(s, point)
                std = _root(np.diag(jacobian @ block @ jacobian.T)).reshape(shape.dims)
            else:
                std = shape.unpack(_root(np.diag(block)))
            found[s.parameter.name].append(std)
        several = len(self.runs) > 1
        per_run = {p.name for p in self.model.parameters if p.scope == "run"}
        return {n: np.stack(v) if several and n in per_run else v[0] for n, v in found.items()}

    def _chart_jacobian(self, slot: Slot, point: Point) -> Array:
        c = ca.SX.sym("c", slot.parameter.shape.coordinates)
        value = chart(slot.parameter.shape.kind, c, ca.SX(ca.DM(point.references[slot.ref])))
        flat = ca.vec(value.T) if value.shape == (3, 3) else value
        f = ca.Function("chart", [c], [ca.jacobian(flat, c)])
        return np.array(f(point.x[slot.x]))

    # -- evaluation ----------------------------------------------------------------------------

    @cached_property
    def samples(self) -> tuple[Array, ...]:
        """Signals of each run side by side, (N, k)."""
        stacked = []
        for run in self.runs:
            missing = [s.name for s in self.model.signals if s.name not in run.signals]
            if missing:
                raise DataError(f"{run.file}: no data for signal {missing[0]!r}; add --columns")
            stacked.append(np.hstack([run.signals[s.name] for s in self.model.signals]))
        return tuple(np.ascontiguousarray(s, dtype=float) for s in stacked)

    @property
    def _with_jacobian(self) -> Replay:
        return residual_and_jacobian(self.model)

    @cached_property
    def _recursion(self) -> Recursion | None:
        """Where an effect acts on the sequence of samples, rows come from a recursion."""
        sequential = any(a.kind == "sequence" for a in self.model.effects)
        return Recursion(self.model) if sequential else None

    def _rows(self, point: Point, r: int) -> tuple[Array, Array]:
        """Residuals (N, m) and Jacobians (N, m, n of the run) of one run, unweighted."""
        parameters = self._parameters(point, r)
        if self._recursion is not None:
            return self._recursion.rows(parameters, self.samples[r], self.runs[r])
        return rows(self._with_jacobian, parameters, self.samples[r])

    def _weighted_rows(self, point: Point, r: int) -> Array:
        """[J r] of one run, weighted, (N·m, n + 1)."""
        residual, jacobian = self._rows(point, r)
        both = np.concatenate([jacobian, residual[:, :, None]], axis=2)
        weights = self._weight(r)
        if weights is not None:
            both = both * np.sqrt(weights)[:, :, None]
        return both.reshape(-1, both.shape[2])

    def _run_cost(self, point: Point, r: int) -> float:
        if self._recursion is not None:
            return 0.5 * float(np.sum(self._weighted_rows(point, r)[:, -1] ** 2))
        parameters = self._parameters(point, r)
        return cost(self._with_jacobian, parameters, self.samples[r], self._weight(r))

    def _run_normal(self, point: Point, r: int) -> Normal:
        if self._recursion is not None:
            both = self._weighted_rows(point, r)
            product = both.T @ both
            return Normal(0.5 * float(product[-1, -1]), product[:-1, -1], product[:-1, :-1])
        parameters = self._parameters(point, r)
        return normal_equations(self._with_jacobian, parameters, self.samples[r], self._weight(r))

    def _run_factor(self, point: Point, r: int) -> Array:
        if self._recursion is not None:
            return np.asarray(np.linalg.qr(self._weighted_rows(point, r), mode="r"))
        parameters = self._parameters(point, r)
        return triangular_factor(self._with_jacobian, parameters, self.samples[r], self._weight(r))

    def _parameters(self, point: Point, r: int) -> Array:
        x, ref = self._selections[r]
        return np.concatenate([point.x[x], point.references[ref]])

    def _weight(self, r: int) -> Array | None:
        return None if self.weights is None else self.weights[r]

    def cost(self, point: Point) -> float:
        """½ Σ w r²."""
        return sum(self._run_cost(point, r) for r in range(len(self.runs)))

    def normal(self, point: Point) -> Normal:
        """Cost, gradient (n,) and Gauss-Newton matrix (n, n)."""
        total, gradient = 0.0, np.zeros(self.unknowns)
        matrix = np.zeros((self.unknowns, self.unknowns))
        for r in range(len(self.runs)):
            x = self._selections[r][0]
            own = self._run_normal(point, r)
            total += own.cost
            gradient[x] += own.gradient
            matrix[np.ix_(x, x)] += own.matrix
        return Normal(total, gradient, matrix)

    def run_normals(self, point: Point) -> list[tuple[Any, Normal]]:
        """For each run the unknowns it sees and its own normal equations in them."""
        return [(self._selections[r][0], self._run_normal(point, r)) for r in range(len(self.runs))]

    def factor(self, point: Point) -> tuple[Array, Array, float]:
        """Triangular factor of J, Qᵀr (n,), and the norm of the rest of r: no squared condition.

        JᵀJ = RᵀR, Jᵀr = Rᵀ(Qᵀr), ‖r‖² = ‖Qᵀr‖² + rest².
        """
        n, blocks = self.unknowns, []
        for r in range(len(self.runs)):
            x = self._selections[r][0]
            own = self._run_factor(point, r)
            block = np.zeros((len(own), n + 1))
            block[:, [*x, n]] = own
            blocks.append(block)
        whole = np.vstack(blocks)
        if len(self.runs) > 1:
            whole = np.asarray(np.linalg.qr(whole, mode="r"))
        full = np.zeros((n + 1, n + 1))
        full[: len(whole)] = whole[: n + 1]
        return full[:n, :n], full[:n, n], float(abs(full[n, n]))

    def hessian(self, point: Point) -> Array:
        """Exact second derivative of the cost, (n, n); Gauss-Newton for sequences of samples."""
        if self._recursion is not None:
            return self.normal(point).matrix
        matrix = np.zeros((self.unknowns, self.unknowns))
        for r, samples in enumerate(self.samples):
            x = self._selections[r][0]
            weights = self._weight(r)
            if weights is None:
                weights = np.ones((len(samples), len(self.model.axes)))
            with_weights = np.hstack([samples, weights])
            own = curvature(self.model).sum(self._parameters(point, r), with_weights)
            matrix[np.ix_(x, x)] += own
        return matrix

    def residuals(self, point: Point) -> tuple[Array, ...]:
        """Residuals of each run, (N, m)."""
        return tuple(self._rows(point, r)[0] for r in range(len(self.runs)))

    def jacobian(self, point: Point) -> Array:
        """The whole Jacobian, (residuals, n), unweighted; for small problems and tests."""
        parts = []
        for r in range(len(self.runs)):
            _, own = self._rows(point, r)
            part = np.zeros((own.shape[0] * own.shape[1], self.unknowns))
            part[:, self._selections[r][0]] = own.reshape(-1, own.shape[2])
            parts.append(part)
        return np.vstack(parts)

    def squares_of_gradients(
        self, point: Point, batches: Sequence[NDArray[np.int_]], bread: Array | None = None
    ) -> Array:
        """Σ_batch (Σ w r ∂r)(Σ w r ∂r)ᵀ: the middle of the sandwich covariance, (n, n).

        `batches` numbers the samples of each run; those of one batch may be correlated. With
        `bread` = (JᵀWJ)⁻¹ every residual is first divided by what the fit leaves of it, 1 − h.
        """
        middle = np.zeros((self.unknowns, self.unknowns))
        for r in range(len(self.runs)):
            x, weights = self._selections[r][0], self._weight(r)
            residual, jacobian = self._rows(point, r)
            if bread is not None:
                residual = _without_leverage(residual, jacobian, bread[np.ix_(x, x)], weights)
            if weights is not None:
                residual = residual * weights
            scores = np.einsum("nm,nmk->nk", residual, jacobian)
            sums = np.zeros((int(batches[r].max(initial=-1)) + 1, scores.shape[1]))
            np.add.at(sums, batches[r], scores)
            middle[np.ix_(x, x)] += sums.T @ sums
        return middle

    def evaluate(self, point: Point, outputs: Mapping[str, Any]) -> list[list[Array]]:
        """Expressions of the trace for every sample of every run, each (N, rows, columns)."""
        replay = Replay(function_of(self.model, outputs))
        return [replay(self._parameters(point, r), s) for r, s in enumerate(self.samples)]

    def rounding(self, point: Point) -> float:
        """Rounding error of one residual: machine precision of all that was added up in it."""
        squares, count = 0.0, 0
        for r, samples in enumerate(self.samples):
            parameters = self._parameters(point, r)
            slopes, x = slope_in_sample(self.model)(parameters, samples)[0], self._selections[r][0]
            jacobian = self._rows(point, r)[1]
            terms = np.sum(np.abs(slopes * samples[:, None, :]), axis=2)
            terms += np.sum(np.abs(jacobian * point.x[x]), axis=2)
            squares, count = squares + float(np.sum(terms**2)), count + terms.size
        return float(4 * np.finfo(float).eps * np.sqrt(squares / max(count, 1)) + 1e-300)

    def second_order(self, point: Point, sigma: float) -> float:
        """Root mean square of ½σ²·∇²r over σ: what an implicit residual neglects of the noise.

        Zero for explicit models, whose residual is linear in the noise of the reading.
        """
        if not self.model.implicit:
            return 0.0
        replay = laplacian(self.model)
        values = [replay(self._parameters(point, r), s)[0] for r, s in enumerate(self.samples)]
        squares = np.concatenate([v.ravel() ** 2 for v in values])
        return float(0.5 * sigma * np.sqrt(np.mean(squares)))

    def second_order_bias(self, point: Point, sigma: float, bread: Array) -> Array:
        """Shift of the unknowns (n,) by what an implicit residual neglects of the noise.

        Noise of σ in every component of the reading shifts each residual by ½σ²·∇²r on average.
        """
        slope = np.zeros(self.unknowns)
        if not self.model.implicit:
            return slope
        replay = laplacian(self.model)
        for r, samples in enumerate(self.samples):
            shift = 0.5 * sigma**2 * replay(self._parameters(point, r), samples)[0][:, :, 0]
            jacobian, x = self._rows(point, r)[1], self._selections[r][0]
            np.add.at(slope, x, np.einsum("nm,nmk->k", shift, jacobian))
        return np.asarray(-bread @ slope)

    def repeat_noise(self, point: Point) -> float | None:
        """Root mean square of the residual's noise that the scatter within rest intervals implies.

        None where no signal carries a spread of its own.
        """
        if not any(run.spread for run in self.runs):
            return None
        squares, count = 0.0, 0
        for r, run in enumerate(self.runs):
            G = slope_in_sample(self.model)(self._parameters(point, r), self.samples[r])[0]
            first = 0
            for s in self.model.signals:
                own, first = G[:, :, first : first + s.size], first + s.size
                if s.name in run.spread:
                    squares += float(np.einsum("nmi,nij,nmj->", own, run.covariance(s.name), own))
            count += G.shape[0] * G.shape[1]
        return float(np.sqrt(squares / count))

    def with_weights(self, weights: Sequence[Array] | None) -> Problem:
        """The same problem with other weights on the squares."""
        return replace(self, weights=None if weights is None else tuple(weights))


def _without_leverage(
    residual: Array, jacobian: Array, bread: Array, weights: Array | None
) -> Array:
    """(I − H)⁻¹r sample by sample: what the residual would be had the fit not seen it."""
    leverage = np.einsum("nmi,ij,nkj->nmk", jacobian, bread, jacobian)
    if weights is not None:
        leverage = leverage * weights[:, None, :]
    left = np.eye(residual.shape[1]) - np.where(np.isfinite(leverage), leverage, 0.0)
    # A residual that the fit follows entirely says nothing: keep the inverse finite.
    values, vectors = np.linalg.eigh(0.5 * (left + left.transpose(0, 2, 1)))
    inverse = (vectors / np.maximum(values, 1e-3)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.asarray(np.einsum("nmk,nk->nm", inverse, residual))


def _root(variance: Array) -> Array:
    """Standard deviation; rounding may leave a vanishing variance below zero, NaN stays NaN."""
    return np.sqrt(np.where(variance < 0, 0.0, variance))


def _indices(slices: Any) -> Any:
    parts = [np.arange(s.start, s.stop) for s in slices]
    return np.concatenate(parts) if parts else np.zeros(0, dtype=int)
