"""How a topic of a log is named: `flight.bag:/imu/data`, as a model in a file is."""

from __future__ import annotations

import os
import re
from pathlib import Path

BAGS = (".bag", ".mcap", ".db3")
PX4 = (".ulg", ".ulog")
ARDUPILOT = (".bin",)
_DATAFLASH = b"\xa3\x95"  # how each message of an ArduPilot log begins; others call files .bin too


def is_log(file: Path) -> bool:
    """Whether a file is a ROS bag (ROS 2: also its folder), a PX4 log or an ArduPilot log."""
    suffix = file.suffix.lower()
    if suffix in ARDUPILOT and file.is_file():
        with file.open("rb") as stream:
            return stream.read(2) == _DATAFLASH
    known = (*BAGS, *PX4, *ARDUPILOT)
    return suffix in known or (file / "metadata.yaml").is_file()


def file_and_topics(path: str | os.PathLike[str]) -> tuple[Path, tuple[str, ...]]:
    """Split `flight.bag:/imu/data,/imu/mag` into the file and the topics named behind it."""
    text = os.fspath(path)
    found = re.fullmatch(r"((?:[A-Za-z]:(?=[\\/]))?[^:]+):(.*)", text)
    if found is None or Path(text).exists():
        return Path(text), ()
    file = Path(found[1])
    if not (is_log(file) or file.exists()):
        return Path(text), ()
    return file, tuple(name.strip() for name in found[2].split(",") if name.strip())


def parts_of(path: str | os.PathLike[str]) -> list[str]:
    """The files that a + joins; a file with a + in its own name is one."""
    text = os.fspath(path)
    parts = [part.strip() for part in text.split("+")]
    alone = len(parts) == 1 or Path(text).exists() or not all(parts)
    return [text] if alone else parts


def file_name(path: str | os.PathLike[str]) -> str:
    """Name of a record without its folder: "flight.bag:/imu/data" keeps its topic."""
    names = []
    for part in parts_of(path):
        file, topics = file_and_topics(part)
        names.append(f"{file.name}:{','.join(topics)}" if topics else file.name)
    return "+".join(names)
