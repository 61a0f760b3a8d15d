"""PX4 logs (ULog), read with the library pyulog; units as PX4's message definitions state them."""

from __future__ import annotations

import contextlib
import io
import mmap
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from casest.data.column import Column, numeric_column
from casest.data.logs.series import Series, Topic, chosen
from casest.errors import DataError, library

#: By topic, unit: fields. Fields whose unit changed between releases (sensor_baro.pressure) are
#: not in it.
_UNITS: dict[str, dict[str, str]] = {
    "sensor_combined": {"rad/s": "gyro_rad", "m/s^2": "accelerometer_m_s2"},
    "sensor_accel": {"m/s^2": "x y z", "degC": "temperature"},
    "sensor_gyro": {"rad/s": "x y z", "degC": "temperature"},
    "sensor_mag": {"gauss": "x y z", "degC": "temperature"},
    "sensor_baro": {"degC": "temperature"},
    "vehicle_imu": {
        "rad": "delta_angle",
        "m/s": "delta_velocity",
        "us": "delta_angle_dt delta_velocity_dt",
    },
    "vehicle_imu_status": {"degC": "temperature_accel temperature_gyro"},
    "vehicle_acceleration": {"m/s^2": "xyz"},
    "vehicle_angular_velocity": {"rad/s": "xyz", "rad/s^2": "xyz_derivative"},
    "vehicle_angular_acceleration": {"rad/s^2": "xyz"},
    "vehicle_magnetometer": {"gauss": "magnetometer_ga"},
    "vehicle_air_data": {
        "m": "baro_alt_meter",
        "degC": "baro_temp_celcius",
        "Pa": "baro_pressure_pa",
    },
    "vehicle_local_position": {
        "m": "x y z",
        "m/s": "vx vy vz",
        "m/s^2": "ax ay az",
        "rad": "heading",
    },
    "estimator_sensor_bias": {"rad/s": "gyro_bias", "m/s^2": "accel_bias", "gauss": "mag_bias"},
}
_STAMPS = ("timestamp_sample", "timestamp")  # of the raw sample where there is one, in us
_RELATIVE = "accelerometer_timestamp_relative"
_INVALID = 0x7FFFFFFF  # of a relative time stamp: the sample is not valid


def read_px4(file: Path, wanted: Sequence[str]) -> list[Series]:
    """Read topics of a log; an instance of several is named as ulog2csv does: sensor_accel_1."""
    pyulog = library("pyulog", "px4", f"{file}: a PX4 log")
    said = io.StringIO()
    try:
        # The library prints its warnings, and they would stand in the middle of a table.
        with contextlib.redirect_stdout(said):
            with file.open("rb") as stream:
                log = pyulog.ULog(stream, _filter(wanted))
            if wanted and not _all_there(log, wanted):
                with file.open("rb") as stream:
                    log = pyulog.ULog(stream)  # everything, to say what there is
    except Exception as error:  # a damaged file can fail anywhere in the library
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise DataError(f"{file}: cannot be read as a PX4 log ({text}); copy it again") from error
    found = dict(_named(log))
    topics = [Topic(n, d.name, len(d.data["timestamp"])) for n, d in found.items()]
    aliases = [_alias(found, name) for name in wanted]
    notes = _notes(file, log)
    series = []
    for topic in chosen(file, topics, aliases):
        series.append(_series(file, topic, found[topic.name].data, found[topic.name], notes))
        notes = []
    return series


def _filter(wanted: Sequence[str]) -> list[str] | None:
    names = {part for name in wanted for part in (name, re.sub(r"_\d+$", "", name))}
    return sorted(names) or None


def _named(log: Any) -> Iterator[tuple[str, Any]]:
    """Datasets by name: the instance behind it where there are several."""
    names = [dataset.name for dataset in log.data_list]
    for dataset in log.data_list:
        several = names.count(dataset.name) > 1
        yield (f"{dataset.name}_{dataset.multi_id}" if several else dataset.name), dataset


def _alias(found: dict[str, Any], name: str) -> str:
    """`sensor_accel_0` is the only sensor_accel too."""
    bare, _, instance = name.rpartition("_")
    data = found.get(bare)
    return bare if name not in found and data and instance == str(data.multi_id) else name


def _all_there(log: Any, wanted: Sequence[str]) -> bool:
    found = dict(_named(log))
    return all(_alias(found, name) in found for name in wanted)


def _notes(file: Path, log: Any) -> list[str]:
    notes = []
    if left := _unread(file, log):
        notes.append(f"the last {left} of {file.stat().st_size} bytes are cut or damaged, not read")
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts) / 1000
        notes.append(f"{len(log.dropouts)} dropouts of the recorder, {lost:.3g} s in all")
    if log.file_corruption:
        notes.append("the file is damaged: what could not be read was skipped")
    return notes


def _unread(file: Path, log: Any) -> int:
    """Bytes behind the last whole message: the library stops there without a word."""
    at, ends = 16, [offset for offset in getattr(log, "_appended_offsets", []) if offset]
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as raw:
        size = len(raw)
        while at + 3 <= size:
            after = at + 3 + int.from_bytes(raw[at : at + 2], "little")
            if ends and after > ends[0]:
                after = ends.pop(0)  # what was appended begins behind a part that may be cut
            if after > size:
                break
            at = after
    return size - at


def _series(
    file: Path, topic: Topic, data: dict[str, Any], dataset: Any, notes: list[str]
) -> Series:
    stamp = next((s for s in _STAMPS if s in data and data[s].any()), "timestamp")
    units = {
        field: unit
        for unit, fields in _UNITS.get(dataset.name, {}).items()
        for field in fields.split()
    }
    characters = {f.field_name for f in dataset.field_data if f.type_str == "char"}
    used = {n: v for n, v in data.items() if n not in _STAMPS and n not in characters}
    values = {name: value.astype(np.float64) for name, value in used.items()}
    notes = [f"time of {topic.name}: {stamp}", *notes, *_relative(values)]
    columns = [_column(name, value, units) for name, value in values.items()]
    if not columns:
        raise DataError(f"{file}: {topic.name} holds no numbers to read")
    whole = frozenset(name for name, value in used.items() if value.dtype.kind != "f")
    return Series(topic.name, data[stamp].astype(np.int64) * 1000, columns, notes, whole)


def _relative(values: dict[str, Any]) -> list[str]:
    """sensor_combined: void accelerometer samples become NaN; says how far others lie from t."""
    if _RELATIVE not in values:
        return []
    void = values[_RELATIVE] == _INVALID
    for name in values:
        if name.startswith("accelerometer_m_s2"):
            values[name] = np.where(void, np.nan, values[name])
    away = values[_RELATIVE][~void]
    if not away.size or not away.any():
        return []
    return [f"accelerometer samples lie {np.mean(away) / 1000:+.3g} ms from t on average"]


def _column(name: str, values: Any, units: dict[str, str]) -> Column:
    unit = units.get(re.sub(r"\[\d+\]$", "", name))
    return numeric_column(f"{name} [{unit}]" if unit else name, values, None)
