"""One least-squares problem from a model and its runs. The only place with index arithmetic.

The unknowns are one vector: parameters shared by all runs first (in the model's order), then the
parameters that each run has for itself, run after run. Every run sees its own selection of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.physics import chart
from casest.declaration.prior import root
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter
from casest.declaration.tracing import sample_symbol
from casest.engine import (
    Columns,
    Normal,
    Replay,
    cost,
    normal_equations,
    residuals,
    rows,
    summed,
    triangular_factor,
)
from casest.errors import DataError, NotTrusted, UsageError
from casest.leastsquares.constrained import FIRST, Constraints, Force, constraints_of
from casest.leastsquares.parabola import Factor, Look, factored, look_at
from casest.leastsquares.per_sample import linear, residual_and_jacobian
from casest.leastsquares.sequence import Staged


@dataclass(frozen=True)
class Slot:
    """One parameter's place: `x` in the unknowns, `ref` in the chart references."""

    parameter: Parameter
    run: int | None
    x: slice
    ref: slice


class Known(NamedTuple):
    """What is known of a slot before: its `value`, and its numbers in the prior's covariance."""

    slot: Slot
    value: Array
    entries: Any


@dataclass(frozen=True)
class Point:
    """A place in parameter space: unknowns `x` (n,) and the charts they are measured in."""

    x: Array
    references: Array


class Block(NamedTuple):
    """Consecutive samples of one run: `run` its number, `x` the unknowns that it sees.

    residual (N, m), jacobian (N, m, len(x)), weights (N, m) or None.
    """

    run: int
    x: Any
    span: slice
    residual: Array
    jacobian: Array
    weights: Array | None


#: Step of a difference, in standard deviations of an unknown alone.
NUDGE = 1e-3
#: Points whose normal equations are kept: a solution is asked for again by who judges it.
LATEST = 16
#: The same of triangular factors, which are asked for again at the point last reached.
FACTORS = 4
#: Samples that are evaluated at once where every residual is looked at on its own.
BLOCK = 32_768
#: Samples of a run that a model's own functions (a start, bounds from data) look at.
LOOKED = 1_000_000
#: Records smaller than this (numbers) are copied once into columns, which are quicker to read.
COPIED = 4_000_000


@dataclass(frozen=True)
class Problem:
    """The sum of squares of a model's residuals over runs.

    `weights` (one (N, m) array per run, or None) multiply the squares. Residuals are in the
    model's residual unit. Jacobians are with respect to the unknowns `x`. `whitening` (one
    (N·m, N·m) per run, or None) takes from residuals of rests what they share with those before.
    `states` (one (N, k) per run, or None): those of differential equations, where they are known.
    `force` is how the model's constraints are held (see `constrained`).
    """

    model: Model
    runs: tuple[Run, ...]
    weights: tuple[Array, ...] | None = None
    whitening: tuple[Array, ...] | None = None
    states: tuple[Array, ...] | None = None
    force: Force | None = None

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

    @cached_property
    def seen_runs(self) -> tuple[Run, ...]:
        """The runs as the model's own functions see them, at once: of a long one every k-th sample,
        as few as LOOKED."""
        every = [-(-len(run) // LOOKED) for run in self.runs]
        return tuple(run.take(slice(None, None, k)) if k > 1 else run
                     for run, k in zip(self.runs, every, strict=True))  # fmt: skip

    @cached_property
    def unknowns(self) -> int:
        """Number n of unknowns."""
        return sum(s.parameter.shape.coordinates for s in self.slots)

    @property
    def residual_count(self) -> int:
        """Number of scalar residuals; what is known before counts as one for each number."""
        every = sum(len(run) for run in self.runs) * len(self.model.axes)
        every -= sum(int(np.sum(~p)) for p in self.present if p is not None)
        every += sum(len(known.entries) for known in self.known_before)
        return every + self.kept_count

    def lost(self, r: int) -> Any:
        """Rests of a run before which a sensor was beyond its range, by number."""
        return np.zeros(0) if self._staged is None else self._staged.lost(r)

    @cached_property
    def present(self) -> tuple[Any, ...]:
        """Which residuals (N, m) of each run there are; None where all are."""
        staged = self._staged
        return tuple(None if staged is None else staged.present(r) for r in range(len(self.runs)))

    @cached_property
    def kept_count(self) -> int:
        """How many directions of the unknowns constraints hold as equations."""
        if self.constraints is None:
            return 0
        if self.force is None:
            return int(sum(np.sum(~limit) for limit in self.constraints.limits))
        held = [slopes[own] for (_, slopes), own in
                zip(self.kept_at(self.start()), self.force.held, strict=True)]  # fmt: skip
        whole = np.vstack(held)
        size = np.linalg.norm(whole, axis=0)
        return int(np.linalg.matrix_rank(whole / np.where(size > 0, size, 1.0), tol=1e-8))

    @property
    def noise_scale(self) -> float | None:
        """Standard deviation of a usual residual that was stated, or that a prior had."""
        if self.model.noise is not None:
            return self.model.noise.scale
        return None if self.model.prior is None else self.model.prior.sigma

    @cached_property
    def known_before(self) -> tuple[Known, ...]:
        """What a prior says, slot by slot: of a parameter of each run, the same in every run."""
        found, first = [], 0
        for name, value in ({} if self.model.prior is None else self.model.prior.by_name).items():
            own = [s for s in self.slots if s.parameter.name == name]
            entries = first + np.arange(own[0].parameter.shape.coordinates)
            found += [Known(s, value, entries) for s in own]
            first += len(entries)
        return tuple(found)

    @cached_property
    def prior_root(self) -> Array:
        """R (k, k) with RᵀR the inverse of the covariance of all that is known before."""
        assert self.model.prior is not None
        every = np.concatenate([known.entries for known in self.known_before])
        runs = np.repeat(
            [-1 if known.slot.run is None else known.slot.run for known in self.known_before],
            [len(known.entries) for known in self.known_before],
        )
        covariance = np.array(self.model.prior.covariance)[np.ix_(every, every)]
        return root(np.where(runs[:, None] == runs, covariance, 0.0))

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
    def _alone(self) -> bool:
        """Is there one run, with the unknowns in the same order?"""
        return len(self.runs) == 1 and np.array_equal(
            self._selections[0][0], np.arange(self.unknowns)
        )

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
        with np.errstate(all="ignore"):  # a reading of 1e300 has a square that is not finite
            from_data = self.model.limiter(self.model, self.seen_runs) if self.model.limiter else {}
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
        return self._start

    @cached_property
    def _start(self) -> Point:
        known_before = {} if self.model.prior is None else self.model.prior.by_name
        if {p.name for p in self.model.parameters} <= set(known_before):
            return self.point(known_before)
        try:
            values = self.model.starter(self.model, self.seen_runs) if self.model.starter else {}
        except np.linalg.LinAlgError as error:
            raise NotTrusted(
                f"{self.model.name}: no start values follow from these readings ({error}); are "
                "they all alike?"
            ) from error
        known = {p.name for p in self.model.parameters}
        return self.point({k: v for k, v in {**values, **known_before}.items() if k in known})

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
        value, _ = _chart(slot.parameter.shape.kind, len(x), len(reference))
        return np.array(value(x, reference)).reshape(slot.parameter.shape.dims)

    def charted_many(self, slot: Slot, x: Array, reference: Array) -> Array:
        """Entries (T, k) of a curved parameter from coordinates (T, c) around one reference."""
        value, _ = _chart(slot.parameter.shape.kind, x.shape[1], len(reference))
        found = np.array(value.map(len(x))(x.T, np.repeat(reference[:, None], len(x), axis=1)))
        return found.reshape(-1, len(x)).T

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
                jacobian = self.chart_slope(s, point)
                std = _root(np.diag(jacobian @ block @ jacobian.T)).reshape(shape.dims)
            else:
                std = shape.unpack(_root(np.diag(block)))
            found[s.parameter.name].append(std)
        several = len(self.runs) > 1
        per_run = {p.name for p in self.model.parameters if p.scope == "run"}
        return {n: np.stack(v) if several and n in per_run else v[0] for n, v in found.items()}

    def chart_slope(self, slot: Slot, point: Point) -> Array:
        """Slope (entries, coordinates) of a parameter's entries in its unknowns."""
        if not slot.parameter.shape.curved:
            return np.eye(slot.parameter.shape.size)
        x, reference = point.x[slot.x], point.references[slot.ref]
        _, slope = _chart(slot.parameter.shape.kind, len(x), len(reference))
        return np.array(slope(x, reference))

    # -- evaluation ----------------------------------------------------------------------------

    @cached_property
    def samples(self) -> tuple[Columns, ...]:
        """Signals of each run side by side, by column."""
        stacked = []
        for run in self.runs:
            missing = [s.name for s in self.model.columns if s.name not in run.signals]
            if missing:
                raise DataError(f"{run.file}: no data for signal {missing[0]!r}; add --columns")
            parts = [np.asanyarray(run.signals[s.name]) for s in self.model.columns]
            if sum(part.size for part in parts) <= COPIED:
                # Columns first: the kernel reads them in order.
                parts = [np.ascontiguousarray(part.T, dtype=float).T for part in parts]
            stacked.append(Columns(parts))
        return tuple(stacked)

    def thinned(self, every: int) -> Problem:
        """The same problem on one sample in `every`: for a start, never for a result."""
        if every not in self.shortened:
            spans = [slice(None, None, every)] * len(self.runs)
            self.shortened[every] = self.shorter(spans)
        return self.shortened[every]

    def shorter(self, spans: Sequence[slice]) -> Problem:
        """The same problem on one span of each run, which remembers the whole."""
        runs = tuple(run.take(span) for run, span in zip(self.runs, spans, strict=True))
        weights = self.weights
        if weights is not None:
            weights = tuple(w[span] for w, span in zip(weights, spans, strict=True))
        return Problem(self.model, runs, weights)

    def beginning(self, rows: int) -> Problem:
        """The same problem on so many first samples of each run: for a start, never for a result.

        What follows is not even looked at: equations are integrated so far alone.
        """
        runs = (run.take(slice(0, rows)) for run in self.runs)
        return Problem(self.model, tuple(replace(run, whole=None, places=None) for run in runs))

    @cached_property
    def shortened(self) -> dict[int | str, Problem]:
        """Shorter ones that were made of it."""
        return {}

    @property
    def sequential(self) -> bool:
        """Does a sample's residual depend on the samples before?"""
        return self._staged is not None

    @property
    def smooth(self) -> bool:
        """Are residuals smooth functions of the unknowns, as far as it is known? Not what effects
        with a memory make of them: a hysteresis has corners."""
        return not any(a.kind == "sequence" for a in self.model.effects)

    @cached_property
    def _with_jacobian(self) -> Replay:
        return residual_and_jacobian(self.model)

    def slopes_in_readings(self, point: Point, r: int) -> tuple[Array, Array, Array]:
        """∂r/∂s of one run's rests, (N, m, k) each: in their own means, in those before, and in all
        the readings of the turn between."""
        assert self._staged is not None
        return self._staged.slopes_in_readings(self.parameters(point, r), r)

    def as_taken(self, point: Point, r: int) -> Run:
        """One run with its signals at the times at which effects take them."""
        run = self.runs[r]
        if self._staged is None:
            return run
        late = self._staged.late(self.parameters(point, r), r)
        return replace(run, signals={**run.signals, **late}) if late else run

    def origin(self, r: int) -> tuple[Run, Any]:
        """The record that the samples of one run were taken from, and which of it they are."""
        assert self._staged is not None
        return self._staged.origin(r)

    @property
    def compiled(self) -> bool:
        """Have sums been computed by a compiled kernel? Else by NumPy, with other last digits."""
        return any(kernel is not None for kernel in self._with_jacobian.kernels.values())

    @cached_property
    def _staged(self) -> Staged | None:
        """Where an effect looks at other samples, rows come from the record as a whole."""
        if not self.model.sequential:
            return None
        return Staged(self.model, self.runs, self.whitening, self.states)

    def _rows(self, point: Point, r: int, span: slice = slice(None)) -> tuple[Array, Array]:
        """Residuals (N, m) and Jacobians (N, m, n of the run) of one run, unweighted."""
        parameters = self.parameters(point, r)
        if self._staged is not None:
            found = self._staged.rows(parameters, self.samples[r].dense, r)
            return found[0][span], found[1][span]
        return rows(self._with_jacobian, parameters, self.samples[r][span])

    def columns(self, point: Point, r: int, names: Collection[str]) -> Array:
        """Slopes (N, m, k) of one run's residuals in some of its parameters alone, unweighted."""
        own, place = [], 0
        for p in self.model.parameters:
            if p.name in names:
                own += list(range(place, place + p.shape.coordinates))
            place += p.shape.coordinates
        if self._staged is None:
            return self._rows(point, r)[1][:, :, own]
        parameters = self.parameters(point, r)
        return self._staged.rows(parameters, self.samples[r].dense, r, tuple(own))[1]

    def stopped(self, point: Point) -> str:
        """Where equations could not be followed, at which parameters, in words; empty: nowhere."""
        for r, run in enumerate(self.runs):
            words = (
                "" if self._staged is None else self._staged.stopped(self.parameters(point, r), r)
            )
            if words:
                x = self._selections[r][0]
                shown = ", ".join(f"{self.names[i]} = {point.x[i]:.4g}" for i in x)
                return f"{run.file or run.name}: {words} (at {shown})"
        return ""

    def followed(self, point: Point) -> tuple[Array, ...] | None:
        """States of differential equations along each record (N, k); None where there are none."""
        if self._staged is None or not self.model.traced.integrates:
            return None
        runs = range(len(self.runs))
        return tuple(self._staged.followed(self.parameters(point, r), r) for r in runs)

    def given(self, point: Point, r: int) -> Array:
        """What the effects that look at other samples give at the samples of one run (N, k)."""
        if self._staged is None:
            return np.zeros((len(self.runs[r]), 0))
        return self._staged.given(self.parameters(point, r), r, ())[0]

    @property
    def constraints(self) -> Constraints | None:
        """What the model keeps to, if to anything."""
        return constraints_of(self.model)

    def kept_at(self, point: Point) -> list[tuple[Array, Array]]:
        """Values (M,) of the constraints of each run, and their slopes (M, n) in all unknowns."""
        found = []
        for r, samples in enumerate(self.samples):
            assert self.constraints is not None
            parameters, dense = self.parameters(point, r), samples.dense
            given, slopes = np.zeros((len(dense), 0)), np.zeros((len(dense), 0, 0))
            if self._staged is not None:
                given, slopes = self._staged.given(parameters, r)
            c, own = self.constraints.at(parameters, dense, given, slopes)
            wide = np.zeros((len(c), self.unknowns))
            wide[:, self._selections[r][0]] = own
            found.append((c, wide))
        return found

    def forced(self, point: Point, weight: float, multipliers: Sequence[Array]) -> Problem:
        """The same with constraints held `weight` times as hard as the data say them at a point,
        with multipliers (M,) of each run."""
        assert self.constraints is not None
        sharp = np.diag(self.of_runs(point).matrix)
        variance = np.where(sharp > 0, 1 / np.where(sharp > 0, sharp, 1.0), 0.0)
        at, held, root = self.kept_at(point), [], []
        for samples, (_, slopes) in zip(self.samples, at, strict=True):
            std = np.sqrt(slopes**2 @ variance)
            root.append(weight / np.where(std > 0, std, np.max(std, initial=0.0) or 1.0))
            held.append(~self.constraints.limit(len(samples)))
        shift = [own / k**2 for own, k in zip(multipliers, root, strict=True)]
        return replace(self, force=Force(tuple(root), tuple(shift), tuple(held)))

    @cached_property
    def _force(self) -> Force:
        """How constraints are held where nothing is said: by no multiplier yet."""
        if self.force is not None:
            return self.force
        start = self.start()
        nothing = [np.zeros(len(c)) for c, _ in self.kept_at(start)]
        force = self.forced(start, FIRST, nothing).force
        assert force is not None
        return force

    def rows_beyond(self, point: Point) -> Array:
        """[J r] (k, n + 1) of all that is no reading: what is known before, and constraints."""
        parts = [np.zeros((0, self.unknowns + 1))]
        if self.model.prior is not None:
            parts.append(prior_rows(self, point))
        if self.constraints is not None:
            parts += [self._force.rows(r, *own) for r, own in enumerate(self.kept_at(point))]
        return np.vstack(parts)

    @cached_property
    def _bare(self) -> bool:
        """Are there readings alone?"""
        return self.model.prior is None and self.constraints is None

    def given_with_slopes(self, point: Point, r: int) -> tuple[Array, Array]:
        """What `given` says, with its slopes (N, k, n of the run)."""
        assert self._staged is not None
        return self._staged.given(self.parameters(point, r), r)

    def blocks(self, point: Point) -> Iterator[Block]:
        """Residuals and Jacobians of all samples, piece by piece, unweighted."""
        for r, samples in enumerate(self.samples):
            # A recursion has to be run through as a whole anyway.
            length = max(len(samples), 1) if self.sequential else BLOCK
            for start in range(0, len(samples), length):
                span = slice(start, min(start + length, len(samples)))
                weights = self._weight(r)
                residual, jacobian = self._rows(point, r, span)
                own = None if weights is None else weights[span]
                yield Block(r, self._selections[r][0], span, residual, jacobian, own)

    def _weighted_rows(self, point: Point, r: int) -> Array:
        """[J r] of one run, weighted, (N·m, n + 1)."""
        residual, jacobian = self._rows(point, r)
        both = np.concatenate([jacobian, residual[:, :, None]], axis=2)
        weights = self._weight(r)
        if weights is not None:
            both = both * np.sqrt(weights)[:, :, None]
        return both.reshape(-1, both.shape[2])

    def _run_cost(self, point: Point, r: int) -> float:
        if self._staged is not None:
            residual, weights = self._residuals(point, r), self._weight(r)
            return 0.5 * float(np.sum(residual**2 if weights is None else weights * residual**2))
        parameters = self.parameters(point, r)
        return cost(self._with_jacobian, parameters, self.samples[r], self._weight(r))

    def _run_normal(self, point: Point, r: int) -> Normal:
        if self._staged is not None:
            both = self._weighted_rows(point, r)
            product = both.T @ both
            return Normal(0.5 * float(product[-1, -1]), product[:-1, -1], product[:-1, :-1])
        parameters = self.parameters(point, r)
        return normal_equations(self._with_jacobian, parameters, self.samples[r], self._weight(r))

    def _run_factor(self, point: Point, r: int) -> Array:
        if self._staged is not None:
            return np.asarray(np.linalg.qr(self._weighted_rows(point, r), mode="r"))
        parameters = self.parameters(point, r)
        return triangular_factor(self._with_jacobian, parameters, self.samples[r], self._weight(r))

    def seen(self, r: int) -> tuple[Any, Any]:
        """Numbers of the unknowns and of the references that one run sees, in model order."""
        return self._selections[r]

    def parameters(self, point: Point, r: int) -> Array:
        """What the per-sample functions of one run are given: its unknowns and its references."""
        x, ref = self._selections[r]
        return np.concatenate([point.x[x], point.references[ref]])

    def _weight(self, r: int) -> Array | None:
        return None if self.weights is None else self.weights[r]

    def cost(self, point: Point) -> float:
        """½ Σ w r²."""
        if (told := self._told(point)) is not None:
            return told.cost
        own = sum(self._run_cost(point, r) for r in range(len(self.runs)))
        if self._bare:
            return own
        own += 0.5 * float(np.sum(self.rows_beyond(point)[:, -1] ** 2))
        return own if self.constraints is None else max(own - self._force.spared, 0.0)

    def normal(self, point: Point) -> Normal:
        """Cost, gradient (n,) and Gauss-Newton matrix (n, n); those of the last points are kept."""
        for known, normal in reversed(self._latest):
            if known is point:
                return normal
        told = self._told(point)
        if told is None:
            return self.looked_at(point)
        self._latest.append((point, told))
        return told

    def looked_at(self, point: Point) -> Normal:
        """The same from all samples, whatever follows from what was seen elsewhere."""
        normal = self._normal(point)
        if self.parabolic:
            look = look_at(point.x, normal)
            self._looks[:] = [] if look is None else [look]
            self._factors.clear()
        self._latest.append((point, normal))
        return normal

    @cached_property
    def _latest(self) -> deque[tuple[Point, Normal]]:
        return deque(maxlen=LATEST)

    @cached_property
    def judged(self) -> list[Any]:
        """What was asked last of all residuals, a point first, and what was found there."""
        return []

    @cached_property
    def parabolic(self) -> bool:
        """Is the cost a parabola in the unknowns, which one look at the samples tells?"""
        return linear(self.model) and self.constraints is None

    @property
    def told(self) -> bool:
        """Has one look at the samples told what the cost is around there?"""
        return bool(self._looks)

    @cached_property
    def _looks(self) -> list[Look]:
        """The last look at all samples, of a parabola, if it tells of other places."""
        return []

    def _told(self, point: Point) -> Normal | None:
        """What follows from the last look."""
        return next((look.normal_at(point.x) for look in self._looks), None)

    def _normal(self, point: Point) -> Normal:
        own = self.of_runs(point)
        if self._bare:
            return own
        rows = self.rows_beyond(point)
        product = rows.T @ rows
        total = own.cost + 0.5 * float(product[-1, -1])
        if self.constraints is not None:
            total = max(total - self._force.spared, 0.0)
        return Normal(total, own.gradient + product[:-1, -1], own.matrix + product[:-1, :-1])

    def of_runs(self, point: Point) -> Normal:
        """Normal equations of the readings alone."""
        if self._alone:
            return self._run_normal(point, 0)
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

    def factor(self, point: Point) -> Factor:
        """Triangular factor of J, Qᵀr (n,), and the norm of the rest of r.

        JᵀJ = RᵀR, Jᵀr = Rᵀ(Qᵀr), ‖r‖² = ‖Qᵀr‖² + rest². From the normal equations where the
        squared condition number leaves eight digits, else from the rows. Those of the last points
        are kept.
        """
        for known, factor in self._factors:
            if known is point:
                return factor
        found = self._factor(point)
        self._factors.append((point, found))
        return found

    @cached_property
    def _factors(self) -> deque[tuple[Point, Factor]]:
        return deque(maxlen=FACTORS)

    def _factor(self, point: Point) -> Factor:
        normal = self.normal(point)
        for look in self._looks:
            if look.normal_at(point.x) is not None:
                return look.factor_at(point.x)
        return factored(normal) or self._factor_of_rows(point)

    def _factor_of_rows(self, point: Point) -> Factor:
        n, blocks = self.unknowns, []
        for r in range(len(self.runs)):
            x = self._selections[r][0]
            own = self._run_factor(point, r)
            block = np.zeros((len(own), n + 1))
            block[:, [*x, n]] = own
            blocks.append(block)
        if not self._bare:
            blocks.append(self.rows_beyond(point))
        whole = np.vstack(blocks)
        if len(blocks) > 1:
            whole = np.asarray(np.linalg.qr(whole, mode="r"))
        full = np.zeros((n + 1, n + 1))
        full[: len(whole)] = whole[: n + 1]
        return full[:n, :n], full[:n, n], float(abs(full[n, n]))

    def hessian(self, point: Point) -> Array:
        """Exact second derivative of the cost, (n, n); Gauss-Newton where effects have a memory."""
        matrix = self.normal(point).matrix.copy()
        if self.parabolic:
            return matrix
        if self._staged is not None or self.constraints is not None:
            return self._differences(point, matrix) if self.smooth else matrix
        for r, samples in enumerate(self.samples):
            x = self._selections[r][0]
            weights = self._weight(r)
            if weights is None:
                weights = np.broadcast_to(1.0, (len(samples), len(self.model.axes)))
            with_weights = samples.with_more(weights)
            own = summed(_bend(self.model), self.parameters(point, r), with_weights)
            matrix[np.ix_(x, x)] += own + np.triu(own, 1).T
        return matrix

    def _differences(self, point: Point, matrix: Array) -> Array:
        """The Hessian by central differences of the slope, which is exact.

        Steps are a thousandth of a standard deviation of each unknown alone: small beside what the
        cost is curved over, large beside rounding.
        """
        freedom = max(self.residual_count - self.unknowns, 1)
        sigma = np.sqrt(2 * self.normal(point).cost / freedom)
        column = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        rounding = 1e-9 * np.maximum(np.abs(point.x), 1e-300)
        found = np.zeros_like(matrix)
        for j, size in enumerate(np.maximum(NUDGE * sigma / column, rounding)):
            step = np.zeros(self.unknowns)
            step[j] = size
            ahead, behind = (self.normal(Point(point.x + s, point.references)).gradient
                             for s in (step, -step))  # fmt: skip
            found[:, j] = (ahead - behind) / (2 * size)
        return 0.5 * (found + found.T)

    def residuals(self, point: Point) -> tuple[Array, ...]:
        """Residuals of each run, (N, m)."""
        return tuple(self._residuals(point, r) for r in range(len(self.runs)))

    def told_residuals(self, point: Point) -> tuple[Array, ...]:
        """The same, NaN where there is none."""
        found = zip(self.residuals(point), self.present, strict=True)
        return tuple(r if there is None else np.where(there, r, np.nan) for r, there in found)

    def _residuals(self, point: Point, r: int, span: slice = slice(None)) -> Array:
        parameters = self.parameters(point, r)
        if self._staged is not None:  # without slopes
            return self._staged.rows(parameters, self.samples[r].dense, r, ())[0][span]
        return residuals(self._with_jacobian, parameters, self.samples[r][span])

    def residual_blocks(self, point: Point) -> Iterator[tuple[int, slice, Array]]:
        """Run, span and residuals (N, m) of all samples, piece by piece."""
        for r, samples in enumerate(self.samples):
            length = max(len(samples), 1) if self.sequential else BLOCK
            for start in range(0, len(samples), length):
                span = slice(start, min(start + length, len(samples)))
                yield r, span, self._residuals(point, r, span)

    def jacobian(self, point: Point) -> Array:
        """The whole Jacobian, (residuals, n), unweighted; for small problems and tests."""
        parts = []
        for r in range(len(self.runs)):
            _, own = self._rows(point, r)
            part = np.zeros((own.shape[0] * own.shape[1], self.unknowns))
            part[:, self._selections[r][0]] = own.reshape(-1, own.shape[2])
            parts.append(part)
        return np.vstack(parts)

    def evaluate(self, point: Point, outputs: Mapping[str, Any]) -> list[list[Array]]:
        """Expressions of the trace for every sample of every run, each (N, rows, columns).

        Of differential equations those of `model.along`, in which states are what they are there.
        """
        every = self._along(outputs)
        return [every(point, r, slice(None)) for r in range(len(self.runs))]

    def evaluated_pieces(self, point: Point, outputs: Mapping[str, Any]) -> Iterator[list[Array]]:
        """The same piece by piece: of a long record there is no room for all at once."""
        every = self._along(outputs)
        for r, samples in enumerate(self.samples):
            length = max(len(samples), 1) if self.sequential else BLOCK
            for start in range(0, len(samples), length):
                yield every(point, r, slice(start, min(start + length, len(samples))))

    def _along(self, outputs: Mapping[str, Any]) -> Callable[[Point, int, slice], list[Array]]:
        traced = self.model.along
        given = ca.vertcat(ca.SX(0, 1), *(stage.given for stage in traced.stages))
        sample = ca.vertcat(sample_symbol(self.model, traced), given)
        inputs = [ca.vertcat(traced.coordinates, traced.references), sample]
        values = [ca.SX(v) for v in outputs.values()]
        f = ca.Function("along", inputs, values, ["parameters", "sample"], list(outputs))
        replay = Replay(f)

        def evaluated(point: Point, r: int, span: slice) -> list[Array]:
            samples = self.samples[r]
            if given.numel():
                samples = Columns([samples.dense, self.given(point, r)])
            return replay(self.parameters(point, r), samples[span])

        return evaluated

    def with_weights(self, weights: Sequence[Array] | None) -> Problem:
        """The same problem with other weights on the squares."""
        return replace(self, weights=None if weights is None else tuple(weights))


def prior_rows(problem: Problem, point: Point) -> Array:
    """[J r] (k, n + 1) of what is known before: coordinates off the prior's, in residual units."""
    prior, scale = problem.model.prior, problem.noise_scale
    assert prior is not None
    if scale is None:
        raise UsageError(
            f"{problem.model.name}: how much {prior.source} weighs is open, since the noise of the "
            "readings is not stated: measured(…, std=…), or --sensor-noise SIGNAL=STD"
        )
    parts = []
    for slot, before, entries in problem.known_before:
        shape, part = slot.parameter.shape, np.zeros((len(entries), problem.unknowns))
        if shape.curved:
            reference = shape.reference(before)
            here = problem._charted(slot, point.x[slot.x], point.references[slot.ref])
            off = shape.tangent(here, reference)
            steps = problem.chart_slope(slot, point).T.reshape(-1, *shape.dims)
            part[:, slot.x] = np.stack([shape.tangent(s, reference) for s in steps], axis=1)
        else:
            off, part[:, slot.x] = point.x[slot.x] - shape.pack(before), np.eye(len(part))
        parts.append(np.column_stack([part, off]))
    return np.asarray(scale * problem.prior_root @ np.vstack(parts))


@lru_cache(maxsize=8)
def _chart(kind: str, coordinates: int, references: int) -> tuple[Any, Any]:
    """A chart's value, and the slope of its entries row by row, of coordinates and reference."""
    c, reference = ca.SX.sym("c", coordinates), ca.SX.sym("reference", references)
    value = chart(kind, c, reference)
    flat = ca.vec(value.T) if value.shape == (3, 3) else value
    slope = ca.jacobian(flat, c)
    arguments = [c, reference]
    return ca.Function("chart", arguments, [value]), ca.Function("slope", arguments, [slope])


@lru_cache(maxsize=64)
def _bend(model: Model) -> Replay:
    """Σ w r ∂²r of one sample, upper triangle: what the Hessian of ½rᵀWr has beyond JᵀWJ.

    The weights arrive as further signals.
    """
    t, count = model.traced, model.traced.expression.numel()
    w, force = ca.SX.sym("w", count), ca.SX.sym("force", count)
    second = ca.triu(ca.hessian(ca.dot(force, t.expression), t.coordinates)[0])
    bend = ca.substitute(second, force, w * t.expression)
    sample = ca.vertcat(sample_symbol(model), w)
    parameters = ca.vertcat(t.coordinates, t.references)
    return Replay(ca.Function("h", [parameters, sample], [bend], ["parameters", "sample"], ["H"]))


def _root(variance: Array) -> Array:
    """Standard deviation; rounding may leave a vanishing variance below zero, NaN stays NaN."""
    return np.sqrt(np.where(variance < 0, 0.0, variance))


def _indices(slices: Any) -> Any:
    parts = [np.arange(s.start, s.stop) for s in slices]
    return np.concatenate(parts) if parts else np.zeros(0, dtype=int)
