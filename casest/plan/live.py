"""What comes while one measures: lines of a growing file, a pipe or a serial port."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from casest.errors import DataError, UsageError, library

#: Seconds between two looks at what has come.
LOOK = 0.5


def arriving(source: str, idle: float, baud: int) -> Iterator[str]:
    """What has come since the last look, `""` where nothing has; ends after `idle` seconds of that.

    source: `-` for standard input (which ends by itself), a serial port, or a file that grows.
    """
    if source == "-":
        yield from _stream(sys.stdin, idle)
    elif _is_port(source):
        yield from _port(source, idle, baud)
    else:
        yield from _file(Path(source), idle)


def _is_port(source: str) -> bool:
    """A serial port by its name: COM3, /dev/ttyUSB0, /dev/cu.usbmodem1."""
    name = source.rpartition("/")[2]
    return source.startswith("/dev/") or (name.startswith("COM") and name[3:].isdigit())


def _stream(stream: Any, idle: float) -> Iterator[str]:
    """Lines of a pipe, as they come."""
    try:
        number = stream.fileno()
    except (OSError, ValueError, AttributeError):  # no file behind it: all of it is there
        yield stream.read()
        return
    quiet, part = 0.0, b""
    while quiet < idle:
        if not select.select([number], [], [], LOOK)[0]:
            quiet += LOOK
            yield ""
            continue
        come = os.read(number, 1 << 20)
        if not come:
            break
        quiet, whole = 0.0, part + come
        lines, _, part = whole.rpartition(b"\n")
        if lines:
            yield lines.decode("utf-8", errors="replace") + "\n"
    yield part.decode("utf-8", errors="replace")


def _file(path: Path, idle: float) -> Iterator[str]:
    """What is appended to a file."""
    try:
        stream = path.open(encoding="utf-8", errors="replace")
    except OSError as error:
        raise DataError(f"--live {path}: cannot be read ({error.strerror})") from None
    with stream:
        quiet = 0.0
        while quiet < idle:
            text = stream.read()
            quiet = 0.0 if text else quiet + LOOK
            yield text
            if not text:
                time.sleep(LOOK)


def _port(source: str, idle: float, baud: int) -> Iterator[str]:
    """Lines of a serial port."""
    serial = library("serial", "live", "a serial port")
    try:
        port = serial.Serial(source, baud, timeout=LOOK)
    except (OSError, ValueError) as error:
        raise UsageError(f"--live {source}: the port cannot be opened ({error})") from None
    with port:
        quiet = 0.0
        while quiet < idle:
            until, lines = time.monotonic() + LOOK, ""
            while time.monotonic() < until:
                lines += port.readline().decode("utf-8", errors="replace")
            quiet = 0.0 if lines else quiet + LOOK
            yield lines
