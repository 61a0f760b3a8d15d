"""What the user says about files that do not say it themselves."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from casest import units as unit_names
from casest.data.finding import Choice, as_names
from casest.data.logs import file_and_topics
from casest.data.matching import find_by_name
from casest.data.scaling import Scale
from casest.data.table import Table
from casest.declaration.symbols import Signal
from casest.errors import UnitError, UsageError

#: What is no signal, and has no unit.
_LABELS = ("run", "pose")


@dataclass(frozen=True)
class Options:
    """Checked options of `load_runs`, by signal or column name."""

    columns: Choice
    units: Mapping[str, str]
    scales: Mapping[str, Scale]
    rate: float | None
    time_zero: Literal["first", "column"]
    extra: tuple[str, ...]
    #: Signals of which readings may be missing (empty cells).
    gaps: frozenset[str] = frozenset()
    #: Inputs that are interpolated, or held, where they have no sample; None of a sensor model.
    between: frozenset[str] | None = None
    #: Signals that may be the same in all rows: settings of an experiment, the noise of a reading.
    steady: frozenset[str] = frozenset()


def stated_units(columns: Choice | None, units: Mapping[str, str] | None) -> dict[str, str]:
    """The canonical units that a user states, also behind a signal's columns."""
    stated = {**_units_beside(columns or {}), **(units or {})}
    return {name: _stated_unit(name, unit) for name, unit in stated.items()}


def _units_beside(columns: Choice) -> dict[str, str]:
    """The unit that stands behind a signal's last column: {"v": "ax,ay,az [g]"} is {"v": "g"}."""
    last = {name: as_names(choice)[-1] for name, choice in columns.items() if as_names(choice)}
    found = {name: re.search(r"\s\[([^\[\]]+)\]$", text) for name, text in last.items()}
    return {name: unit[1] for name, unit in found.items() if unit and name not in _LABELS}


def _stated_unit(name: str, unit: str) -> str:
    """Return the canonical name of a unit the user states; a UnitError names the option."""
    try:
        return unit_names.canonical(unit)
    except UnitError as error:
        raise UnitError(f"--unit {name}={unit}: {error}") from error


def refuse_unknown_names(
    tables: Sequence[Table], signals: Sequence[Signal], options: Options
) -> None:
    """Refuse an option for a signal or column that exists nowhere: a typing error."""
    names = [s.name for s in signals]
    headers = [name for table in tables for name in table.columns]
    apart = [
        f"{file_and_topics(table.file)[0].stem}.{name}"
        for table in tables
        for name in (*names, "t", *table.columns)
        if len(tables) > 1
    ]
    for option, given, allowed in (
        ("columns", options.columns, [*names, "t", "run", "pose"]),
        ("unit", options.units, [*names, "t", *headers, *apart]),
        ("scale", options.scales, [*names, "t", *headers, *apart]),
    ):
        for name in given:
            # Two files of one name are told apart: gps#2.t.
            if name in allowed or re.sub(r"#\d+(?=\.)", "", name) in allowed:
                continue
            if option != "columns" and any(find_by_name(table, name) for table in tables):
                continue
            near = difflib.get_close_matches(name, allowed, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(allowed[:12])}"
            raise UsageError(f"--{option} {name}=…: no signal or column {name}; {hint}")
