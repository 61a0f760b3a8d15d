"""Which columns of a table make up a signal."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace

from casest import units
from casest.data.matching import (
    beginning_with,
    find_by_name,
    listed,
    plain,
    vectors_beginning_with,
)
from casest.data.table import Table
from casest.data.timing import find_time, increasing
from casest.declaration.symbols import Signal
from casest.errors import DataError, UnitError

Choice = Mapping[str, Sequence[str] | str]

_ANGLES = ("roll", "pitch", "yaw")
_QUATERNIONS = tuple(
    tuple(f"{stem}{part}" for part in "wxyz") for stem in ("q", "quat", "quaternion", "orientation")
)


def find_columns(table: Table, signal: Signal, chosen: Choice) -> tuple[str, ...]:
    """Return the names of the columns that hold `signal`, in order.

    `chosen` names them (or gives positions from 0) where the file's own names do not tell:
    {"v": ("ax", "ay", "az")}, {"v": "0,1,2"}, or what they have in common, {"v": "a"}. Raises
    DataError that lists what the file has.
    """
    if signal.name in chosen:
        names = as_names(chosen[signal.name])
        if len(names) == 1 and (found := _by_choice(table, signal, names[0])):
            return found
        _check_number(table, signal, names)
        return tuple(find_column(table, name, f"signal {signal.name}") for name in names)
    if found := _by_stem(table, signal, signal.name):
        return found
    raise _missing(table, signal)


def _by_choice(table: Table, signal: Signal, stem: str) -> tuple[str, ...] | None:
    """Return the columns that a user means by one name, where there is one way to read it."""
    if found := _by_stem(table, signal, stem):
        return found
    if signal.size == 1 or signal.kind == "rotation":
        return None
    ways = vectors_beginning_with(table, stem, signal.size)
    if len(ways) > 1:
        said = " or ".join(",".join(way) for way in ways[:6])
        first = shlex.quote(f"{signal.name}={','.join(ways[0])}")
        raise DataError(
            f"{table.file}: {stem} for signal {signal.name} can be read in {len(ways)} ways, "
            f"{said}; name the columns: --columns {first}"
        )
    return ways[0] if ways else None


def _by_stem(table: Table, signal: Signal, stem: str) -> tuple[str, ...] | None:
    """Return the columns of a signal whose names begin with `stem`: ax ay az, gyro[0] … gyro[2]."""
    for candidate in _candidates(replace(signal, name=stem)):
        found = [find_by_name(table, name) for name in candidate]
        if all(found):
            return tuple(name for name in found if name)
    return None


def as_names(choice: Sequence[str] | str) -> tuple[str, ...]:
    """Split "ax,ay,az" where it has not been split."""
    names = choice.split(",") if isinstance(choice, str) else choice
    return tuple(str(name).strip() for name in names)


def find_column(table: Table, name: str, purpose: str) -> str:
    """Return the column called `name` (upper or lower case, or a position from 0)."""
    found = find_by_name(table, name)
    if found:
        return found
    names = list(table.columns)
    if re.fullmatch(r"\d+", name):
        if int(name) < len(names):
            return names[int(name)]
        raise DataError(
            f"{table.file}: {purpose} asks for column {name}, and the columns are 0 to "
            f"{len(names) - 1} ({listed(names)})"
        )
    ways = beginning_with(table, name)
    if len(ways) == 1:
        return ways[0]
    if ways:
        said = " or ".join(ways[:6])
        raise DataError(
            f"{table.file}: {name} for {purpose} can be read in {len(ways)} ways, {said}; "
            f"name the column in full"
        )
    near = _nearest(name, names)
    hint = f"did you mean {near}? " if near else ""
    raise DataError(f"{table.file}: no column {name} for {purpose}; {hint}it has {listed(names)}")


def _candidates(signal: Signal) -> Sequence[Sequence[str]]:
    name, size = signal.name, signal.size
    if signal.kind == "rotation":
        own = [[f"{name}{part}" for part in _ANGLES], [f"{name}{part}" for part in "wxyz"]]
        nine = [f"{name}{i}" for i in range(9)]
        return [*own, _ANGLES, *_QUATERNIONS, nine]
    if size == 1:
        return [(name,), (f"{name}0",)]
    counted = [[f"{name}{i + first}" for i in range(size)] for first in (0, 1)]
    return ([[f"{name}{axis}" for axis in "xyz"]] if size == 3 else []) + counted


def _check_number(table: Table, signal: Signal, names: Sequence[str]) -> None:
    if signal.kind == "rotation":
        right, wanted = len(names) in (3, 4, 9), "3 (roll, pitch, yaw), 4 (qw, qx, qy, qz) or 9"
    else:
        right, wanted = len(names) == signal.size, str(signal.size)
    if not right:
        raise DataError(
            f"{table.file}: signal {signal.name} needs {wanted} columns and "
            f"--columns {signal.name}={','.join(names)} gives {len(names)}"
        )
    for name in names:
        if names.count(name) > 1:
            raise DataError(
                f"{table.file}: --columns {signal.name}={','.join(names)} names {name} twice"
            )


def _missing(table: Table, signal: Signal) -> DataError:
    names = list(table.columns)
    wanted = " ".join(_candidates(signal)[0])
    if signal.kind == "rotation":
        wanted = "roll pitch yaw or qw qx qy qz"
    near = near_group(table, signal)
    some = _as_typed(table, signal, near)
    others = [g for g in _groups_of(table, signal) if g != near]
    instead = "".join(f" or --columns {shlex.quote(f'{signal.name}={o}')}"
                      for o in map(",".join, others[:3]))  # fmt: skip
    return DataError(
        f"{table.file}: no columns {wanted} for signal {signal.name}; "
        f"the file has {listed(names)}; try --columns {some}{instead}"
    )


def also_missing(table: Table, signals: Sequence[Signal], chosen: Choice, said: str) -> str:
    """Further `--columns` to try, of the other signals that nothing in the file is called after."""
    tries = []
    for signal in signals:
        if signal.name in chosen or _by_stem(table, signal, signal.name):
            continue
        near = near_group(table, signal)
        taken = f"={','.join(near)}" in said
        tries.append(f" --columns {_as_typed(table, signal, [] if taken else near)}")
    return "".join(tries)


def _as_typed(table: Table, signal: Signal, near: Sequence[str]) -> str:
    """What to type behind --columns, and behind it the unit that the columns' names end in."""
    if not near:
        return f"{signal.name}={','.join('…' * min(signal.size, 3))}"
    unit = unit_in_names(table, near, signal)
    said = f" --unit {shlex.quote(f'{signal.name}={unit}')}" if unit else ""
    return shlex.quote(f"{signal.name}={','.join(near)}") + said


def unit_in_names(table: Table, names: Sequence[str], signal: Signal) -> str | None:
    """Return the unit that is the last word of all names, where no header states one: roll_deg."""
    wanted = "rad" if signal.kind == "rotation" else signal.unit
    ends = {name.rpartition("_")[2] if "_" in name else "" for name in names}
    end = ends.pop()
    if ends or not wanted or any(table.columns[name].unit for name in names):
        return None
    return end if units.familiar(end) and _converts(end, wanted) else None


def _groups_of(table: Table, signal: Signal) -> list[list[str]]:
    """Groups of columns that a vector could be: those in its unit, where some are."""
    if signal.size == 1 or signal.kind == "rotation":
        return []
    clock = find_time(table)
    numbers = [n for n, column in table.columns.items() if not column.is_text and n not in clock]
    groups = [g for g in map(list, _stems(numbers)) if len(g) == signal.size]
    return [g for g in groups if signal.unit and _in_unit(table, g, signal.unit)] or groups


def near_group(table: Table, signal: Signal) -> list[str]:
    """Return columns that could hold the signal: x y z of one stem, else the first numbers."""
    clock = find_time(table)
    numbers = [n for n, column in table.columns.items() if not column.is_text and n not in clock]
    if signal.kind == "rotation":
        angles = [_nearest(angle, numbers) for angle in _ANGLES]
        return [a for a in angles if a] if all(angles) and len(set(angles)) == 3 else []
    if signal.size == 1:
        fitting = [n for n in numbers if signal.unit and _in_unit(table, [n], signal.unit)]
        if len(fitting) == 1:
            return fitting
        near = _nearest_name(signal.name, fitting or numbers)
        return [near] if near else []
    if alike := _groups_of(table, signal):
        wanted = "".join(_candidates(signal)[0])
        return max(alike, key=lambda g: difflib.SequenceMatcher(None, wanted, "".join(g)).ratio())
    # What always grows is a time or a counter, unless all columns do.
    numbers = [name for name in numbers if not increasing(table, name)] or numbers
    return numbers[: signal.size] if len(numbers) >= signal.size else []


def _in_unit(table: Table, names: Sequence[str], unit: str) -> bool:
    """Whether all these columns state a unit that converts to `unit`."""
    return all(_converts(table.columns[n].unit or "", unit) for n in names)


def _converts(have: str, wanted: str) -> bool:
    try:
        return bool(units.conversion(have, wanted))
    except UnitError:
        return False


def _stems(names: list[str]) -> list[list[str]]:
    """Group names that differ in their last letter x y z (or digit) only."""
    groups: dict[str, list[str]] = {}
    for name in names:
        word = plain(name)
        if len(word) > 1 and word[-1] in "xyz0123":
            groups.setdefault(word[:-1], []).append(name)
    return list(groups.values())


def _nearest_name(name: str, names: list[str]) -> str | None:
    """Return what abbreviates a name (temp) or is spelled much like it: ADC is no load."""
    short = [have for have in names if len(plain(have)) > 2 and plain(name).startswith(plain(have))]
    return short[0] if short else _nearest(name, names, cutoff=0.6)


def _nearest(name: str, names: list[str], cutoff: float = 0.5) -> str | None:
    by_plain = {plain(have): have for have in names}
    near = difflib.get_close_matches(plain(name), list(by_plain), n=1, cutoff=cutoff)
    return by_plain[near[0]] if near else None
