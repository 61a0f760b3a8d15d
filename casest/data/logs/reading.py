"""A log read into columns, whichever recorder wrote it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from casest.data.delimited import Contents
from casest.data.logs.naming import PX4
from casest.data.logs.px4 import read_px4
from casest.data.logs.ros import read_ros
from casest.data.logs.series import joined


def read_log(file: Path, topics: Sequence[str]) -> Contents:
    """Read the named topics (none: the only one) of a ROS bag or PX4 log.

    The column t is in s from the first sample. Raises DataError that lists the topics where the
    choice is missing or wrong, UsageError where the library that reads it is missing.
    """
    read = read_px4 if file.suffix.lower() in PX4 else read_ros
    return joined(file, read(file, topics))
