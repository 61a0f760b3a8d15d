"""Columns that record once more what the model reads: raw counts, a second meter, a set value.

Such a column differs from the signal by the noise of the one or the other. A cause that follows it
would take the place of the declared response, and explain the noise of a reading by that reading.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS


@dataclass(frozen=True)
class Reads:
    """Elements (N,) of a model's signals by name: of its `inputs`, and of `readings` with whether
    the inputs tell them."""

    inputs: dict[str, Array] = field(default_factory=dict, repr=False)
    readings: dict[str, tuple[Array, bool]] = field(default_factory=dict, repr=False)

    def again(self, x: Array) -> str:
        """Which of them a column (N,) is once more, in words; else empty.

        Of a reading that the inputs do not tell, all may be what the column does to it: there the
        column must have its noise as well.
        """
        several = [*self.inputs.items()]
        several += [(n, y) for n, (y, told) in self.readings.items() if told or _one_noise(x, y)]
        for name, y in several:
            share = 1 - float(_scaled(x) @ _scaled(y)) ** 2
            if share < LEVELS.repeated**2:
                size = f"{100 * max(share, 0.0) ** 0.5:.1g} %"
                return f"column is {name} once more (up to scale and offset, to {size})"
        return ""


def reads_of(model: Model, runs: Sequence[Run]) -> Reads:
    """What a column of these runs (prepared) may be once more."""
    declared = {s.name for s in model.declared if s.name != "t"}
    measured = declared & {*model.traced.readings} if model.traced.predicted is not None else set()
    inputs, readings = elements(declared - measured, runs), elements(measured, runs)
    return Reads(inputs, {n: (x, _told(x, [*inputs.values()])) for n, x in readings.items()})


def elements(names: Collection[str], runs: Sequence[Run]) -> dict[str, Array]:
    """What varies of these signals, element by element (N,)."""
    found = {}
    for name in sorted(n for n in names if all(n in run.signals for run in runs)):
        values = np.concatenate([run.signals[name] for run in runs])
        for k, x in enumerate(values.T):
            if np.all(np.isfinite(x)) and np.ptp(x) > 0:
                found[f"{name}[{k}]" if values.shape[1] > 1 else name] = x
    return found


def _scaled(x: Array) -> Array:
    """About its mean, of length one; first by its range: the squares of 1e300 are no numbers."""
    x = x / np.abs(x).max()
    x -= x.mean()
    return np.asarray(x / max(float(np.linalg.norm(x)), 1e-300))


def _told(reading: Array, inputs: Sequence[Array]) -> bool:
    """Do the inputs and their squares tell at least half of a reading's variance?"""
    scaled, reading = [_scaled(x) for x in inputs], _scaled(reading)
    columns = np.column_stack([np.ones(len(reading)), *scaled, *(x**2 for x in scaled)])
    freedom = len(reading) - columns.shape[1]
    if not inputs or freedom < 1:
        return False
    left = reading - columns @ np.linalg.lstsq(columns, reading, rcond=None)[0]
    return bool(left @ left / freedom < 0.5 / len(reading))


def _one_noise(x: Array, y: Array) -> bool:
    """Do the third differences of two series, which are all but noise, go the same way?

    Their signs, so that a few steps do not count: alike in three of four if half of it is one.
    """
    if len(x) < LEVELS.series:
        return False
    alike = np.mean(np.sign(np.diff(x, 3)) * np.sign(np.diff(y, 3)))
    return bool(abs(alike) > 0.5)
