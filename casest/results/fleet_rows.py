"""Rows of a fleet's results as the page draws them: some of many, and the outlying of all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.dataset.partitions import Partition
from casest.declaration.shapes import Array
from casest.fleet.population import Population, population
from casest.tasks.job import Job
from casest.tasks.tally import Total

#: Sensors that are drawn; and among how many the outlying ones are looked for.
DRAWN, LOOKED_AT = 200_000, 20_000_000
#: Sensors of which the fleet's distribution is estimated; fewest, for each unknown.
ESTIMATED, FEWEST = 5_000, 5
#: Outlying sensors that are named, and from how many standard deviations of the fleet on.
NAMED, OUTLYING = 20, 5.0
#: Chance that any of so many sound sensors has a largest residual like that of one which is named.
MISREAD = 0.01
#: Standard deviations of a normal distribution between its quartiles.
QUARTILES = 1.349


@dataclass(frozen=True)
class Outlier:
    """A trusted sensor that is unlike the others: in which unknown, how far."""

    sensor: str
    unknown: str
    value: float
    away: float


@dataclass(frozen=True)
class Misread:
    """Trusted sensors of which one reading is far off: how many, the least likely ones by name,
    each with the chance of its largest residual."""

    count: int = 0
    named: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Drawn:
    """S sensors of the fleet in the order of `at`: unknowns (n, S), NaN where refused.

    `at` is the place in the data set, or what `over` names, in s since `since`. `centre` and
    `scale` (n,) are median and standard deviation by the quartiles. `outlying` and `misread` are of
    `looked_at`.
    """

    names: tuple[str, ...]
    values: Array
    rms: Array
    misfit: Array
    trusted: NDArray[np.bool_]
    at: Array
    over: str
    since: str
    centre: Array
    scale: Array
    outlying: tuple[Outlier, ...]
    misread: Misread
    looked_at: int


def drawn(job: Job, partitions: Sequence[Partition], sensors: int) -> Drawn:
    """What the page draws of results that are all there."""
    names = tuple(name for p in job.model.parameters for name in p.entry_names)
    few, partitions, sensors = sensors <= LOOKED_AT, *_some(partitions, sensors)
    step = max(1, -(-sensors // DRAWN))
    over = next((n for n, t in zip(job.layout.kept, job.layout.types[1:], strict=True)
                 if _is_time(t)), "")  # fmt: skip
    columns = [*names, "rms", "misfit", "trusted", *([over] if over else [])]
    parts, first = [], 0
    for batch in _batches(job, partitions, columns):
        chosen = np.arange(-first % step, len(batch), step)
        own = batch.take(pyarrow_array(chosen))
        parts.append([_numbers(own.column(c)) for c in columns] + [first + chosen])
        first += len(batch)
    none = [np.zeros(0)] * (len(columns) + 1)  # every sensor may have been rejected
    whole = [np.concatenate(own) for own in zip(none, *parts, strict=True)]
    values, trusted = np.array(whole[: len(names)]), whole[len(names) + 2].astype(bool)
    at = whole[len(names) + 3].astype(float)
    since = ""
    if over and at.size:
        least = np.nanmin(at)
        since, at = str(np.datetime64(int(least), "s")), at - least
    order = np.argsort(at, kind="stable")
    quartiles = np.array([_quartiles(own[trusted]) for own in values])
    centre, scale = quartiles[:, 1], (quartiles[:, 2] - quartiles[:, 0]) / QUARTILES
    unlike: tuple[tuple[Outlier, ...], Misread] = (), Misread()
    if few:
        unlike = _unlike(job, partitions, names, centre, scale, sensors)
    return Drawn(
        names,
        values[:, order],
        whole[len(names)][order],
        whole[len(names) + 1][order],
        trusted[order],
        at[order],
        over,
        since,
        centre,
        scale,
        *unlike,
        sensors if few else 0,
    )


def estimated(job: Job, partitions: Sequence[Partition], total: Total) -> Population | None:
    """The fleet's distribution from some of its sensors; None without their covariances.

    Outlying sensors are no part of it.
    """
    names = tuple(name for p in job.model.parameters for name in p.entry_names)
    if not job.covariance or job.prior is not None or total.trusted < FEWEST * len(names):
        return None
    partitions, sensors = _some(partitions, total.sensors)
    step, first = max(1, -(-sensors // ESTIMATED)), 0
    parts = []
    for batch in _batches(job, partitions, [*names, "covariance", "trusted"]):
        chosen = np.arange(-first % step, len(batch), step)
        first += len(batch)
        chosen = chosen[_numbers(batch.column("trusted"))[chosen] > 0]
        x = np.array([_numbers(batch.column(n))[chosen] for n in names])
        lower = batch.column("covariance").take(pyarrow_array(chosen)).flatten()
        parts.append((x, _numbers(lower).reshape(len(chosen), -1)))
    x = np.concatenate([own for own, _ in parts], axis=1)
    lower = np.concatenate([own for _, own in parts])
    quartiles = np.array([_quartiles(own) for own in x])
    scale = (quartiles[:, 2] - quartiles[:, 0]) / QUARTILES
    near = (np.abs(x - quartiles[:, 1:2]) <= OUTLYING * scale[:, None]).all(axis=0)
    near &= np.isfinite(lower).all(axis=1)
    if near.sum() < FEWEST * len(names):
        return None
    V = np.zeros((len(lower), len(names), len(names)))
    rows, columns = np.tril_indices(len(names))
    V[:, rows, columns] = V[:, columns, rows] = lower
    variance = np.full(1, total.moments["variance"].mean)
    return population(names, x[:, near].T, V[near], np.sqrt(variance))


def _some(partitions: Sequence[Partition], sensors: int) -> tuple[Sequence[Partition], int]:
    """Evenly chosen partitions with no more than LOOKED_AT sensors, about, and how many those."""
    step = max(1, -(-sensors // LOOKED_AT))
    return partitions[::step], sensors // step


def pyarrow_array(values: Any) -> Any:
    """Places in an Arrow array."""
    import pyarrow

    return pyarrow.array(values)


def _is_time(kind: Any) -> bool:
    import pyarrow

    return bool(pyarrow.types.is_timestamp(kind) or pyarrow.types.is_date(kind))


def _batches(job: Job, partitions: Sequence[Partition], columns: list[str]) -> Iterator[Any]:
    import pyarrow.parquet

    for partition in partitions:
        with pyarrow.parquet.ParquetFile(job.results(partition), pre_buffer=False) as table:
            yield from table.iter_batches(columns=columns, use_threads=False)


def _numbers(column: Any) -> Array:
    """A column as numbers; times in s."""
    import pyarrow

    if _is_time(column.type):
        column = column.cast(pyarrow.timestamp("s"), safe=False).cast(pyarrow.int64())
    return np.asarray(column.cast(pyarrow.float64()).to_numpy(zero_copy_only=False))


def _quartiles(values: Array) -> Array:
    if not len(values):
        return np.full(3, np.nan)
    return np.asarray(np.quantile(values, (0.25, 0.5, 0.75)))


def _unlike(
    job: Job,
    partitions: Sequence[Partition],
    names: tuple[str, ...],
    centre: Array,
    scale: Array,
    sensors: int,
) -> tuple[tuple[Outlier, ...], Misread]:
    """Of all trusted sensors the most outlying, the furthest first; and those with a largest
    residual that no sound one of so many would have."""
    found, count, misread = list[Outlier](), 0, list[tuple[str, float]]()
    # Of an unknown whose quartiles are one number no sensor is far: it has no scale.
    unit = np.where(scale > 0, scale, np.inf)[:, None]
    for batch in _batches(job, partitions, ["sensor", *names, "misfit", "trusted"]):
        values = np.array([_numbers(batch.column(n)) for n in names])
        away = (values - centre[:, None]) / unit
        far = np.fmax.reduce(np.abs(away), axis=0)
        for k in _first(-far, far >= OUTLYING):
            i = int(np.nanargmax(np.abs(away[:, k])))
            found.append(Outlier(_name(batch, k), names[i], float(values[i, k]), float(away[i, k])))
        found = sorted(found, key=lambda o: -abs(o.away))[:NAMED]
        chance = _numbers(batch.column("misfit"))
        off = _numbers(batch.column("trusted")).astype(bool) & (chance * sensors < MISREAD)
        count += int(np.count_nonzero(off))
        misread += [(_name(batch, k), float(chance[k])) for k in _first(chance, off)]
        misread = sorted(misread, key=lambda one: one[1])[:NAMED]
    return tuple(found), Misread(count, tuple(misread))


def _first(order: Array, some: NDArray[np.bool_]) -> Sequence[int]:
    """Places of those that are named of `some`, in their order."""
    places = np.flatnonzero(some)
    return [int(k) for k in places[np.argsort(order[places], kind="stable")[:NAMED]]]


def _name(batch: Any, k: int) -> str:
    return str(batch.column("sensor")[k].as_py())
