"""The filter sample by sample, as readings come."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.data.timing import GAP
from casest.declaration.shapes import Array
from casest.dynamics.course import Pieces
from casest.dynamics.declare import Dynamics
from casest.dynamics.extended import extended_step, given, pieces
from casest.dynamics.inputs import as_read
from casest.dynamics.known import known
from casest.dynamics.riccati import check_covariance
from casest.dynamics.stepping import run_steps, unpacked
from casest.dynamics.stepwise import checked_period
from casest.dynamics.transition import Pace
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
        self._pace = Pace(float(period), GAP * period)
        self._last: tuple[float, dict[str, Array]] | None = None
        self._states: Any = (None, None)

    def step(self, reading: Mapping[str, Any], t: float) -> Now:
        """What is known after a sample at time t, s: every signal by name, in the model's units.

        NaN, or a name left out, is a reading that is missing; inputs may not be. Raises UsageError
        for a signal that the model has not or of another size, DataError where time does not
        increase or an input is missing.
        """
        own = self._signals(reading)
        # To the first sample nothing leads: it is the first of a record of two.
        first = self._last is None
        before = (t - self._pace.usual, own) if self._last is None else self._last
        run = self._record(before, (t, own))
        x, P = self._linear(run, first) if self.model.linear else self._extended(run, first)
        self._last = t, own
        x, P = known(self.model, run.take(slice(1, 2)), x[None], P[None])
        return Now(self.model, float(t), x[0], P[0])

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

    def _linear(self, run: Run, first: bool) -> tuple[Array, Array]:
        both = Pieces.of(self.model, run, self._pace)
        _, found, states = both.filtered(slice(0, 2), self._states, 0 if first else -1)
        self._states = states
        return found.x[0], found.P[0]

    def _extended(self, run: Run, first: bool) -> tuple[Array, Array]:
        model, n = self.model, self.model.size
        parts, _ = given(model, run, self._pace, as_read(model, run))
        begun = self._states[1]
        if begun is None:
            root = np.zeros(n * (n - 1) // 2)
            begun = np.concatenate([model.start, np.diag(model.start_covariance), root])
        step = extended_step(model, pieces(model, run, self._pace))
        row = slice(0, 1) if first else slice(1, 2)
        state, after, *_ = run_steps(step, begun, [p[row] for p in parts])
        self._states = None, state[0]
        x, P = unpacked(after, n)
        return x[0], P[0]
