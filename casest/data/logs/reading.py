"""A log read into columns, whichever recorder wrote it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from casest.data.delimited import Contents
from casest.data.logs.ardupilot import read_ardupilot
from casest.data.logs.naming import ARDUPILOT, PX4
from casest.data.logs.px4 import read_px4
from casest.data.logs.ros import read_ros
from casest.data.logs.series import joined


def read_log(file: Path, topics: Sequence[str]) -> Contents:
    """Read the named topics (none: the only one) of a ROS bag, PX4 log or ArduPilot log.

    The column t is in s from the first sample. Raises DataError that lists the topics where the
    choice is missing or wrong, UsageError where the library that reads it is missing.
    """
    suffix = file.suffix.lower()
    read = read_px4 if suffix in PX4 else read_ardupilot if suffix in ARDUPILOT else read_ros
    return joined(file, read(file, topics))
