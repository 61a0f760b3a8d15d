"""What is drawn of residuals: one fit, or two side by side, over the same samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import usable_columns
from casest.diagnose.misfit.variables import variables
from casest.estimate.correlation import is_series
from casest.estimate.estimate import Estimate
from casest.leastsquares.problem import Problem
from casest.results.poses import Poses, poses_of
from casest.results.units import unit_table
from casest.results.values import Entry, entries


@dataclass(frozen=True)
class Side:
    """One fit: residuals (N, m) of each run, its values, its certificate; `look` is its colour."""

    name: str
    look: str
    residuals: tuple[Array, ...]
    entries: tuple[Entry, ...]
    trusted: bool
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Variable:
    """A column, input or quantity that varies: its values (N,) over all runs, angles within a turn.

    The unit is empty where nobody stated it.
    """

    name: str
    unit: str
    values: Array
    turns: bool


@dataclass(frozen=True)
class Residuals:
    """Sides over the runs; `sigma` (m,) is the noise of one residual on each axis.

    `units`: of every signal, constant, quantity and parameter entry. `series`: are the samples a
    record in time, so that neighbours and frequencies mean something?
    """

    runs: tuple[Run, ...]
    sides: tuple[Side, ...]
    axes: tuple[str, ...]
    sigma: Array
    unit: str
    correlated_over: float
    units: Mapping[str, str]
    variables: tuple[Variable, ...]
    series: bool
    poses: Poses | None = None

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

    def unit_of(self, name: str) -> str:
        """Unit of a parameter; empty where its entries have several."""
        own = {u for n, u in self.units.items() if n.startswith(f"{name}[")}
        return self.units.get(name) or (own.pop() if len(own) == 1 else "")


def residuals_of(
    sides: Sequence[Side], last: Estimate, runs: Sequence[Run], noise: tuple[Array, str]
) -> Residuals:
    """All sides, the last of which is that of the estimate `last`.

    `runs` are prepared for effects; `noise` is σ of one residual on each axis, and its unit.
    """
    runs = tuple(runs)
    units = unit_table(last.model, runs)
    return Residuals(
        runs,
        tuple(sides),
        last.model.axes,
        *noise,
        max(last.correlated_over, 1.0),
        units,
        tuple(_variables(last, runs, units)),
        all(is_series(run) for run in runs),
        poses_of(last),
    )


def side_of(name: str, look: str, found: Estimate, problem: Problem) -> Side:
    """One fit over the runs of a problem."""
    certificate = found.certificate
    return Side(
        name,
        look,
        tuple(problem.residuals(found.point)),
        entries(found),
        certificate.trusted,
        tuple(certificate.reasons),
    )


def _variables(
    found: Estimate, runs: tuple[Run, ...], units: Mapping[str, str]
) -> Iterator[Variable]:
    """Every column, input and quantity that varies, but time."""
    names = list(dict.fromkeys([*_inputs(found), *usable_columns(found.model, runs)]))
    problem = Problem(found.model, runs)
    for v in variables(problem, problem.point(found.values), names):
        if v.name not in ("time", "place in the record"):
            x = np.concatenate(v.values)
            unit = _unit(v.name, units, runs)
            yield Variable(v.name, unit, x % (2 * np.pi) if v.turns else x, v.turns)


def _unit(name: str, units: Mapping[str, str], runs: Sequence[Run]) -> str:
    if name in units:
        return units[name]
    return units.get(name.partition("[")[0]) or runs[0].units.get(name) or ""


def _inputs(estimate: Estimate) -> Sequence[str]:
    """Signals of one component that an explicit model only reads."""
    model = estimate.model
    if model.implicit:
        return []
    return [
        s.name for s in model.signals if s.size == 1 and s.name not in ("t", model.traced.measured)
    ]
