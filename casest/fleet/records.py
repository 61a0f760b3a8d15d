"""Many records of differential equations: each is followed, and calibrated, by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError
from casest.estimate.estimate import Estimate
from casest.estimate.reasons import TOO_LARGE, Code
from casest.units import conversion


@dataclass(frozen=True)
class Records:
    """S records: readings (S, N, size) of all that the model needs, the time among them, how many
    of each count (S,), where searches begin, and the noise that a sound sensor has."""

    model: Model
    readings: list[Array]
    counts: Array | None
    start: Any
    noise: float | None

    def __len__(self) -> int:
        """Return the number of sensors."""
        return len(self.readings[0])

    def check_start(self) -> None:
        """UsageError where starts are not plain values by parameter."""
        start = self.start or {}
        if not isinstance(start, Mapping) or any(isinstance(v, tuple) for v in start.values()):
            raise UsageError(
                f"start= of {self.model.name}, which follows differential equations, gives plain "
                "values, no function and no bounds"
            )
        for name in set(start) - {p.name for p in self.model.parameters}:
            raise UsageError(f"model {self.model.name} has no parameter {name!r}")

    def run(self, i: int) -> Run:
        """The record of one sensor. DataError where what must be there is no number."""
        stop = None if self.counts is None else int(self.counts[i])
        every = self.model.in_records
        found = {s.name: r[i, :stop] for s, r in zip(every, self.readings, strict=True)}
        missing = self.model.reading["gaps"]
        for name, values in found.items():
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if bad.size and name not in missing:
                raise DataError(
                    f"`{name}` is not finite in reading {bad[0]}: measure this sensor again"
                )
        unit = next(s.unit for s in every if s.name == "t")
        time = found["t"][:, 0] * conversion(unit or "s", "s")[0]
        own = {s.name: found[s.name] for s in self.model.signals}
        units = {s.name: s.unit for s in self.model.signals}
        return Run.raw("its record", own, units=units, time=time)

    def begin(self, i: int) -> dict[str, Array] | None:
        """Where the search of one sensor begins, as the user says; None where the model does."""
        if self.start is None:
            return None
        found = {}
        for name, value in self.start.items():
            array, dims = np.asarray(value, dtype=float), self.model[name].shape.dims
            found[name] = array[i] if array.shape == (len(self), *dims) else array
        return found

    def asked_of_many(self, found: Estimate) -> Code:
        """What only many are asked: LOUD, where there is more noise than a sound sensor has."""
        from scipy.special import gammaincc

        if self.noise is None:
            return Code(0)
        freedom = found.noise.degrees_of_freedom / found.correlated_over
        away = freedom * (found.noise.sigma / self.noise) ** 2
        return Code.LOUD if gammaincc(freedom / 2, away / 2) < TOO_LARGE else Code(0)
