"""Readings that come late, moved to the sample at which they were true.

A delay of many samples is no matter of the prediction's rate at one of them: the reading itself
is moved by whole samples, and the rest, half a sample at most, is first order. Nothing is
interpolated, so that white noise stays white; a reading from before the first sample, or from a
gap, is lost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.effects.moving import Candidate


def shifts_of(
    model: Dynamics, run: Run, added: Sequence[tuple[Candidate, Array]]
) -> dict[str, int]:
    """By how many samples the readings of each output are moved to earlier ones."""
    step, found = float(np.median(np.diff(np.asarray(run.time)))), dict[str, int]()
    for candidate, value in added:
        if candidate.in_time and candidate.on in model.may_be_missing:
            limit = len(run) // 4
            found[candidate.on] = int(np.clip(np.round(float(value[0]) / step), -limit, limit))
    return {name: shift for name, shift in found.items() if shift}


def shifted(model: Dynamics, run: Run, shifts: Mapping[str, int]) -> Run:
    """The run with readings where they belong, and for every output how far they were moved, s."""
    time, signals = np.asarray(run.time, float), dict(run.signals)
    for name in model.measured_signals:
        shift = shifts.get(name, 0)
        step = float(np.median(np.diff(time)))
        moved, usual = _rolled(time, shift) - time, shift * step
        # Not across a gap in time: such a reading belongs to no sample.
        near = np.abs(moved - usual) < 0.5 * abs(usual) + 2 * step
        signals[f"{name}_moved"] = np.where(near, moved, usual)[:, None]
        if shift:
            signals[name] = np.where(near[:, None], _rolled(signals[name], shift), np.nan)
    return replace(run, signals=signals)


def by_reading(model: Dynamics, shifts: Mapping[str, int], values: Array) -> Array:
    """Values of readings (N, m) in the rows that these have in the file; NaN where one was lost."""
    found, place = values.astype(float, copy=True), 0
    for name, o in zip(model.measured_signals, model.traced.outputs, strict=True):
        own = slice(place, place + o.predicted.numel())
        found[:, own] = _rolled(values[:, own], -shifts.get(name, 0))
        place = own.stop
    return found


def _rolled(values: Array, shift: int) -> Array:
    """Each value `shift` rows earlier; NaN where there is none."""
    found = np.full_like(values, np.nan, dtype=float)
    if shift >= 0:
        found[: len(values) - shift] = values[shift:]
    else:
        found[-shift:] = values[:shift]
    return found
