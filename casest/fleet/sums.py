"""Least-squares sums of many sensors at once: one NumPy call per instruction and chunk of samples.

`engine` replays a model's instructions over the samples of one sensor, with its parameters as
plain numbers. Here the sensors lie side by side: what depends on parameters only is a row (W,) of W
sensors, computed once per call; what depends on samples is (P, w), P samples of a panel of them.
No value of a sensor depends on its neighbours or on its place among them: the same instructions
act on every column, and the sums run over samples in their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.engine import Plan, Replay
from casest.engine.operations import BY_CODE, Kernel
from casest.engine.replay import Entry, aligned

#: Numbers per call: enough to hide the cost of the call, few enough to stay in the cache.
NUMBERS = 12288
#: Samples of all sensors whose small matrices are factored side by side.
SAMPLES = 98304
#: Fewest sensors side by side: NumPy adds in another order along rows that are shorter.
NARROWEST = 32


class Hold(NamedTuple):
    """One more residual of each sensor, rowᵀ(x − target); both (n, W)."""

    row: Array
    target: Array

    def entries(self, x: Array) -> Array:
        """Its row of the Jacobian and then the residual itself at x, (n + 1, W)."""
        miss = np.einsum("is,is->s", self.row, x - self.target)
        return np.concatenate([self.row, miss[None]])


class Sensors(NamedTuple):
    """Readings of W sensors side by side: samples (k, N, W), and which of them count, (N, W).

    Without `mask` all do. `hold` ties a combination of unknowns, for a profile.
    """

    samples: Array
    mask: Array | None
    hold: Hold | None = None

    def some(self, chosen: NDArray[np.int_]) -> Sensors:
        """The sensors of these places."""
        mask = None if self.mask is None else self.mask[:, chosen]
        hold = None if self.hold is None else Hold(*(part[:, chosen] for part in self.hold))
        return Sensors(self.samples[:, :, chosen], mask, hold)


def side_by_side(readings: Sequence[Array], counts: Array | None = None) -> Sensors:
    """Readings (S, N, size) as a block of sensors, the last repeated up to its width."""
    total, samples = readings[0].shape[:2]
    places = np.minimum(np.arange(-(-total // NARROWEST) * NARROWEST), total - 1)
    found = np.concatenate([r[places].transpose(2, 1, 0) for r in readings])
    if counts is None:
        return Sensors(np.ascontiguousarray(found), None)
    mask = (np.arange(samples)[:, None] < counts[places]).astype(float)
    return Sensors(np.where(mask > 0, found, found[:, :1]), mask)


class Normals(NamedTuple):
    """½Σr² (W,), and JᵀJ with (Jᵀr)ᵀ as one more row, (n + 1, n, W); zeros above the diagonal."""

    cost: Array
    rows: Array

    @property
    def matrix(self) -> Array:
        """JᵀJ (n, n, W), lower triangle."""
        return self.rows[:-1]


def chunk(samples: int) -> int:
    """Samples of each sensor that are evaluated at once.

    It must not depend on the number of sensors: sums of chunks are added, and each sensor's digits
    would depend on how many others there are.
    """
    return min(samples, 24 if samples <= 64 else 48 if samples <= 1024 else NUMBERS // NARROWEST)


def panel(samples: int) -> int:
    """Sensors that are evaluated at once, for records of so many samples."""
    return NUMBERS // max(chunk(samples), 3) // NARROWEST * NARROWEST


def widest(samples: int) -> int:
    """Sensors side by side for records of so many samples: some panels."""
    return panel(samples) * max(1, SAMPLES // (panel(samples) * max(samples, 24)))


class SideBySide:
    """Some entries of a function's outputs, for sensors side by side."""

    def __init__(self, replay: Replay, entries: list[Entry]) -> None:
        self.plan = replay.plan(entries)
        self._places: dict[tuple[int, int], _Registers] = {}

    def chunks(self, parameters: Array, sensors: Sensors) -> Iterator[tuple[slice, slice, Array]]:
        """Samples, sensors and their entries (entries, P, w), which the next chunk overwrites.

        parameters: (n, W). Samples that do not count have entries of zero.
        """
        total, width = sensors.samples.shape[1:]
        length, broad = chunk(total), panel(total)
        for first in range(0, width, broad):
            own = slice(first, min(first + broad, width))
            for start in range(0, total, length):
                span = slice(start, min(start + length, total))
                registers = self._registers(span.stop - start, own.stop - first)
                if start == 0 or span.stop - start < length:
                    registers.set(parameters[:, own])
                values = registers.run(sensors.samples[:, span, own])
                if sensors.mask is not None:
                    values *= sensors.mask[span, own]
                yield span, own, values

    def _registers(self, length: int, width: int) -> _Registers:
        if (length, width) not in self._places:
            if len(self._places) > 16:  # records of ever new lengths must not pile up
                self._places.clear()
            self._places[length, width] = _Registers(self.plan, length, width)
        return self._places[length, width]


class _Registers:
    """Where the values of a plan live for P samples of W sensors, and the bound calls."""

    def __init__(self, plan: Plan, length: int, width: int) -> None:
        values = plan.graph.values
        rows = aligned(len(plan.scalars), width)
        place = {i: rows[k] for k, i in enumerate(plan.scalars)}
        for i in plan.scalars:
            if values[i].kind == "constant":
                place[i] = np.array(values[i].constant)
        self._parameters = [(place[i], values[i].code) for i in plan.scalars if _given(plan, i)]
        self._once = [_call(plan, i, place) for i in plan.scalars if _computed(plan, i)]
        self._inputs = _side_by_side(len(plan.inputs), length, width)
        self._codes = [values[i].code for i in plan.inputs]
        self._results = _side_by_side(len(plan.wanted), length, width)
        registers = _side_by_side(plan.n_registers, length, width)
        place.update((i, self._inputs[k]) for k, i in enumerate(plan.inputs))
        place.update((i, registers[k]) for i, k in plan.register.items())
        place.update((i, self._results[k]) for i, k in plan.home.items())
        self._each = [_call(plan, i, place) for i in plan.steps]
        for row, i in enumerate(plan.wanted):
            if plan.home.get(i) != row:
                self._each.append((_copied, (place[i], self._results[row])))

    def set(self, parameters: Array) -> None:
        """Evaluate once what does not depend on the sample."""
        for row, code in self._parameters:
            row[:] = parameters[code]
        for kernel, arguments in self._once:
            kernel(*arguments)

    def run(self, samples: Array) -> Array:
        """Entries (entries, P, W) of a chunk (k, P, W)."""
        for row, code in zip(self._inputs, self._codes, strict=True):
            row[:] = samples[code]
        for kernel, arguments in self._each:
            kernel(*arguments)
        return self._results


def _side_by_side(count: int, length: int, width: int) -> Array:
    return aligned(count, length * width).reshape(count, length, width)


def _given(plan: Plan, i: int) -> bool:
    return plan.graph.values[i].kind == "parameter"


def _computed(plan: Plan, i: int) -> bool:
    return plan.graph.values[i].kind == "operation"


def _call(plan: Plan, i: int, place: dict[int, Array]) -> tuple[Kernel, tuple[Array, ...]]:
    value = plan.graph.values[i]
    return BY_CODE[value.code].kernel, (*(place[j] for j in value.operands), place[i])


def _left(L: Array, J: Array, columns: list[int]) -> Array:
    """1 − h, what is left of each residual, (P, w); rows J (k, P, w) have only these columns.

    h = ‖L⁻¹Jᵀ‖², by substitution, in the place of J where that has all columns.
    """
    first, y = columns[0] if columns else len(L), J
    if len(columns) < len(L):
        y = np.zeros((len(L), *J.shape[1:]))
        y[columns] = J
    for i in range(first, len(L)):
        if i > first:
            y[i] -= np.einsum("ks,kps->ps", L[i, first:i], y[first:i])
        y[i] /= L[i, i]
    return np.asarray(np.maximum(1 - np.einsum("kps,kps->ps", y, y), 1e-12))


def _adjacent(places: list[int]) -> slice | list[int]:
    """The same places, as a slice where they follow each other: that makes views."""
    first, last = places[0], places[-1]
    return slice(first, last + 1) if last - first == len(places) - 1 else places


def _copied(value: Array, out: Array) -> None:
    np.copyto(out, value)


class Squares:
    """Cost and normal equations of a model's residual r (m×1) and Jacobian J (m×n)."""

    def __init__(self, replay: Replay) -> None:
        """From a replay with the outputs r and J."""
        m, self.n = replay.shapes[1]
        row, column = replay.sparsity[1]
        self.residual_count = m
        self._columns = [[*map(int, column[row == i]), self.n] for i in range(m)]
        self._places = [[_adjacent(own[i:]) for i in range(len(own))] for own in self._columns]
        entries: list[Entry] = []
        for i in range(m):
            entries += [*((1, int(j)) for j in np.flatnonzero(row == i)), (0, i)]
        self._all = SideBySide(replay, entries)
        self._residual = SideBySide(replay, [(0, i) for i in range(m)])

    def normals(self, x: Array, sensors: Sensors) -> Normals:
        """Normal equations of every sensor at its own x, (n, W)."""
        n = self.n
        whole = np.zeros((n + 1, n + 1, x.shape[1]))
        for span, s, values in self._all.chunks(x, sensors):
            first = 0
            for columns, places in zip(self._columns, self._places, strict=True):
                own = values[first : first + len(columns)]
                fresh = span.start == first == 0
                first += len(columns)
                # [J r] by columns: only the lower triangle is filled.
                for i, (rows, column) in enumerate(zip(places, columns, strict=True)):
                    if fresh and isinstance(rows, slice):
                        np.einsum("ps,jps->js", own[i], own[i:], out=whole[rows, column, s])
                    else:
                        whole[rows, column, s] += np.einsum("ps,jps->js", own[i], own[i:])
        if sensors.hold is not None:
            entries = sensors.hold.entries(x)
            for i in range(n + 1):
                whole[i:, i] += entries[i:] * entries[i]
        return Normals(0.5 * whole[n, n], whole[:, :n])

    def each(self, x: Array, sensors: Sensors) -> Array:
        """[J r] of every reading of every sensor at its own x, (W, N, m, n + 1)."""
        total, width = sensors.samples.shape[1:]
        found = np.zeros((width, total, self.residual_count, self.n + 1))
        for span, s, values in self._all.chunks(x, sensors):
            first = 0
            for i, columns in enumerate(self._columns):
                own = values[first : first + len(columns)]
                first += len(columns)
                found[s, span, i, columns] = own.transpose(2, 1, 0)
        return found

    def slope(self, x: Array, sensors: Sensors) -> tuple[Array, Array]:
        """½Σr² of every sensor, (W,), and Jᵀr, (n, W)."""
        total = np.zeros((self.n + 1, x.shape[1]))
        for _, s, values in self._all.chunks(x, sensors):
            first = 0
            for columns in self._columns:
                own = values[first : first + len(columns)]
                first += len(columns)
                total[_adjacent(columns), s] += np.einsum("ps,jps->js", own[-1], own)
        if sensors.hold is not None:
            entries = sensors.hold.entries(x)
            total += entries * entries[-1]
        return 0.5 * total[self.n], total[: self.n]

    def cost(self, x: Array, sensors: Sensors) -> Array:
        """½Σr² of every sensor, (W,)."""
        total = np.zeros(x.shape[1])
        for _, s, values in self._residual.chunks(x, sensors):
            for own in values:
                total[s] += np.einsum("ps,ps->s", own, own)
        return 0.5 * total

    def pulled(self, x: Array, sensors: Sensors, values: Array) -> Array:
        """Jᵀ·values (n, W) for values (m, N, W), one for every residual."""
        total = np.zeros((self.n + 1, x.shape[1]))
        for span, s, entries in self._all.chunks(x, sensors):
            first = 0
            for columns, own in zip(self._columns, values[:, span, s], strict=True):
                part = entries[first : first + len(columns)]
                first += len(columns)
                total[columns, s] += np.einsum("ps,jps->js", own, part)
        return total[: self.n]

    def studentised(self, x: Array, sensors: Sensors, factor: Array, scale: Array) -> Array:
        """Largest r²/(1 − h) of every sensor, (W,), h the leverage.

        `factor` L (n, n, W) of JᵀJ in units of `scale` (n, W).
        """
        largest = np.zeros(x.shape[1])
        for _, s, values in self._all.chunks(x, sensors):
            first, L = 0, factor[..., s]
            for columns in self._columns:
                own = values[first : first + len(columns)]
                first += len(columns)
                square = np.square(own[-1])
                square /= _left(L, own[:-1] / scale[columns[:-1], None, s], columns[:-1])
                np.maximum(largest[s], square.max(axis=0), out=largest[s])
        return largest

    def residuals(self, x: Array, sensors: Sensors) -> Array:
        """Every residual, (m, N, W)."""
        found = np.empty((self.residual_count, *sensors.samples.shape[1:]))
        for span, s, values in self._residual.chunks(x, sensors):
            found[:, span, s] = values
        return found
