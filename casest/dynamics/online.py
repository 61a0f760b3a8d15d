"""The filter sample by sample, as readings come."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.known import known
from casest.dynamics.riccati import check_covariance
from casest.dynamics.stepping import unpacked
from casest.dynamics.stepwise import PARTS, checked_period, stepwise
from casest.dynamics.transition import checked_record
from casest.errors import UsageError


@dataclass(frozen=True)
class Now:
    """States x (n,) and their covariance P (n, n) after a reading at `time`, s."""

    model: Dynamics
    time: float
    x: Array
    P: Array

    def __getitem__(self, name: str) -> Array:
        """A state by its name."""
        return self.x[self.model.slices()[name]]

    @property
    def std(self) -> Array:
        """Standard deviations, (n,)."""
        return np.asarray(np.sqrt(np.diag(self.P)))


class Estimator:
    """A filter that is given one sample after the other, every `period` s as a rule.

    Evenly sampled, it says what `filtered` says of the whole record, to rounding. A step of more
    than five periods is a gap. Inputs with noise that enter A or C are taken as they are read:
    what is their motion and what is noise only the whole record tells.
    """

    def __init__(self, model: Dynamics, period: float) -> None:
        """Raises UsageError where the period is none, DataError where the start is no
        covariance."""
        checked_period(model, period)
        check_covariance(model.start_covariance, "the covariance at the beginning")
        self.model = model
        self._own = stepwise(model, float(period))
        self._last: tuple[float, dict[str, Array]] | None = None
        self._state = self._lead = self._own.begin

    def step(self, reading: Mapping[str, Any], t: float) -> Now:
        """What is known after a sample at time t, s: every signal by name, in the model's units.

        NaN, or a name left out, is a reading that is missing; inputs may not be. Raises UsageError
        for a signal that the model has not or of another size, DataError where time does not
        increase or an input is missing.
        """
        own = self._signals(reading)
        # To the first sample nothing leads: it is the first of a record of two.
        first = self._last is None
        before = (t - self._own.period, own) if self._last is None else self._last
        run = self._record(before, (t, own))
        checked_record(self.model, run)
        self._taken(
            np.hstack([run.signals[s.name] for s in self.model.signals]), t - before[0], first
        )
        self._last = t, own
        x, P = unpacked(_of(self._own.told, self._state)[None], self.model.size)
        x, P = known(self.model, run.take(slice(1, 2)), x, P)
        return Now(self.model, float(t), x[0], P[0])

    def _taken(self, samples: Array, h: float, first: bool) -> None:
        """The state after the samples (2, W) before and now, the second's readings included."""
        n, lead, own = self.model.size, self._lead, self._own
        if own.leads:  # the noise of inputs acts along the states of this one
            start = own.begin[:n]
            moved = lead if first else self._moved(lead, samples, h, start, start)
            self._lead = self._read(moved, samples[1])
        if not first:
            self._state = self._moved(self._state, samples, h, lead[:n], self._lead[:n])
        self._state = self._read(self._state, samples[1])

    def _moved(self, state: Array, samples: Array, h: float, *along: Array) -> Array:
        own, ends = self._own, samples.ravel()
        fast = 0.0 if own.fast is None else float(own.fast([*ends, h]))
        parts = int(np.clip(np.ceil(fast / own.slow), 1, PARTS)) if np.isfinite(fast) else 1
        lost, none = own.forgotten * (h > own.gap), np.zeros(self.model.size)
        for k in range(parts):
            gap = lost if k == 0 else none, lost if k == parts - 1 else none
            ab = [k / parts, (k + 1) / parts]
            state = _of(own.move, state, ends, [h], *gap, ab, *(along if own.leads else ()))
        return state

    def _read(self, state: Array, sample: Array) -> Array:
        y = sample[list(self._own.readings)]
        there = np.isfinite(y)
        return _of(self._own.read, state, sample, np.where(there, y, 0.0), there)

    def _signals(self, reading: Mapping[str, Any]) -> dict[str, Array]:
        sizes = {s.name: s.size for s in self.model.signals}
        found = {name: np.full(size, np.nan) for name, size in sizes.items()}
        for name, value in reading.items():
            if name not in sizes:
                known_names = ", ".join(sizes)
                raise UsageError(f"{self.model.name} has no signal {name!r}; it has {known_names}")
            numbers = np.asarray(value, float).ravel()
            if len(numbers) != sizes[name]:
                raise UsageError(
                    f"{self.model.name}: {name} has {sizes[name]} numbers, not {len(numbers)}"
                )
            found[name] = numbers
        return found

    def _record(self, *samples: tuple[float, dict[str, Array]]) -> Run:
        signals = {
            s.name: np.stack([own[s.name] for _, own in samples]) for s in self.model.signals
        }
        time = np.array([t for t, _ in samples], float)
        return Run.raw("online", signals, units={}, time=time)


def _of(function: Any, *parts: Any) -> Array:
    """A function of one vector, of its parts."""
    return np.asarray(function(np.concatenate(parts)), float).ravel()
