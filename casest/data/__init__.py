"""Measured records: reading them, binding them to a model's signals, averaging, splitting."""

from casest.data.bind import load_runs
from casest.data.logs import file_and_topics, file_name
from casest.data.rest import at_rest
from casest.data.run import Run
from casest.data.splits import interleaved_blocks
from casest.data.table import Column, Table, read_table
from casest.data.write import write_atomically, written_together

__all__ = [
    "Column",
    "Run",
    "Table",
    "at_rest",
    "file_and_topics",
    "file_name",
    "interleaved_blocks",
    "load_runs",
    "read_table",
    "write_atomically",
    "written_together",
]
