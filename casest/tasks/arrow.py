"""Sensors from Arrow to Arrow: what an engine calls that has workers and files of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from casest.data.options import Options, stated_units
from casest.dataset.files import File
from casest.dataset.layout import layout_of
from casest.dataset.partitions import Piece
from casest.dataset.readings import wide_block
from casest.declaration.model import Model
from casest.errors import UsageError, library
from casest.fleet.calibrate_many import check_model
from casest.tasks.job import Job
from casest.tasks.rows import Rows, record_batch, schema
from casest.tasks.tally import Tally
from casest.tasks.task import calibrated


class _Held:
    """A table in memory, read as a Parquet file is."""

    def __init__(self, table: Any) -> None:
        self.schema_arrow, self._table = table.schema, table

    def iter_batches(self, batch_size: int, columns: Sequence[str]) -> Iterator[Any]:
        """Record batches of some columns."""
        yield from self._table.select(columns).to_batches(max_chunksize=batch_size)


def calibrate_arrow(
    model: Model,
    table: Any,
    *,
    sensor: str = "sensor",
    columns: Mapping[str, Sequence[str]] | None = None,
    units: Mapping[str, str] | None = None,
    keep: Sequence[str] = (),
    noise: float | None = None,
) -> Any:
    """Calibrate the sensors of an Arrow table or record batch: one row each, readings as lists.

    Returns a table as `casest fleet` writes them: `sensor`, each unknown and its `_std`, `trusted`,
    `reason`, `rms`, `misfit`, the columns to `keep`. Numbers are the same to the bit however the
    rows are cut into tables; a sensor that is in two of them is for the caller to find. For Spark's
    `mapInArrow` and Ray's `map_batches`. Raises DataError where a column is missing, UsageError
    for what `calibrate_many` does not do.
    """
    pyarrow = library("pyarrow", "parquet", "calibrate_arrow")
    check_model(model)
    if isinstance(table, pyarrow.RecordBatch):
        table = pyarrow.Table.from_batches([table])
    options = Options(dict(columns or {}), stated_units(columns, units), {}, None, "first", ())
    file = File("table", False, 0)
    layout = layout_of(file, _Held(table), model.in_records, options, sensor=sensor, kept=keep)
    if not layout.wide:
        raise UsageError("calibrate_arrow takes one row for each sensor, its readings as lists")
    job = Job(model, layout, options, Path(), noise)
    form, found, row = schema(job), [], 0

    def write(block: Any, rows: Rows, chosen: Any) -> None:
        found.append(record_batch(job, block, rows, chosen, form))

    for batch in table.select(layout.columns).combine_chunks().to_batches():
        block = wide_block(layout, Piece(file, 0, len(table), ""), row, batch)
        calibrated(job, block, {}, Tally(), Counter(), write)
        row += len(batch)
    whole = pyarrow.Table.from_batches(found, schema=form)
    place = whole.schema.get_field_index("reason")
    return whole.set_column(place, "reason", whole["reason"].cast(pyarrow.string()))
