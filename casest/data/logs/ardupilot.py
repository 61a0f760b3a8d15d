"""ArduPilot logs (DataFlash .bin), indexed by the library pymavlink.

A topic is a type of message; where a log tells sensors of one type apart by a field (marked # in
FMTU), each is a topic of its own: MAG[0], MAG[1]. MAG.raw holds a compass's readings before the
autopilot corrected them.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import units
from casest.data.column import Column, numeric_column
from casest.data.logs.compass import (
    ADDED,
    MILLIGAUSS,
    RAW,
    READING,
    as_logged,
    as_read,
    compass_parameters,
    is_compass,
)
from casest.data.logs.series import Series, Topic, chosen
from casest.errors import CasestError, DataError, library

#: By letter of a format: how a field is stored, and by what it is multiplied. "DataFlash logs",
#: ardupilot.org, and libraries/AP_Logger/README.md.
_STORED: dict[str, tuple[str, float]] = {
    "b": ("i1", 1), "B": ("u1", 1), "h": ("<i2", 1), "H": ("<u2", 1), "i": ("<i4", 1),
    "I": ("<u4", 1), "q": ("<i8", 1), "Q": ("<u8", 1), "f": ("<f4", 1), "d": ("<f8", 1),
    "g": ("<f2", 1), "c": ("<i2", 1e-2), "C": ("<u2", 1e-2), "e": ("<i4", 1e-2),
    "E": ("<u4", 1e-2), "L": ("<i4", 1e-7), "M": ("u1", 1), "n": ("S4", 0), "N": ("S16", 0),
    "Z": ("S64", 0), "a": ("S64", 0),
}  # fmt: skip
#: Units of logs from before FMTU (2018), by message without its number: "Onboard Message Log
#: Messages", ardupilot.org. Fields whose scale changed between releases (CURR) are not in it.
_OLD_UNITS: dict[str, dict[str, str]] = {
    "IMU": {"rad/s": "GyrX GyrY GyrZ", "m/s^2": "AccX AccY AccZ"},
    "ACC": {"m/s^2": "AccX AccY AccZ"},
    "GYR": {"rad/s": "GyrX GyrY GyrZ"},
    "MAG": {"mgauss": "MagX MagY MagZ OfsX OfsY OfsZ MOfsX MOfsY MOfsZ"},
    "ATT": {"deg": "DesRoll Roll DesPitch Pitch DesYaw Yaw"},
    "BARO": {"m": "Alt", "Pa": "Press", "degC": "Temp"},
    "GPS": {"deg": "Lat Lng", "m": "Alt", "m/s": "Spd"},
}
_STAMPS = {"SampleUS": 1000, "TimeUS": 1000, "TimeMS": 1_000_000}  # ns; of the raw sample first
_PLAIN_UNIT = {"degheading": "deg", "deglatitude": "deg", "deglongitude": "deg"}
_LIBRARY = "pymavlink.DFReader"

Records = NDArray[np.void]


def read_ardupilot(file: Path, wanted: Sequence[str]) -> list[Series]:
    """Read types of message of a log as topics: `MAG`, `MAG.raw`, `MAG[1]` of several sensors."""
    reader = library(_LIBRARY, "ardupilot", f"{file}: an ArduPilot log")
    try:
        with _silent():
            log = _index(reader, file)
        try:
            return _topics(file, log, wanted)
        finally:
            log.close()
    except CasestError:
        raise
    except Exception as error:  # a damaged file can fail anywhere in the library
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise DataError(
            f"{file}: cannot be read as an ArduPilot log ({text}); copy it again"
        ) from error


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Without the library's lines on each damaged byte, which its compiled part writes itself."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        stack.enter_context(contextlib.redirect_stderr(io.StringIO()))
        try:
            kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        except OSError:  # nobody listens anyway
            yield
            return
        stack.callback(os.close, kept)
        stack.callback(os.dup2, kept, 2)
        os.dup2(nowhere, 2)
        os.close(nowhere)
        yield


def _index(reader: Any, file: Path) -> Any:
    """Where each message lies. The library's clock of GPS time is left out: no topic needs it."""

    class Index(reader.DFReader_binary):  # type: ignore[misc]
        def __init__(self, name: str) -> None:
            try:
                super().__init__(name)
            except BaseException:
                self.close()  # what it has opened until then
                raise

        def close(self) -> None:
            for opened in ("filehandle", "data_map"):
                if (found := getattr(self, opened, None)) is not None:
                    with contextlib.suppress(BufferError):  # still looked at by what failed
                        found.close()

        def init_clock(self) -> None:
            pass

    return Index(str(file))


def _topics(file: Path, log: Any, wanted: Sequence[str]) -> list[Series]:
    raw = np.frombuffer(log.data_map[:], dtype=np.uint8)
    told = _told(log, raw)
    found: dict[str, tuple[Any, Records]] = {}
    for kind in list(log.formats.values()):
        if _stamp(kind) and kind.name in log.name_to_id:
            for name, records in _instances(kind, _records(log, raw, kind)):
                found[name] = (kind, records)
    names = [_alias(found, name.removesuffix(RAW)) for name in wanted]
    topics = [Topic(name, kind.name, len(records)) for name, (kind, records) in found.items()]
    notes = _unread(log, raw)
    series = []
    for k, topic in enumerate(chosen(file, topics, names)):
        kind, records = found[topic.name]
        one = _series(file, topic, kind, records, told.get(kind.type, []), notes)
        before = k < len(wanted) and wanted[k].endswith(RAW)
        series.append(_compass(file, one, log, raw, before=before))
        notes = []
    return series


def _compass(file: Path, one: Series, log: Any, raw: NDArray[np.uint8], *, before: bool) -> Series:
    """A compass's readings `before` the autopilot corrected them, or a note that it has."""
    unit = next((c.unit for c in one.columns if c.name == READING[0] and c.unit), MILLIGAUSS)
    factor = units.conversion(unit, MILLIGAUSS)[0]
    fields = {c.name: factor * np.asarray(c.values, dtype=np.float64) for c in one.columns}
    if not is_compass(fields):
        if before:
            raise DataError(
                f"{file}: {one.topic}{RAW}: only readings of a compass beside what was added to "
                f"them (OfsX, OfsY, OfsZ) have a topic {RAW}; name {one.topic}"
            )
        return one
    number = log.name_to_id.get("PARM")
    given = compass_parameters(_records(log, raw, log.formats[number]) if number else None)
    if not before:
        return replace(one, notes=[*one.notes, *as_logged(one.topic, fields, given)])
    values, note = as_read(f"{file}: {one.topic}", fields, given)
    own = dict(zip(READING, values.T / factor, strict=True))
    kept = [c for c in one.columns if c.name not in ADDED]
    columns = [replace(c, values=np.ascontiguousarray(own.get(c.name, c.values))) for c in kept]
    return replace(one, columns=columns, notes=[*one.notes, note])


def _stamp(kind: Any) -> str | None:
    return next((name for name in _STAMPS if name in kind.columns), None)


def _records(log: Any, raw: NDArray[np.uint8], kind: Any) -> Records:
    """All messages of one kind as a structured array; one that is cut off at the end is none."""
    dtype = np.dtype([(n, _STORED[c][0]) for n, c in zip(kind.columns, kind.format, strict=True)])
    starts = np.asarray(log.offsets[kind.type], dtype=np.int64) + 3  # behind the header
    starts = starts[starts + dtype.itemsize <= len(raw)]
    body = raw[starts[:, None] + np.arange(dtype.itemsize)]
    return np.ascontiguousarray(body).view(dtype).reshape(-1)


def _instances(kind: Any, records: Records) -> Iterator[tuple[str, Records]]:
    """The messages of each sensor, by name: with its number where there are several."""
    if not kind.instance_field or not len(records):
        yield kind.name, records
        return
    numbers = np.unique(records[kind.instance_field])
    for number in numbers:
        name = kind.name if len(numbers) == 1 else f"{kind.name}[{number}]"
        yield name, records[records[kind.instance_field] == number]


def _alias(found: dict[str, Any], name: str) -> str:
    """`MAG[0]` is the only MAG too, if that is its number."""
    split = re.fullmatch(r"(.+)\[(\d+)\]", name.strip("/"))
    if split is None or name.strip("/") in found or split[1] not in found:
        return name
    kind, records = found[split[1]]
    number = int(records[kind.instance_field][0]) if kind.instance_field and len(records) else 0
    return split[1] if int(split[2]) == number else name


def _told(log: Any, raw: NDArray[np.uint8]) -> dict[int, list[tuple[float, str]]]:
    """By type of message, multiplier and unit of each field (FMTU), "" where there is none."""
    number = log.name_to_id.get("FMTU")
    if number is None:
        return {}
    found = {}
    for record in _records(log, raw, log.formats[number]):
        letters = zip(_letters(record["UnitIds"]), _letters(record["MultIds"]), strict=False)
        # A multiplier of 0 or 1 says that there is none.
        found[int(record["FmtType"])] = [
            (float(log.mult_lookup.get(m) or 1.0), log.unit_lookup.get(u, "")) for u, m in letters
        ]
    return found


def _letters(text: bytes) -> str:
    return text.decode("latin-1")


def _unread(log: Any, raw: NDArray[np.uint8]) -> list[str]:
    """A note on bytes that belong to no message."""
    read = 0
    for number, kind in log.formats.items():
        ends = np.asarray(log.offsets[number], dtype=np.int64) + kind.len
        read += kind.len * int((ends <= len(raw)).sum())
    if not read:
        raise ValueError("no message in it is whole")
    left = len(raw) - read
    return [f"{left} of {len(raw)} bytes are cut or damaged, not read"] if left > 0 else []


def _series(
    file: Path,
    topic: Topic,
    kind: Any,
    records: Records,
    told: list[tuple[float, str]],
    notes: list[str],
) -> Series:
    stamp = next(n for n in _STAMPS if n in kind.columns and (records[n].any() or n == "TimeMS"))
    columns, whole = [], set()
    for k, (name, letter) in enumerate(zip(kind.columns, kind.format, strict=True)):
        _, factor = _STORED[letter]
        if not factor or name in _STAMPS or name == kind.instance_field:
            continue
        multiplier, unit = told[k] if k < len(told) else (1.0, _old_unit(kind.name, name))
        # Divided, not multiplied by 0.01: 363 is 3.63 to the last digit.
        values = records[name] / round(1 / factor) if factor != 1 else records[name] * multiplier
        columns.append(_column(name, unit, values.astype(np.float64)))
        if letter in "bBhHiIqQM" and columns[-1].unit is None:
            whole.add(columns[-1].name)
    if not columns:
        raise DataError(f"{file}: {topic.name} holds no numbers to read")
    time = records[stamp].astype(np.int64) * _STAMPS[stamp]
    return Series(
        topic.name, time, columns, [f"time of {topic.name}: {stamp}", *notes], frozenset(whole)
    )


def _old_unit(kind: str, field: str) -> str:
    table = _OLD_UNITS.get(kind.rstrip("0123456789"), {})
    return next((unit for unit, fields in table.items() if field in fields.split()), "")


def _column(name: str, unit: str, values: NDArray[np.float64]) -> Column:
    """A column in the unit that the log states, where that is one (`instance` is none)."""
    unit = _PLAIN_UNIT.get(unit, unit)
    stated = unit if unit and units.familiar(unit) else None
    return replace(numeric_column(name, values, None), name=name, unit=stated)
