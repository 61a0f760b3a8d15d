"""Rows that are looked at: residuals and slopes there, what is held out, what the sensor met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME
from casest.declaration.shapes import Array
from casest.diagnose.candidates.slopes import rows_of
from casest.diagnose.evidence.held_inputs import plateaus_of, settled_rows
from casest.diagnose.evidence.held_out import share_taken
from casest.diagnose.evidence.linear import Index, Linear, parts_of, spans_of
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.averages import averages, best_mean
from casest.diagnose.noise.of_inputs import at_once
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.recent import Recent
from casest.leastsquares.kinds import noises
from casest.leastsquares.problem import Point, Problem


@dataclass(frozen=True)
class Rows:
    """Rows of runs (prepared), chosen evenly, and fits as linear problems in them."""

    runs: tuple[Run, ...]
    _linears: Recent[Fit, Linear] = field(default_factory=lambda: Recent(16), repr=False)
    _settled: Recent[Fit, NDArray[np.bool_]] = field(default_factory=Recent, repr=False)

    def linear(self, fit: Fit) -> Linear:
        """Residuals and slopes in the rows that are looked at."""
        return self._linears.of(fit, lambda: self._linear(fit))

    def _linear(self, fit: Fit) -> Linear:
        residual, J, roots = self.slopes(*problem_of(fit, self.runs))
        met = self.met(fit)
        parts, held = parts_of(*self._numbers, met), plateaus_of(met, self._spans)
        found = Linear(residual, J, self._spans, parts, self._least(fit), held, roots)
        mean = self.best_mean(fit, found)
        if mean is None:
            return found
        most = share_taken(found, mean) > LEVELS.most
        if most and self._comes_late(fit, found, mean):
            return found
        return replace(found, feigned=mean[:, :, None], counts=most)

    def _comes_late(self, fit: Fit, linear: Linear, mean: Array) -> bool:
        """Do rows before alone take more than before and after? Noise of inputs is in both."""
        before = self.best_mean(fit, linear, after=False)
        plain = replace(linear, counts=False)
        return before is not None and share_taken(plain, before) > share_taken(plain, mean)

    def best_mean(self, fit: Fit, linear: Linear, *, after: bool = True) -> Array | None:
        """What the best mean of inputs over rows before, and `after`, takes away (N, m)."""
        if not self._spans:
            return None
        found = averages(*problem_of(fit, self.runs), after=after)
        if found is None:
            return None
        told = np.any(linear.residual, axis=1) | np.any(linear.slopes, axis=(1, 2))
        columns = self.of(found) * linear.root[:, :, None] * told[:, None, None]
        return best_mean(linear.residual, replace(linear, counts=False).basis, columns)

    def of(self, values: Sequence[Array]) -> Array:
        """Values of each run (N, …) in the rows that are looked at, one run after the other."""
        return np.concatenate([np.asarray(v)[k] for v, k in zip(values, self.index, strict=True)])

    @cached_property
    def index(self) -> list[Index]:
        """Rows of each run that are looked at."""
        return rows_of(self.runs, LEVELS.rows)

    def slopes(self, problem: Problem, point: Point) -> tuple[Array, Array, Array]:
        """Residuals (N, m), their slopes (N, m, p) and the roots of their weights in these rows."""
        axes = len(problem.model.axes)
        offsets = np.cumsum([0, *map(len, self.index)])
        r, J = np.zeros((offsets[-1], axes)), np.zeros((offsets[-1], axes, problem.unknowns))
        roots = np.ones_like(r)
        for block in problem.blocks(point):
            rows = self.index[block.run]
            inside = (rows >= block.span.start) & (rows < block.span.stop)
            here, chosen = offsets[block.run] + np.flatnonzero(inside), rows[inside]
            local = chosen - block.span.start
            root = np.ones((1, 1)) if block.weights is None else np.sqrt(block.weights[local])
            r[here], roots[here] = block.residual[local] * root, root
            own = np.zeros((len(here), axes, problem.unknowns))
            own[:, :, block.x] = block.jacobian[local]
            J[here] = own * root[:, :, None]
        return r, np.nan_to_num(J), roots

    def cosines(self, waves: int) -> Array:
        """(N, runs · waves): 1, 2, … half waves over each run, in the rows that are looked at."""
        found = np.zeros((sum(map(len, self.index)), len(self.runs), waves))
        first = 0
        for k, (run, rows) in enumerate(zip(self.runs, self.index, strict=True)):
            time = np.arange(len(run)) if run.time is None else np.asarray(run.time)
            share = (time[rows] - time[0]) / max(float(np.ptp(time)), 1e-300)
            own = slice(first, first + len(rows))
            found[own, k] = np.cos(np.pi * share[:, None] * np.arange(1, waves + 1))
            first += len(rows)
        return found.reshape(len(found), -1)

    @cached_property
    def _numbers(self) -> tuple[Index, Index]:
        """Block and run of each row."""
        blocks = [run.block[rows] for run, rows in zip(self.runs, self.index, strict=True)]
        runs = [np.full(len(rows), k) for k, rows in enumerate(self.index)]
        return np.concatenate(blocks), np.concatenate(runs)

    @cached_property
    def _spans(self) -> tuple[slice, ...]:
        """Where the noise may have a colour: in single readings with a time."""
        total = sum(map(len, self.index))
        in_time = all(run.time is not None and not run.spread for run in self.runs)
        return spans_of(*self._numbers) if in_time and total >= LEVELS.series else ()

    def _least(self, fit: Fit) -> float:
        """Slopes of an implicit residual contain the residual: what survives must be more."""
        if not fit.model.implicit or noises(fit.model):  # or is counted in deviations
            return LEVELS.survives
        names = [
            s.name
            for s in fit.model.signals
            if s.name != "t" and s.kind == "plain" and s.name not in self.runs[0].columns
        ]
        sizes = [
            float(np.sqrt(np.mean(np.concatenate([r.signals[n] for r in self.runs]) ** 2)))
            for n in names
        ]
        noise = fit.noise / max(min(sizes, default=np.inf), 1e-300)
        return max(LEVELS.survives, LEVELS.over_noise * noise)

    def settled(self, fit: Fit) -> NDArray[np.bool_]:
        """In which rows (N,) what the sensor met is held at a level, and has been."""
        return self._settled.of(fit, lambda: settled_rows(self.met(fit), self._spans))

    def met(self, fit: Fit) -> Array:
        """What the sensor met in each row (N, q): the corrected quantity, or the prediction."""
        traced = fit.model.along
        name = traced.corrected
        value = traced.quantities[name].value if name else traced.predicted
        if value is None:
            return np.zeros((len(self._numbers[0]), 1))
        problem, point = problem_of(fit, self.runs)
        over_time = any(a.kind in OVER_TIME for a in fit.model.effects)
        if over_time and not traced.integrates:
            return self.met(instant(fit))  # what it met is that without a memory as well
        found = problem.evaluate(point, {"q": value})
        return np.nan_to_num(self.of([f[0].reshape(len(f[0]), -1) for f in found]))


def instant(fit: Fit) -> Fit:
    """The fit without what looks at other samples."""
    model = at_once(fit.model)
    return replace(fit, model=model, values=model.among(fit.values))
