"""One continuous record, bound to a model's signals: what everything above the data works on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import units as casest_units
from casest.errors import DataError, UnitError

Array = NDArray[np.float64]
Labels = NDArray[np.str_]
Index = NDArray[np.int_]


@dataclass(frozen=True)
class Series:
    """What another file recorded, as it stands there: values (N, k) at `time` (N,).

    The time is in s, on the run's clock as far as that is known; `block` (N,) as in a run.
    """

    file: str
    time: Array
    values: Array
    block: Index
    rotation: bool = False


@dataclass(frozen=True)
class Averaged:
    """The raw record whose rests a run's samples are: first and last sample of each, (N,)."""

    run: Run
    first: Index
    last: Index

    def take(self, chosen: NDArray[np.int_] | NDArray[np.bool_] | slice) -> Averaged:
        """The same record, and some of its rests."""
        return Averaged(self.run, self.first[chosen], self.last[chosen])


@dataclass(frozen=True)
class Run:
    """N samples of one record.

    signals: per signal (N, size), in the model's units, which `units` names (None: unknown).
    columns: every other column of the file, (N,) numbers or labels, in `column_units`.
    time: (N,) in s, None where the record has none.
    rows: (N,) data row in the input from 0, or the index of the rest interval.
    block: (N,) number of the gap-separated stretch, burst, pose or rest interval, from 0.
    count: (N,) samples averaged into each (1 in a raw record).
    spread: per signal (N, size), standard error of each mean; empty for a raw record.
    correlation: per signal (N, size, size), of the errors of one mean's components; may be missing.
    notes: what was assumed, skipped or looks wrong, one sentence each.
    read: per signal (N,), in which samples it was read, where signals have clocks of their own:
    between its own samples an input is interpolated or held; empty where all have one clock.
    elsewhere: signals and columns that come from another file than the first, as they are there.
    whole: the record that these samples were taken from, where `places` (N,) says; None of a whole.
    averaged: the raw record whose rests the samples are; None of any other.
    called: per signal the columns of its file that it was read from, where that is known.
    """

    name: str
    file: str
    signals: Mapping[str, Array]
    units: Mapping[str, str | None]
    columns: Mapping[str, Array | Labels]
    column_units: Mapping[str, str | None]
    time: Array | None
    rows: Index | range
    block: Index
    count: Index
    spread: Mapping[str, Array]
    notes: tuple[str, ...] = ()
    correlation: Mapping[str, Array] = field(default_factory=dict)
    elsewhere: Mapping[str, Series] = field(default_factory=dict)
    read: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    whole: Run | None = None
    places: Index | None = None
    averaged: Averaged | None = None
    called: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    #: Signals between their samples, once they were asked for; of a changed run they are others.
    curves: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse parts of unequal length: they would be matched wrongly without a sign."""
        n = len(self.rows)
        parts: dict[str, NDArray[Any]] = {**self.signals, **self.columns, **self.spread}
        parts |= {f"read {name}": mask for name, mask in self.read.items()}
        parts |= {"block": self.block, "count": self.count}
        if self.time is not None:
            parts["time"] = self.time
        for name, values in parts.items():
            if len(values) != n:
                raise DataError(f"{self.name}: {name} has {len(values)} samples, the run has {n}")
        for name, values in self.signals.items():
            if values.ndim != 2:
                raise DataError(f"{self.name}: signal {name} has shape {values.shape}, not (N, k)")

    @classmethod
    def raw(
        cls,
        name: str,
        signals: Mapping[str, Array],
        *,
        units: Mapping[str, str | None],
        time: Array | None = None,
        file: str = "",
        notes: tuple[str, ...] = (),
    ) -> Run:
        """Make a run of one block from arrays alone, as a simulation does."""
        n = len(next(iter(signals.values())))
        # One number seen n times: a long record needs no arrays of zeros, ones and counts.
        zeros, ones = (np.broadcast_to(np.array([k]), (n,)) for k in (0, 1))
        return cls(name, file, signals, units, {}, {}, time, range(n), zeros, ones, {}, notes)

    @property
    def span(self) -> tuple[float, float] | None:
        """First and last time in s; None where the record has none."""
        time = self.signals.get("t") if self.time is None else self.time
        return None if time is None or not len(time) else (float(time.min()), float(time.max()))

    def __len__(self) -> int:
        """Return the number of samples N."""
        return len(self.rows)

    def take(self, chosen: NDArray[np.int_] | NDArray[np.bool_] | slice) -> Run:
        """Return the samples given by an index, a mask or a slice, as a run of the same name.

        It remembers the whole record: what happened before a sample may still be felt in it.
        """
        if self.places is not None:
            places = self.places[chosen]
        elif isinstance(chosen, slice):  # a long record has no room for a number of each sample
            places = np.arange(*chosen.indices(len(self)))
        else:
            places = np.arange(len(self))[chosen]
        rows = self.rows[chosen] if isinstance(chosen, slice) else np.asarray(self.rows)[chosen]
        return replace(
            self,
            signals={name: values[chosen] for name, values in self.signals.items()},
            columns={name: values[chosen] for name, values in self.columns.items()},
            time=None if self.time is None else self.time[chosen],
            rows=rows,
            block=self.block[chosen],
            count=self.count[chosen],
            spread={name: values[chosen] for name, values in self.spread.items()},
            correlation={name: values[chosen] for name, values in self.correlation.items()},
            read={name: mask[chosen] for name, mask in self.read.items()},
            whole=self if self.whole is None else self.whole,
            places=places,
            averaged=None if self.averaged is None else self.averaged.take(chosen),
        )

    def recorded(self, name: str) -> Array:
        """Return the values (M, size) of a signal in the samples where it was read."""
        return self.signals[name][self.read.get(name, slice(None))]

    def in_unit(self, name: str, unit: str) -> Array | None:
        """Readings of a signal in another unit; None where theirs is unknown or of another kind."""
        try:
            factor, zero = casest_units.conversion(self.units.get(name) or "", unit)
        except UnitError:
            return None
        return self.signals[name] * factor + zero

    def clock(self, name: str) -> Array:
        """Return the times (M,) in s at which a signal was read, of a record that has times."""
        return np.asarray(self.time, float)[self.read.get(name, slice(None))]

    def covariance(self, name: str) -> Array:
        """Return the covariance of a signal's means, (N, size, size)."""
        spread = self.spread[name]
        outer = spread[:, :, None] * spread[:, None, :]
        return outer * self.correlation.get(name, np.eye(spread.shape[1]))


#: Samples that are looked at together where a long record has no room for a copy.
LOOK = 1 << 20


def extent(values: NDArray[Any]) -> tuple[Array, Array] | None:
    """Least and greatest of every number (k,) over the samples (N, k) that are finite; None where
    there is none."""
    found: tuple[Array, Array] | None = None
    for first in range(0, len(values), LOOK):
        part = np.asarray(values[first : first + LOOK], float)
        part = part[np.isfinite(part).all(axis=1)]
        if len(part):
            low, high = part.min(axis=0), part.max(axis=0)
            if found is not None:
                low, high = np.minimum(found[0], low), np.maximum(found[1], high)
            found = low, high
    return found
