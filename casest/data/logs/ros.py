"""ROS 1 and ROS 2 bags, read with the library rosbags; units by REP 103 and the messages' texts."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from casest.data.column import Column, numeric_column
from casest.data.logs.series import Series, Topic, chosen
from casest.errors import CasestError, DataError, library

#: By message type and field: sources are REP 103 and the comments of the message definitions.
UNITS: dict[str, dict[str, str]] = {
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    "sensor_msgs/msg/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/msg/Temperature": {"temperature": "degC"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/msg/RelativeHumidity": {"relative_humidity": "1"},
    "sensor_msgs/msg/Range": {"range": "m", "min_range": "m", "max_range": "m"},
    "sensor_msgs/msg/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m"},
    "sensor_msgs/msg/BatteryState": {"voltage": "V", "current": "A", "temperature": "degC"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/msg/Wrench": {"force": "N", "torque": "N*m"},
    "geometry_msgs/msg/Pose": {"position": "m"},
    "geometry_msgs/msg/PointStamped": {"point": "m"},
    "geometry_msgs/msg/Transform": {"translation": "m"},
}
_HEADER = "std_msgs/msg/Header"
_TIMES = (_HEADER, "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_LONGEST = 16  # entries of an array that become columns


@dataclass
class _Leaf:
    """A number (or an array of them) in every message: where it is, and its values so far."""

    path: str
    unit: str | None
    kind: str
    is_array: bool
    values: array[float] = field(default_factory=lambda: array("d"))
    lengths: set[int] = field(default_factory=set)

    def columns(self) -> list[Column]:
        """One column, or one for each entry of an array."""
        header = f" [{self.unit}]" if self.unit else ""
        flat = np.array(self.values, dtype=np.float64)
        if not self.is_array:
            return [numeric_column(self.path + header, flat, None)]
        rows = flat.reshape(-1, next(iter(self.lengths)))
        return [
            numeric_column(f"{self.path}[{i}]{header}", rows[:, i], None)
            for i in range(rows.shape[1])
        ]


def read_ros(file: Path, wanted: Sequence[str]) -> list[Series]:
    """Read topics of a bag: times from the header's stamp, else from the recording."""
    highlevel = library("rosbags.highlevel", "ros", f"{file}: a ROS bag")
    typesys = library("rosbags.typesys", "ros")
    # Bags of old ROS 2 releases hold no definitions: the present ones stand in.
    store = typesys.get_typestore(typesys.Stores.LATEST)
    try:
        _refuse_half_pages(file)
        with highlevel.AnyReader([file], default_typestore=store) as reader:
            topics = [Topic(n, _short(t.msgtype), t.msgcount) for n, t in reader.topics.items()]
            return [_series(file, reader, topic) for topic in chosen(file, topics, wanted)]
    except CasestError:
        raise
    except Exception as error:  # a damaged file can fail anywhere in the library
        raise _damaged(file, (str(error) or type(error).__name__).splitlines()[0]) from error


def _damaged(file: Path, said: str) -> DataError:
    return DataError(
        f"{file}: cannot be read as a ROS bag ({said.rstrip('.')}); if the recording was broken "
        f"off, 'rosbag reindex' or 'ros2 bag reindex' may mend it"
    )


def _refuse_half_pages(path: Path) -> None:
    """SQLite reads what is cut off its last page as zeros: readings would be zero without a sign.

    Bytes 16 and 17 of the file hold the size of a page (1: 65536), see sqlite.org/fileformat.
    """
    for file in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        with file.open("rb") as stream:
            start = stream.read(18)
        if file.suffix == ".db3" and len(start) == 18 and start.startswith(b"SQLite format 3"):
            page = int.from_bytes(start[16:18], "big")
            if file.stat().st_size % (65536 if page == 1 else max(page, 1)):
                raise _damaged(file, "the end of its last page is missing")


def _short(kind: str | None) -> str:
    return (kind or "several types").replace("/msg/", "/")


def _series(file: Path, reader: Any, topic: Topic) -> Series:
    connections = [c for c in reader.connections if c.topic == topic.name]
    kind = connections[0].msgtype
    if any(c.msgtype != kind for c in connections):
        raise DataError(f"{file}: {topic.name} changes its type of message; choose another topic")
    fields = reader.typestore.fielddefs
    if kind not in fields:
        raise DataError(f"{file}: {topic.name}: the type {kind} is not defined in the bag")
    leaves = list(_leaves(fields, kind))
    stamped = any(name == "header" and d[1] == _HEADER for name, d in fields[kind][1])
    stamps, received = array("q"), array("q")
    getters = [(leaf, attrgetter(leaf.path)) for leaf in leaves]
    missing: set[str] = set()
    for connection, time, raw in reader.messages(connections):
        message = reader.deserialize(raw, connection.msgtype)
        if not received:
            missing = _without_estimate(message, leaves)
        received.append(time)
        if stamped:
            stamp = message.header.stamp
            stamps.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        for leaf, get in getters:
            value = get(message)
            if leaf.is_array:
                leaf.values.extend(value)
                leaf.lengths.add(len(value))
            else:
                leaf.values.append(value)
    kept, notes = _kept(leaves, missing)
    if not kept:
        raise DataError(f"{file}: {topic.name} ({topic.kind}) holds no numbers to read")
    columns = [column for leaf in kept for column in leaf.columns()]
    whole = {c.name for leaf in kept if "float" not in leaf.kind for c in leaf.columns()}
    use_stamps = stamped and any(stamps)
    notes.insert(0, f"time of {topic.name}: {_source(stamped, use_stamps)}")
    times = np.array(stamps if use_stamps else received, dtype=np.int64)
    return Series(topic.name, times, columns, notes, frozenset(whole))


def _source(stamped: bool, used: bool) -> str:
    if used:
        return "header stamps"
    why = "all header stamps are 0" if stamped else "the messages have no header"
    return f"when each message was recorded ({why})"


def _leaves(fields: Any, kind: str, path: str = "", unit: str | None = None) -> Iterator[_Leaf]:
    """Numbers in a message and the messages within it, by path; times and text are none."""
    node_type = library("rosbags.interfaces", "ros").Nodetype
    for name, (node, what) in fields[kind][1]:
        here = f"{path}.{name}" if path else name
        own = UNITS.get(kind, {}).get(name, unit)
        if node == node_type.NAME:
            if what not in _TIMES:
                yield from _leaves(fields, what, here, own)
        elif node == node_type.BASE:
            if "string" not in what[0]:
                yield _Leaf(here, own, what[0], is_array=False)
        elif what[0][0] == node_type.BASE and "string" not in what[0][1][0]:
            yield _Leaf(here, own, what[0][1][0], is_array=True)


def _without_estimate(message: Any, leaves: Iterable[_Leaf]) -> set[str]:
    """Fields of sensor_msgs whose covariance begins with -1: the sensor does not measure them."""
    found = set()
    for leaf in leaves:
        if leaf.is_array and leaf.path.endswith("_covariance"):
            covariance = attrgetter(leaf.path)(message)
            if len(covariance) and covariance[0] == -1:
                found.add(leaf.path.removesuffix("_covariance"))
    return found


def _kept(leaves: Sequence[_Leaf], missing: set[str]) -> tuple[list[_Leaf], list[str]]:
    """Leaves that become columns, and notes on the others."""
    notes = [f"{name} left out: its covariance says that it is not measured" for name in missing]
    kept = []
    for leaf in leaves:
        if leaf.is_array and "covariance" in leaf.path.rpartition(".")[2]:
            continue  # what the driver declares, not what was measured
        if any(leaf.path.startswith(f"{name}.") for name in missing):
            continue
        if leaf.is_array and (len(leaf.lengths) != 1 or max(leaf.lengths) > _LONGEST):
            if max(leaf.lengths, default=0):
                notes.append(f"{leaf.path} left out: an array of {_count(leaf.lengths)} entries")
            continue
        if not leaf.is_array or max(leaf.lengths):
            kept.append(leaf)
    return kept, notes


def _count(lengths: set[int]) -> str:
    return str(min(lengths)) if len(lengths) == 1 else f"{min(lengths)} to {max(lengths)}"
