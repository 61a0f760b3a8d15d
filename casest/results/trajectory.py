"""What is drawn of an estimator in motion: states and innovations along the record."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics import Dynamics
from casest.dynamics.course import Course
from casest.dynamics.declare import EXACT
from casest.dynamics.filter import Filtered
from casest.results.result import Number

#: A record that tells as much as was known beforehand leaves this share of its standard deviation.
HALF = 0.5**0.5


class Innovations(Struct, frozen=True):
    """One-step innovations: rms and correlation of neighbours of each axis.

    `normalised_mean` is the mean of their squares over what the filter expects of them, `expected`
    what it should be.
    """

    rms: list[Number]
    normalised_mean: Number
    expected: int
    missing_readings: int
    lag1_correlation: list[Number]


@dataclass(frozen=True)
class State:
    """A declared state: its place among all components, and what was declared of its noise."""

    name: str
    where: slice
    unit: str
    std: float
    intensity: float


@dataclass(frozen=True)
class Trajectory:
    """States (N, n) with standard deviations, filtered and smoothed, and innovations (N, m).

    `names` and `units` are those of the n components, `readings` name and unit of the m others;
    `expected_std` (N, m): what the filter expects of the innovations; `run` holds these, so that
    gaps in time are known; `convention`: what the declaration says of itself.
    """

    time: Array
    names: Sequence[str]
    units: Sequence[str]
    x: Array
    std: Array
    smoothed: Array
    smoothed_std: Array
    states: tuple[State, ...]
    innovations: Array
    expected_std: Array
    readings: tuple[tuple[str, str], ...]
    run: Run
    convention: str


def trajectory_of(found: Filtered | Course) -> Trajectory:
    """What a filter and smoother said along a record."""
    model, slices = found.model, found.model.slices()
    units: dict[str, str | None] = {"y": None}
    return Trajectory(
        found.time,
        model.names,
        model.state_units,
        found.x,
        found.std,
        found.smoothed,
        found.smoothed_std,
        tuple(State(s.name, slices[s.name], s.unit, s.std, s.intensity) for s in model.states),
        found.innovations,
        found.expected_std,
        tuple(_readings(model)),
        Run.raw("innovations", {"y": found.innovations}, units=units, time=found.time),
        inspect.getdoc(model.function) or "",
    )


def _readings(model: Dynamics) -> list[tuple[str, str]]:
    """Name and unit of each reading's components."""
    found: list[tuple[str, str]] = []
    for name in model.measured_signals:
        signal = next(s for s in model.signals if s.name == name)
        names = [f"{name}[{k}]" for k in range(signal.size)] if signal.size > 1 else [name]
        found += [(n, signal.unit or "1") for n in names]
    return found


def weakly_told(found: Filtered | Course) -> list[str]:
    """A sentence on numbers of the state of which the record tells less than was declared of them,
    from its beginning to its end: what is printed of them is the declaration."""
    model, first, (_, last) = found.model, found.smoothed_std[0], found.end
    last = last if last.ndim == 1 else np.sqrt(np.diag(last))
    declared = np.sqrt(np.diag(model.start_covariance))
    guessed = declared > 2 * EXACT * np.maximum(1.0, np.abs(model.start))
    weak = guessed & (first > HALF * declared) & (last > HALF * declared) & (last < declared / HALF)
    said = ", ".join(
        f"{model.names[k]} (± {last[k]:.3g} {model.state_units[k]} at the end, ± {declared[k]:.3g} "
        "declared of the start)"
        for k in np.flatnonzero(weak)
    )
    return [
        f"weak: {said}: this record tells less than was declared, and what depends on it is no "
        "better known (casest observe names the direction)"
    ] if said else []  # fmt: skip
