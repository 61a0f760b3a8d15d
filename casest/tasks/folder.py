"""The folder of a fleet: whose results it holds, what is done in it, what is left over."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from casest.data.write import make_folder, write_atomically, written_at_once
from casest.dataset.partitions import Partition
from casest.errors import DataError, UsageError
from casest.tasks.job import RESULTS, TASKS, Job
from casest.tasks.tally import FILE, Rejected, Tally

JOB, REJECTED = "job.json", "rejected.parquet"
#: Rows of the list of the rejected that are written at once.
PIECE = 1 << 16


def refuse_others(job: Job) -> None:
    """UsageError where the folder holds results of something else."""
    file = job.folder / TASKS / JOB
    if file.exists():
        _refuse_others(job, _read(file))
    elif (job.folder / RESULTS).exists():
        raise UsageError(
            f"-o {job.folder}: holds a folder {RESULTS} that casest fleet did not begin; give "
            "another -o"
        )


def prepared(job: Job) -> None:
    """Make the folder, and say in it whose it is."""
    file = job.folder / TASKS / JOB
    with written_at_once():
        for name in (RESULTS, TASKS):
            make_folder(job.folder / name)
        write_atomically(file, json.dumps(job.identity, indent=2) + "\n")


def _read(file: Path) -> dict[str, str]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict):
        raise DataError(f"{file}: cannot be read; remove the folder above it, or give another -o")
    return found


def _refuse_others(job: Job, before: dict[str, str]) -> None:
    for name, own in job.identity.items():
        if before.get(name) != own:
            raise UsageError(
                f"-o {job.folder}: holds results of {_what(name, before.get(name, 'nothing'))}, "
                f"and this is {_what(name, own)}: they are not mixed; give another -o"
            )


def _what(name: str, value: str) -> str:
    """A part of a job's identity in words."""
    if name == "model":
        return f"the model {value}"
    return f"other {name} ({value})" if name in ("options", "columns") else f"{name} {value}"


def missing(job: Job, partitions: Sequence[Partition]) -> list[Partition]:
    """Partitions that are not done."""
    return [p for p in partitions if not job.done(p)]


def tallies(job: Job, partitions: Iterable[Partition]) -> Iterator[Tally]:
    """The tallies of partitions that are done, in their order."""
    for partition in partitions:
        file = job.tally(partition)
        try:
            yield msgspec.json.decode(file.read_bytes(), type=Tally)
        except (OSError, msgspec.MsgspecError):
            raise DataError(f"{file}: cannot be read; remove it and run again") from None


def swept(job: Job, partitions: Sequence[Partition]) -> int:
    """Remove results of input that is no longer there, and what was left half written.

    Returns of how many partitions.
    """
    known = {path for p in partitions for path in (job.results(p), job.tally(p))}
    known.add(job.folder / TASKS / JOB)
    removed = 0
    for name in (RESULTS, TASKS):
        for path in sorted((job.folder / name).iterdir()):
            if path not in known and "part-" in path.name:
                path.unlink()
                removed += path.suffix == ".parquet"
    return removed


def write_rejected(
    job: Job, partitions: Sequence[Partition], unreadable: Sequence[tuple[str, str]]
) -> None:
    """`rejected.parquet`: file, row, sensor, kind and reason of all that has no trusted numbers.

    In the order of the data set, after the files that could not be opened.
    """
    import pyarrow
    import pyarrow.parquet

    words = pyarrow.dictionary(pyarrow.int32(), pyarrow.string())
    form = pyarrow.schema(
        [
            ("file", words),
            ("row", pyarrow.int64()),
            ("sensor", pyarrow.string()),
            ("kind", words),
            ("reason", pyarrow.string()),
        ]
    )
    sink = pyarrow.BufferOutputStream()
    with pyarrow.parquet.ParquetWriter(sink, form) as writer:
        first = [Rejected(file, None, None, FILE, reason) for file, reason in unreadable]
        for part in _pieces(first, tallies(job, partitions)):
            columns = [
                pyarrow.array([getattr(one, f.name) for one in part]).cast(f.type)
                if f.type != words
                else pyarrow.array([getattr(one, f.name) for one in part]).dictionary_encode()
                for f in form
            ]
            writer.write_batch(pyarrow.RecordBatch.from_arrays(columns, schema=form))
    write_atomically(job.folder / REJECTED, bytes(sink.getvalue()))


def _pieces(first: list[Rejected], rest: Iterable[Tally]) -> Iterator[list[Rejected]]:
    held = first
    for tally in rest:
        held += tally.rejected
        while len(held) >= PIECE:
            yield held[:PIECE]
            held = held[PIECE:]
    if held:
        yield held
