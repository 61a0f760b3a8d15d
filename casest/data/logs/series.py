"""Topics as series of samples, the choice of topics, and several of them on one clock."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from casest.data.column import BadCell, Column
from casest.data.delimited import Contents
from casest.errors import DataError

Times = NDArray[np.int64]
Array = NDArray[np.float64]

_LISTED = 40  # topics that an error names
_TURN = {"deg": 360.0, "rad": 2 * np.pi}  # units in which an angle may jump by a whole turn
_GAP = 5.0  # times the median step: across more than that nothing is interpolated


@dataclass(frozen=True)
class Topic:
    """What a log says of a topic before it is read."""

    name: str
    kind: str
    count: int

    def __str__(self) -> str:
        """Name, type (where the name is not it) and number of messages."""
        said = f"{self.kind}, {self.count}" if self.kind != self.name else f"{self.count}"
        return f"{self.name} ({said})" if self.kind else self.name


@dataclass(frozen=True)
class Series:
    """One topic: `time` (N,) in ns, columns of N; `whole` names those of integers and flags."""

    topic: str
    time: Times
    columns: Sequence[Column]
    notes: Sequence[str] = ()
    whole: frozenset[str] = field(default_factory=frozenset)


def chosen(file: Path, topics: Sequence[Topic], wanted: Sequence[str]) -> list[Topic]:
    """Return the topics that are wanted, or the only one; DataError lists what the log holds."""
    filled = [topic for topic in topics if topic.count]
    if not filled:
        raise DataError(f"{file}: holds no messages; was the recording stopped at once?")
    if not wanted and len(filled) == 1:
        return filled
    listed = ", ".join(str(topic) for topic in filled[:_LISTED])
    listed += f", … ({len(filled)} in all)" if len(filled) > _LISTED else ""
    if not wanted:
        longest = max(filled, key=lambda topic: topic.count)  # sensors speak most often
        raise DataError(
            f"{file}: holds {len(filled)} topics; name one behind the file, "
            f"{file}:{longest.name}, or several that were recorded together, separated by "
            f"commas. It holds {listed}"
        )
    names = {topic.name: topic for topic in filled}
    bare = {topic.name.strip("/"): topic for topic in filled}
    found = []
    for name in wanted:
        topic = names.get(name) or bare.get(name.strip("/"))
        if topic is None:
            near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.5)
            hint = f"did you mean {file}:{near[0]}? " if near else ""
            raise DataError(f"{file}: no topic {name}; {hint}It holds {listed}")
        if topic in found:
            raise DataError(f"{file}: the topic {name} is named twice")
        found.append(topic)
    return found


def joined(file: Path, series: Sequence[Series]) -> Contents:
    """Columns of one topic as they are; of several on the clock of the slowest.

    The other topics are interpolated linearly at its times (integers, flags and text: the value
    before), which the notes say; samples in gaps or outside of another topic are left out and
    counted. Several topics' columns begin with the topic's name.
    """
    if len(series) == 1:
        return Contents([_clock(series[0].time), *series[0].columns], list(series[0].notes))
    for one in series:
        _refuse_unordered(file, one)
    slowest = min(series, key=lambda one: len(one.time))
    kept = np.logical_and.reduce([_covered(one.time, slowest.time) for one in series])
    if not kept.any():
        raise DataError(
            f"{file}: {' and '.join(one.topic for one in series)} have no time in common; "
            f"calibrate from one of them"
        )
    time = slowest.time[kept]
    notes = [f"{one.topic}: {note}" for one in series for note in one.notes]
    if left := int((~kept).sum()):
        many = "samples" if left > 1 else "sample"
        notes.append(f"{left} {many} of {slowest.topic} left out: another topic has none there")
    columns = [_clock(time)]
    for one in series:
        columns += [_renamed(one.topic, column) for column in _at(one, time)]
        if not np.array_equal(one.time, slowest.time):
            notes.append(
                f"{one.topic} ({_rate(one.time)}) interpolated linearly at the times of "
                f"{slowest.topic} ({_rate(slowest.time)})"
            )
    return Contents(columns, notes)


def _clock(time: Times) -> Column:
    """Seconds from the first sample; differences of ns are exact where absolute s are not."""
    return Column("t", "s", (time - time[0]) * 1e-9)


def _rate(time: Times) -> str:
    return f"{1e9 / float(np.median(np.diff(time))):.4g} Hz" if len(time) > 1 else "1 sample"


def _renamed(topic: str, column: Column) -> Column:
    return replace(column, name=f"{topic}.{column.name}")


def _refuse_unordered(file: Path, series: Series) -> None:
    back = np.flatnonzero(np.diff(series.time) <= 0)
    if back.size:
        raise DataError(
            f"{file}: {series.topic}: the time of message {int(back[0]) + 1} does not exceed the "
            f"one before ({back.size} such messages), so other topics cannot be matched to it; "
            f"name {series.topic} alone and give --rate HZ"
        )


def _covered(time: Times, wanted: Times) -> NDArray[np.bool_]:
    """Whether each wanted time is a sample, or lies between two that no gap separates."""
    before = np.searchsorted(time, wanted, side="right") - 1
    first = np.clip(before, 0, len(time) - 1)
    after = np.clip(first + 1, 0, len(time) - 1)
    exact = (before >= 0) & (time[first] == wanted)
    inside = (before >= 0) & (before < len(time) - 1)
    steps = np.diff(time)
    gap = _GAP * float(np.median(steps)) if steps.size else 0.0
    return np.asarray(exact | (inside & (time[after] - time[first] <= gap)))


def _at(series: Series, time: Times) -> list[Column]:
    """The columns at other times."""
    if np.array_equal(series.time, time):
        return list(series.columns)
    before = np.searchsorted(series.time, time, side="right") - 1
    after = np.minimum(before + 1, len(series.time) - 1)
    step = np.maximum(series.time[after] - series.time[before], 1)
    share = (time - series.time[before]) / step
    signs = _signs(series)
    columns = []
    for column in series.columns:
        if column.is_text or column.name in series.whole:
            columns.append(_checked(column, column.values[before]))
            continue
        values = np.asarray(column.values, dtype=np.float64) * signs.get(column.name, 1.0)
        first, last = values[before], values[after]
        if turn := _TURN.get(column.unit or ""):
            last = _short_way(values, first, last, turn)
        columns.append(_checked(column, _folded(first * (1 - share) + last * share, values, turn)))
    return _unit_length(columns, signs)


def _short_way(values: Array, first: Array, last: Array, turn: float) -> Array:
    """The second angle, whole turns away from what is written: from 359 to 1 degrees are 2."""
    if np.nanmax(values) - np.nanmin(values) > turn * 1.001:
        return last  # it counts its turns itself
    return last - turn * np.round((last - first) / turn)


def _folded(angle: Array, values: Array, turn: float | None) -> Array:
    """An angle within the turn in which the log writes it: from 0, or from minus a half."""
    if turn is None or np.nanmax(values) - np.nanmin(values) > turn * 1.001:
        return angle
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return np.where(angle > high, angle - turn, np.where(angle < low, angle + turn, angle))


def _checked(column: Column, values: Array | NDArray[np.str_]) -> Column:
    bad = None
    if values.dtype.kind == "f" and (wrong := np.flatnonzero(np.isnan(values))).size:
        bad = BadCell(int(wrong[0]), "nan", int(wrong.size))
    return replace(column, values=values, bad=bad)


def _quaternions(columns: Sequence[Column]) -> list[list[str]]:
    """Names of the columns that are one quaternion each: orientation.x … orientation.w, q[0] …"""
    names = [column.name for column in columns]
    stems = {name[:-2] for name in names if name.endswith(".w")}
    groups = [[f"{stem}.{part}" for part in "wxyz"] for stem in stems]
    groups += [[f"{s}[{i}]" for i in range(4)] for s in {re.sub(r"\[\d+\]$", "", n) for n in names}
               if s == "q" or s.endswith(".q")]  # fmt: skip
    return [group for group in groups if set(group) <= set(names)]


def _signs(series: Series) -> dict[str, Array]:
    """Signs that make quaternions continuous: q and -q are one rotation, their mean is none."""
    by_name = {column.name: column.values for column in series.columns}
    signs: dict[str, Array] = {}
    for group in _quaternions(series.columns):
        q = np.stack([by_name[name] for name in group], axis=1).astype(np.float64)
        turned = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        signs |= dict.fromkeys(group, np.concatenate([[1.0], np.cumprod(turned)]))
    return signs


def _unit_length(columns: list[Column], signs: dict[str, Array]) -> list[Column]:
    """The chord between two quaternions is shorter than 1: stretched to it again."""
    by_name = {column.name: column for column in columns}
    for group in _quaternions(columns) if signs else []:
        q = np.stack([by_name[name].values for name in group], axis=1).astype(np.float64)
        length = np.linalg.norm(q, axis=1, keepdims=True)
        q = np.divide(q, length, out=q, where=length > 0)
        for i, name in enumerate(group):
            by_name[name] = replace(by_name[name], values=q[:, i])
    return [by_name[column.name] for column in columns]
