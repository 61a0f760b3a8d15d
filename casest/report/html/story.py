"""What a report tells about residuals: one fit, or two side by side, over the same samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import usable_columns
from casest.diagnose.closing import Closing
from casest.diagnose.misfit.dependence import Variable, variables
from casest.effects.placing import prepared
from casest.estimate.calibrate import Estimate
from casest.estimate.correlation import is_series
from casest.leastsquares.problem import Problem
from casest.results.units import unit_table

#: Half width of a 95 % band in standard deviations.
BAND = 1.96


@dataclass(frozen=True)
class Side:
    """Residuals (N, m) of each run after one fit; `look` is its colour."""

    name: str
    look: str
    estimate: Estimate
    residuals: tuple[Array, ...]


@dataclass(frozen=True)
class Story:
    """Sides over the runs; `sigma` (m,) is the noise of one residual on each axis."""

    runs: tuple[Run, ...]
    sides: tuple[Side, ...]
    sigma: Array
    unit: str
    correlated_over: float

    @property
    def last(self) -> Estimate:
        """The estimate that a reader takes away."""
        return self.sides[-1].estimate

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the residual's components."""
        return self.last.model.axes

    @property
    def series(self) -> bool:
        """Are the samples a record in time, so that neighbours and frequencies mean something?"""
        return all(is_series(run) for run in self.runs)

    @property
    def kind(self) -> str:
        """What one sample is called."""
        return "rest interval" if self.runs[0].spread else "sample"

    def panels(self) -> Iterator[tuple[int, Side, str]]:
        """Axis number, side and title of each panel, before beside after."""
        for a, name in enumerate(self.axes):
            for side in self.sides:
                component = "" if len(self.axes) == 1 else f"{name}, "
                yield a, side, f"{component}{side.name}"

    def of_axis(self, what: str, a: int) -> str:
        """What is drawn, with the axis's name where there are several."""
        return what if len(self.axes) == 1 else f"{what} {self.axes[a]}"

    @cached_property
    def units(self) -> Mapping[str, str]:
        """Unit of every signal, constant, quantity and parameter entry."""
        return unit_table(self.last.model, self.runs)

    @cached_property
    def variables(self) -> list[Variable]:
        """Every column, input and quantity that varies, but time."""
        side, runs = self.sides[-1], self.runs
        names = list(
            dict.fromkeys([*_inputs(side.estimate), *usable_columns(side.estimate.model, runs)])
        )
        problem = Problem(side.estimate.model, runs)
        found = variables(problem, problem.point(side.estimate.values), names)
        return [v for v in found if v.name not in ("time", "place in the record")]

    def unit_of(self, name: str) -> str:
        """Unit of a parameter; empty where its entries have several."""
        entries = {u for n, u in self.units.items() if n.startswith(f"{name}[")}
        return self.units.get(name) or (entries.pop() if len(entries) == 1 else "")

    def variable_unit(self, name: str) -> str:
        """Unit of a variable, empty where nobody stated it."""
        if name in self.units:
            return self.units[name]
        whole = self.units.get(name.partition("[")[0])
        return whole or self.runs[0].units.get(name) or ""


def of_calibration(estimate: Estimate, content: Mapping[str, Any]) -> Story:
    """The residuals of one fit."""
    runs = prepared(estimate.model, estimate.problem.runs)
    side = Side("residual", "after", estimate, tuple(estimate.problem.residuals(estimate.point)))
    return Story(runs, (side,), *_noise(estimate, content))


def of_closing(closing: Closing, content: Mapping[str, Any]) -> Story:
    """The residuals of the fit to everything, before and after."""
    sides = [
        Side(name, name, e, tuple(Problem(e.model, closing.runs).residuals(e.point)))
        for name, e in (("before", closing.before), ("after", closing.after))
    ]
    if not closing.effects:
        sides = [Side("residual", "after", sides[1].estimate, sides[1].residuals)]
    return Story(closing.runs, tuple(sides), *_noise(closing.after, content))


def _noise(estimate: Estimate, content: Mapping[str, Any]) -> tuple[Array, str, float]:
    noise = content["noise"]
    sigma = np.array([np.nan if s is None else s for s in noise["sigma"]], dtype=float)
    each = noise.get("sigma_by_axis")
    if each and len(each) > 1 and all(each):  # unequal axes, with the mean square of the fit
        sigma = sigma * np.asarray(each) / np.sqrt(np.mean(np.square(each)))
    return sigma, str(noise["unit"]), max(estimate.correlated_over, 1.0)


def _inputs(estimate: Estimate) -> Sequence[str]:
    """Signals of one component that an explicit model only reads."""
    model = estimate.model
    if model.implicit:
        return []
    return [
        s.name for s in model.signals if s.size == 1 and s.name not in ("t", model.traced.measured)
    ]
