"""One partition, calibrated: a pure task, whose result appears whole or not at all."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from casest.data.write import write_atomically, written_at_once
from casest.dataset.partitions import Partition
from casest.dataset.readings import Block, blocks, bound, name_of, together
from casest.declaration.shapes import Array
from casest.errors import DataError
from casest.fleet.calibrate_many import calibrate_many
from casest.fleet.population import calibrate_with
from casest.tasks.job import Job
from casest.tasks.rows import Rows, adjacent, record_batch, schema
from casest.tasks.tally import FILE, NAMELESS, READINGS, REFUSED, TWICE, Moments, Rejected, Tally

#: Up to so many readings sensors of one number are calibrated together; beyond, numbers that are
#: at most an eighth apart are, the short ones filled up.
FEW = 32
#: Writes the chosen rows of a block.
Write = Callable[[Block, Rows, NDArray[np.int_]], None]


def run(job: Job, partition: Partition) -> int:
    """Calibrate a partition and write its files, unless they are there. Returns its number.

    Raises DataError where they cannot be written.
    """
    if job.done(partition):
        return partition.number
    tally, made = Tally(), Counter[str]()
    with written_at_once(), _written(job, job.results(partition)) as write:
        for block in _readable(job, partition, tally):
            calibrated(job, block, dict(partition.twice), tally, made, write)
        tally.codes = dict(sorted(made.items()))
        write_atomically(job.tally(partition), msgspec.json.encode(tally) + b"\n")
    return partition.number


def _readable(job: Job, partition: Partition, tally: Tally) -> Iterator[Block]:
    """Blocks of every piece as far as it can be read."""
    for pieces in together(partition.pieces, job.layout):
        row = 0
        try:
            for block in blocks(job.layout, pieces):
                row = int(block.rows[-1]) + 1
                yield block
        except DataError as error:
            said = f" (what lies before row {row} is calibrated)" if row else ""
            tally.reject(Rejected(pieces[0].file.name, row, None, FILE, f"{error}{said}"))


def calibrated(
    job: Job,
    block: Block,
    twice: dict[str, str],
    tally: Tally,
    made: Counter[str],
    write: Write,
) -> None:
    """Calibrate a block, write its rows, count."""
    signals = bound(block, job.layout, job.model.in_records, job.options)
    rows = Rows(job.model, len(block.counts), job.covariance)
    chosen = _named(block, twice, tally)
    ends = np.concatenate([[0], np.cumsum(block.counts)])
    fit = np.ones(len(block.counts), bool)
    fit[[*block.bad]] = False
    usable = chosen[fit[chosen]]
    for places in alike(block.counts, usable):
        given, counts = side_by_side(signals, block.counts, ends, places)
        if job.prior is None:
            found = calibrate_many(job.model, given, counts=counts, noise=job.noise, misfit=True)
        else:
            found = calibrate_with(job.model, given, job.prior, counts)
        rows.put(places, found)
    for k in map(int, chosen[~rows.trusted[chosen]]):
        bad = k in block.bad
        reason = rows.reasons[k] = block.bad[k] if bad else rows.reasons[k]
        made[READINGS if bad else rows.codes[k]] += 1
        kind = READINGS if bad else REFUSED
        tally.reject(Rejected(block.file, int(block.rows[k]), name_of(block, k), kind, reason))
    tally.sensors += len(chosen)
    tally.trusted += int(rows.trusted.sum())
    _measure(job, rows, tally)
    if len(chosen):
        write(block, rows, chosen)


def _named(block: Block, twice: dict[str, str], tally: Tally) -> NDArray[np.int_]:
    """Places of sensors that have a name of their own."""
    from casest.dataset.names import empty

    blank = empty(block.names)
    for k in np.flatnonzero(blank):
        row = int(block.rows[k])
        reason = f"row {row} does not say whose readings it holds: its sensor has no name"
        tally.reject(Rejected(block.file, row, None, NAMELESS, reason))
    chosen = np.flatnonzero(~blank)
    if not twice:
        return chosen
    kept = []
    for k in chosen:
        name = name_of(block, int(k)) or ""
        if name in twice:
            tally.reject(Rejected(block.file, int(block.rows[k]), name, TWICE, twice[name]))
        else:
            kept.append(k)
    return np.array(kept, dtype=int)


def alike(counts: NDArray[np.int64], places: NDArray[np.int_]) -> Iterator[NDArray[np.int_]]:
    """Groups of sensors that are calibrated together, by the number of their readings alone."""
    if not len(places):
        return
    found, which = np.unique(counts[places], return_inverse=True)
    padded = np.array([_padded(int(n)) for n in found])
    for n in np.unique(padded):
        yield places if len(found) == 1 else places[(padded == n)[which]]


def _padded(count: int) -> int:
    if count <= FEW:
        return count
    step = 1 << (count.bit_length() - 4)
    return -(-count // step) * step


def side_by_side(
    signals: dict[str, Array],
    counts: NDArray[np.int64],
    ends: NDArray[np.int64],
    places: NDArray[np.int_],
) -> tuple[dict[str, Array], Array | None]:
    """Readings (S, N, size) of a group, and how many of each count where that differs."""
    longest = _padded(int(counts[places[0]]))
    first, stop = int(ends[places[0]]), int(ends[places[-1] + 1])
    if longest <= FEW and stop - first == longest * len(places):
        shape = (len(places), longest, -1)
        return {n: v[first:stop].reshape(shape) for n, v in signals.items()}, None
    rows, own = ends[places][:, None] + np.arange(longest), counts[places]
    if longest > FEW:  # rows beyond a sensor's own are never looked at: any will do
        rows = np.minimum(rows, (ends[places] + own - 1)[:, None])
    # Column by column: NumPy takes numbers from one faster than rows from a table.
    given = {n: np.take(v.T, rows, axis=1).transpose(1, 2, 0) for n, v in signals.items()}
    return given, own.astype(float) if longest > FEW else None


def _measure(job: Job, rows: Rows, tally: Tally) -> None:
    """Moments of every unknown and of the residual, of trusted sensors."""
    names = [name for p in job.model.parameters for name in p.entry_names]
    measured = dict(zip(names, rows.x, strict=True)) | {"rms": rows.rms, "variance": rows.variance}
    measured |= {f"{n}_std": v for n, v in zip(names, rows.std, strict=True)}
    trusted = adjacent(np.flatnonzero(rows.trusted))
    for name, values in measured.items():
        if (own := Moments.of(values[trusted])).count:
            tally.moments[name] = tally.moments.get(name, Moments()).joined(own)


@contextlib.contextmanager
def _written(job: Job, target: Path) -> Iterator[Write]:
    """A Parquet file that is written beside its place, reaches the disk, and is then renamed."""
    import pyarrow.parquet

    beside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}")
    form = schema(job)
    try:
        # Digits of measured numbers do not compress: trying to costs more than writing them.
        packed = {f.name: "none" if f.type == pyarrow.float64() else "snappy" for f in form}
        with pyarrow.parquet.ParquetWriter(
            str(beside), form, use_dictionary=["reason"], compression=packed
        ) as writer:
            yield lambda block, rows, chosen: writer.write_batch(
                record_batch(job, block, rows, chosen, form)
            )
        with beside.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(beside, target)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else error  # Arrow's own words are longer
        raise DataError(f"{target}: cannot be written ({why})") from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink()
