"""Columns that record once more what the model reads: raw counts, a second meter, a set value, a
magnitude that was computed from the axes.

Such a column differs from the signal by the noise of the one or the other. A cause that follows it
would take the place of the declared response, and explain the noise of a reading by that reading.
Also what only goes with an input is none, of few rows sooner: its curve is a bend of the response.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement, product

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.errors import is_error, is_quotient
from casest.diagnose.levels import LEVELS

#: Of a reading's variance: where inputs leave so much, something else may be what moves it.
MOST = 0.5
#: Swings of an input in the record at least: of fewer any two slow courses are alike.
SWINGS = 3
#: Parts of a record over each of which a speed is summed up: its noise goes out of it there.
PARTS = 50


@dataclass(frozen=True)
class Signal:
    """What is computed from a signal: an orthonormal basis (N, p) of its elements, their products
    and its length; `noise` are the elements (N, q) of a reading that the inputs do not tell. Is it
    an `input`: does nothing that is recorded beside it drive it? `shift`: rows after which an input
    of one element that swings has turned a quarter; else 0. `driving`: what inputs (N, k) may do to
    a reading, about its mean.
    """

    name: str
    elements: Array = field(repr=False)
    basis: Array = field(repr=False)
    noise: Array | None = field(default=None, repr=False)
    input: bool = False
    shift: int = 0
    driving: Array | None = field(default=None, repr=False)

    def at_other_times(self, x: Array) -> bool:
        """Is a column (N,) nothing but the input, now and a quarter of a swing before and after? In
        one sine its integral is that: what follows it could be a lag of the input."""
        if not self.shift:
            return False
        k, u = self.shift, _scaled(self.elements[:, 0])
        later = np.column_stack([u[: -2 * k], u[k:-k], u[2 * k :], np.ones(len(u) - 2 * k)])
        own = _scaled(x[k:-k])
        left = own - later @ np.linalg.lstsq(later, own, rcond=None)[0]
        return float(left @ left) < LEVELS.repeated

    def is_integral_of(self, x: Array, time: Array) -> bool:
        """Does the input go, in each part of the record, as far as a column (N,) sums up to, to and
        fro? What follows the speed of an input is what a lag of it makes."""
        k, y = len(x) // PARTS, self.elements[:, 0]
        if not self.input or self.elements.shape[1] != 1 or k < 1:
            return False
        steps = np.maximum(np.diff(time), 0.0)  # from run to run: none
        summed = np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * steps)])
        gone, went = _scaled(summed[k:] - summed[:-k]), _scaled(y[k:] - y[:-k])
        ways = np.sign(went[np.abs(went) > 0.5 * went.std()])
        if np.sum(ways[1:] != ways[:-1]) < 2 * SWINGS:
            return False
        return float(gone @ went) ** 2 > 1 - LEVELS.stand_in

    def taken_by(self, x: Array) -> bool:
        """Would a column (N,) and its square tell most of what inputs leave of a reading, and take
        the place of these?

        Of inputs that tell most of it, less than half of their part would be left; of others less
        than what nobody tells, and the column has the reading's noise.
        """
        if self.driving is None or len(x) < LEVELS.series:
            return False
        given, column = self.driving, _scaled(x)
        both = np.column_stack([given, column, _scaled(column**2)])
        y = self.elements - self.elements.mean(axis=0)
        alone, beside = (np.linalg.lstsq(A, y, rcond=None)[0] for A in (given, both))
        response, kept = given @ alone, given @ beside[: given.shape[1]]
        left, less = (float(np.sum((y - A @ b) ** 2)) for A, b in ((given, alone), (both, beside)))
        part = float(np.sum(response * kept)) / max(float(np.sum(response**2)), 1e-300)
        if part >= LEVELS.stays or less >= LEVELS.most * left:
            return False
        if left < LEVELS.most * float(np.sum(y**2)):
            return True
        return float(np.sum(kept**2)) < less and any(_one_noise(x, own) for own in y.T)

    def apart(self, x: Array) -> float:
        """Share of a column's squares (N,) that is not computed from it; inf where more is left
        than its rounding, or of few rows of an input a part that counts.

        Of a reading that the inputs do not tell, all may be what the column does to it: there the
        column must have its noise as well.
        """
        N, p = self.basis.shape
        if any(_follows(x, y) for y in self.elements.T):
            return 0.0
        unit = _scaled(x)
        left = (1 - float(np.sum((self.basis.T @ unit) ** 2))) * N / (N - p)
        own = self.noise is None or any(_one_noise(x, y) for y in self.noise.T)
        most = LEVELS.repeated**2 + _rounding(unit)
        if self.input and (LEVELS.series > N or self.elements.shape[1] == 1):
            most = LEVELS.stand_in
        return left if own and left < most else np.inf


@dataclass(frozen=True)
class Reads:
    """The signals of a model in so many rows of a record, evenly chosen."""

    signals: tuple[Signal, ...]
    rows: slice
    columns: Mapping[str, Array] = field(default_factory=dict, repr=False)
    time: Array | None = field(default=None, repr=False)

    def again(self, x: Array) -> str:
        """Which of them a column (N,) is once more, in words; else empty."""
        x = x[self.rows]
        if of := self._error_of(x):
            return f"column is the error of {of[0]} against {of[1]}, computed from both"
        near = {s.name: s.apart(x) for s in self.signals if np.ptp(x) > 0}
        name = min(near, key=lambda n: near[n], default="")
        if name and near[name] < LEVELS.repeated**2 + _rounding(_scaled(x)):
            return f"column is {name} once more, or computed from it"
        if better := next((s.name for s in self.signals if s.taken_by(x)), ""):
            return f"column tells {better} better than its inputs do: another meter"
        if name and np.isfinite(near[name]):
            few = "in so few rows " if len(x) < LEVELS.series else ""
            return f"column goes with {name}: {few}what follows it could be a bend over that"
        if made := self._made_of(x):
            return f"column is made of {made[0]} and {made[1]}, computed from both"
        could = "what follows it could be a lag of it"
        for s in self.signals:
            if s.at_other_times(x):
                return f"column is {s.name} at other times: {could}"
            if self.time is not None and s.is_integral_of(x, self.time):
                return f"column is how fast {s.name} changes: {could}"
        return ""

    def _made_of(self, x: Array) -> tuple[str, str] | None:
        """A signal of one element and another column of which it is the difference, or of a reading
        the quotient or product."""
        single = [s for s in self.signals if s.elements.shape[1] == 1]
        others = {s.name: s.elements[:, 0] for s in single} | dict(self.columns)
        for one, (name, y) in product(single, others.items()):
            if name == one.name or y is x or np.array_equal(x, y):
                continue
            read = one.elements[:, 0]
            made = is_error(x, read, y) or (not one.input and is_quotient(x, read, y))
            # Of the three numbers that one was computed which has the signal's noise.
            if made and _noise_alike(x, read) > _noise_alike(y, read):
                return one.name, name
        return None

    def _error_of(self, x: Array) -> tuple[str, str] | None:
        """A reading and an input of one element each of which it is the error; None without."""
        single = [s for s in self.signals if s.elements.shape[1] == 1]
        for reading, given in product(single, single):
            one = given.input and not reading.input
            if one and is_error(x, reading.elements[:, 0], given.elements[:, 0]):
                return reading.name, given.name
        return None


def reads_of(model: Model, runs: Sequence[Run]) -> Reads:
    """What a column of these runs (prepared) may be once more."""
    declared = {s.name for s in model.declared if s.name != "t"}
    measured = declared & {*model.traced.readings} if model.traced.predicted is not None else set()
    return signals_of(declared - measured, measured, runs)


def signals_of(inputs: Collection[str], readings: Collection[str], runs: Sequence[Run]) -> Reads:
    """The same of these signals, as far as the runs have them.

    Without `readings`, as of an implicit model, nobody knows which of them are inputs.
    """
    rows = slice(None, None, -(-sum(map(len, runs)) // LEVELS.rows) or 1)
    each = {}
    for name in sorted({*inputs, *readings}):
        if all(name in run.signals for run in runs):
            x = np.concatenate([run.signals[name] for run in runs])[rows]
            each[name] = x[:, np.all(np.isfinite(x), axis=0) & (np.ptp(x, axis=0) > 0)]
    driving = [column for n, x in each.items() if n not in readings for column in x.T]
    found = []
    for name, x in each.items():
        basis = _computed(x)
        if basis is not None:
            untold = _untold(x, driving) if name in readings else 1.0
            noise = x if name in readings and untold >= MOST else None
            drives = bool(readings) and name not in readings
            shift = _quarter(x[:, 0]) if drives and x.shape[1] == 1 else 0
            moved = _driving(driving) if name in readings else None
            found.append(Signal(name, x, basis, noise, drives, shift, moved))
    columns = {
        name: np.concatenate([run.signals[name][:, 0] for run in runs])[rows]
        for name in (runs[0].columns if runs else ())
        if name not in each and all(name in run.signals for run in runs)
    }
    times = [run.time for run in runs if run.time is not None]
    time = np.concatenate(times)[rows] if len(times) == len(runs) > 0 else None
    return Reads(tuple(found), rows, columns, time)


def _quarter(x: Array) -> int:
    """Rows after which a series (N,) is no longer like itself; 0 of one that swings a few times."""
    if len(x) < LEVELS.series:
        return 0
    spectrum = np.abs(np.fft.rfft(_scaled(x), 2 * len(x))) ** 2
    alike = np.fft.irfft(spectrum)[: len(x)]
    gone = int(np.argmax(alike < 0))
    return gone if 0 < gone <= len(x) // (4 * SWINGS) else 0


def _computed(x: Array) -> Array | None:
    """Orthonormal columns of what is computed from elements (N, q); None where rows are few."""
    N, q = x.shape
    if not q:
        return None
    parts = [np.ones(N), *(_scaled(column) for column in x.T)]
    size = np.abs(x).max()
    raw = x.T / size
    more = [raw[i] * raw[j] for i, j in combinations_with_replacement(range(q), 2)] if q < 4 else []
    more.append(np.linalg.norm(raw, axis=0))
    whole = [*parts, *(_scaled(column) for column in more)]
    chosen = whole if 2 * len(whole) <= N else parts
    if 2 * len(chosen) > N:
        return None
    left, values, _ = np.linalg.svd(np.column_stack(chosen), full_matrices=False)
    return np.asarray(left[:, values > 1e-9 * values[0]])


def _follows(x: Array, y: Array) -> bool:
    """Does one rise, or fall, wherever the other does? A logarithm, a table: not a sum of noises.

    What is rounded still does; what has few levels may by chance.
    """
    some = slice(None, None, max(1, len(x) // LEVELS.series))  # tell nearly always that it does not
    if len(x) < LEVELS.series or not _ordered(x[some], y[some]):
        return False
    return len(np.unique(x)) >= LEVELS.series / 2 and _ordered(x, y)


def _ordered(x: Array, y: Array) -> bool:
    return any(np.all(np.diff(s[np.lexsort((s, y))]) >= 0) for s in (x, -x))


def _scaled(x: Array) -> Array:
    """About its mean, of length one; first by its range: the squares of 1e300 are no numbers."""
    x = x / max(float(np.abs(x).max()), 1e-300)
    x -= x.mean()
    return np.asarray(x / max(float(np.linalg.norm(x)), 1e-300))


def _rounding(unit: Array) -> float:
    """Share of its rounding in a column's squares, with room; 0 where it is most of a step."""
    steps = np.diff(np.unique(unit))
    share = 1.5 * len(unit) * float(steps.min()) ** 2 / 12 if steps.size else 0.0
    return share if share < 0.01 else 0.0


def _untold(reading: Array, inputs: Sequence[Array]) -> float:
    """Share of a reading's (N, q) variance that inputs and their squares do not tell."""
    scaled = [_scaled(x) for x in inputs]
    columns = np.column_stack([np.ones(len(reading)), *scaled, *(x**2 for x in scaled)])
    freedom = len(reading) - columns.shape[1]
    if not inputs or freedom < 1 or not reading.size:
        return 1.0
    units = np.column_stack([_scaled(y) for y in reading.T])
    left = units - columns @ np.linalg.lstsq(columns, units, rcond=None)[0]
    return float(np.mean(np.sum(left**2, axis=0)) * len(reading) / freedom)


def _driving(inputs: Sequence[Array]) -> Array | None:
    """Inputs and their squares side by side (N, k), scaled; None without any."""
    scaled = [_scaled(x) for x in inputs]
    return np.column_stack([*scaled, *(_scaled(x**2) for x in scaled)]) if scaled else None


def _one_noise(x: Array, y: Array) -> bool:
    """Is half of the noise of two series one?"""
    return len(x) >= LEVELS.series and _noise_alike(x, y) > 0.5


def _noise_alike(x: Array, y: Array) -> float:
    """How much oftener the third differences of two series, which are all but noise, go the same
    way than not, or the other way.

    Their signs, so that a few steps do not count: 0.5, alike in three of four, if half is one.
    """
    if len(x) < 4:
        return 0.0
    return float(abs(np.mean(np.sign(np.diff(x, 3)) * np.sign(np.diff(y, 3)))))
