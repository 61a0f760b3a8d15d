"""Logs of several topics: ROS bags by rosbags; PX4 and ArduPilot logs by the published formats."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

BEGIN = 1_700_000_000_123_456_789  # ns: a time of day, as header stamps have it
FORMATS = ("bag", "sqlite3", "mcap")


def bag(path: Path, form: str, topics: dict[str, tuple[str, list]]) -> Path:
    """A bag of {topic: (type, [(time in ns, message)])}; `form` is bag, sqlite3 or mcap."""
    first = form == "bag"
    store = typestore(form)
    if first:
        writer = Writer1(path)
    else:
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin[form.upper()])
    pack = store.serialize_ros1 if first else store.serialize_cdr
    with writer:
        rows = []
        for topic, (kind, messages) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            rows += [(time, i, connection, kind, m) for i, (time, m) in enumerate(messages)]
        for time, _, connection, kind, message in sorted(rows, key=lambda row: row[:2]):
            writer.write(connection, time, pack(message, kind))
    return path


def typestore(form: str):
    """Message types of ROS 1 or ROS 2."""
    return get_typestore(Stores.ROS1_NOETIC if form == "bag" else Stores.ROS2_JAZZY)


class Messages:
    """Messages with header stamps, of one release of ROS."""

    def __init__(self, form: str = "bag") -> None:
        self.form = form
        self.types = typestore(form).types

    def header(self, stamp: int):
        time = self.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        extra = {"seq": 0} if self.form == "bag" else {}
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id="imu_link", **extra)

    def vector(self, x):
        return self.types["geometry_msgs/msg/Vector3"](*map(float, x))

    def imu(self, stamp: int, force, rate=(0, 0, 0), attitude=(0, 0, 0, 1), known: bool = False):
        covariance = np.zeros(9)
        covariance[0] = 0 if known else -1
        return self.types["sensor_msgs/msg/Imu"](
            header=self.header(stamp),
            orientation=self.types["geometry_msgs/msg/Quaternion"](*map(float, attitude)),
            orientation_covariance=covariance,
            angular_velocity=self.vector(rate),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(force),
            linear_acceleration_covariance=np.zeros(9),
        )

    def field(self, stamp: int, flux):
        return self.types["sensor_msgs/msg/MagneticField"](
            header=self.header(stamp),
            magnetic_field=self.vector(flux),
            magnetic_field_covariance=np.zeros(9),
        )

    def text(self, words: str):
        return self.types["std_msgs/msg/String"](data=words)


def imu_topic(form: str, force, rate: float = 100.0, late: int = 2_000_000):
    """A topic of readings (N, 3) of force, stamped evenly, recorded `late` ns after the stamp."""
    make = Messages(form)
    stamps = [BEGIN + round(i * 1e9 / rate) for i in range(len(force))]
    return "sensor_msgs/msg/Imu", [
        (s + late, make.imu(s, f)) for s, f in zip(stamps, force, strict=True)
    ]


def ulog(path: Path, topics: dict[str, tuple[str, np.ndarray]], *, dropout: int = 0) -> Path:
    """A PX4 log of {name or name_instance: (fields "uint64_t timestamp;float[3] x", records)}.

    Records are packed structured arrays. Source: "ULog File Format", docs.px4.io.
    """

    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    kinds = {}
    for name, (fields, _) in topics.items():
        kinds[name.rstrip("0123456789").rstrip("_")] = fields
    parts += [message("F", f"{kind}:{fields};".encode()) for kind, fields in kinds.items()]
    rows = []
    for number, (name, (_, records)) in enumerate(topics.items()):
        kind = name.rstrip("0123456789").rstrip("_")
        instance = int(name[len(kind) + 1 :] or 0)
        parts.append(message("A", struct.pack("<BH", instance, number) + kind.encode()))
        rows += [(int(r["timestamp"]), struct.pack("<H", number) + r.tobytes()) for r in records]
    parts += [message("D", body) for _, body in sorted(rows, key=lambda row: row[0])]
    if dropout:
        parts.append(message("O", struct.pack("<H", dropout)))
    path.write_bytes(b"".join(parts))
    return path


def records(time, **columns) -> tuple[str, np.ndarray]:
    """Fields and records of a topic: timestamp in us, then float columns (N,) or (N, k)."""
    dtype: list = [("timestamp", "<u8")]
    fields = ["uint64_t timestamp"]
    for name, values in columns.items():
        values = np.asarray(values)
        kind, word = {"f": ("<f4", "float"), "i": ("<i4", "int32_t"), "u": ("<u8", "uint64_t")}[
            values.dtype.kind
        ]
        shape = values.shape[1:]
        dtype.append((name, kind, shape))
        fields.append(f"{word}[{shape[0]}] {name}" if shape else f"{word} {name}")
    made = np.zeros(len(time), dtype=dtype)
    made["timestamp"] = time
    for name, values in columns.items():
        made[name] = values
    return ";".join(fields), made


_DATAFLASH = {"B": "B", "h": "h", "f": "f", "Q": "Q", "c": "h", "N": "16s", "Z": "64s", "n": "4s",
              "b": "b", "d": "d", "L": "i"}  # fmt: skip


def dataflash(
    path: Path,
    kinds: dict[str, tuple[str, str, str, str, list[tuple]]],
    units: dict[str, str] | None = None,
    multipliers: dict[str, float] | None = None,
) -> Path:
    """An ArduPilot log of {type: (format, "TimeUS,I,MagX", units, multipliers, rows)}.

    Rows hold the stored numbers. `units` and `multipliers` say what the letters mean; without them
    the log is one from before 2018. Source: "DataFlash logs", libraries/AP_Logger/README.md.
    """

    def message(number: int, form: str, *values) -> bytes:
        body = struct.pack("<" + "".join(_DATAFLASH[c] for c in form), *values)
        return b"\xa3\x95" + bytes([number]) + body

    def described(number: int, name: str, form: str, columns: str) -> bytes:
        size = 3 + struct.calcsize("<" + "".join(_DATAFLASH[c] for c in form))
        words = (name.encode(), form.encode(), columns.encode())
        return message(0x80, "BBnNZ", number, size, *words)

    parts = [described(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    numbers = {name: 0x90 + k for k, name in enumerate(kinds)}
    for name, (form, columns, *_) in kinds.items():
        parts.append(described(numbers[name], name, form, columns))
    if units is not None:
        parts.append(described(0xF0, "UNIT", "QbZ", "TimeUS,Id,Label"))
        parts.append(described(0xF1, "MULT", "Qbd", "TimeUS,Id,Mult"))
        parts.append(described(0xF2, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds"))
        parts += [message(0xF0, "QbZ", 1, ord(k), v.encode()) for k, v in units.items()]
        parts += [message(0xF1, "Qbd", 1, ord(k), v) for k, v in (multipliers or {}).items()]
        for name, (_, _, of_units, of_multipliers, _) in kinds.items():
            letters = (of_units.encode(), of_multipliers.encode())
            parts.append(message(0xF2, "QBNN", 1, numbers[name], *letters))
    rows = [(row, name) for name, kind in kinds.items() for row in kind[4]]
    for row, name in sorted(rows, key=lambda pair: pair[0][0]):
        parts.append(message(numbers[name], kinds[name][0], *row))
    path.write_bytes(b"".join(parts))
    return path
