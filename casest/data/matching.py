"""How a name that a user or a model gives is found among a table's columns."""

from __future__ import annotations

import re
from collections.abc import Sequence

from casest import units
from casest.data.column import name_and_unit
from casest.data.table import Table
from casest.errors import DataError, UnitError

_WORD = re.compile(r"[A-ZÄÖÜ]?[a-zäöüß]+|[A-ZÄÖÜ]+(?![a-zäöüß])|\d+")
_AXES = ("xyz", "012", "123")


def find_by_name(table: Table, name: str) -> str | None:
    """Return the column called so: exactly, else without regard to case and punctuation.

    Raises DataError where it is named with another unit than its header has.
    """
    if name in table.columns:
        return name
    bare, unit = name_and_unit(name)  # as the header is written, unit and all
    if bare in table.columns:
        own = table.columns[bare].unit
        if own and unit and not _one_unit(own, unit):
            raise DataError(
                f"{table.file}: {name}: the header of {bare} says {own}; if that is wrong name the "
                f"column alone, and its unit beside: --unit SIGNAL={unit}"
            )
        return bare
    return next((have for have in table.columns if plain(have) == plain(name)), None)


def _one_unit(one: str, other: str) -> bool:
    try:
        return one == other or units.conversion(other, one) == (1.0, 0.0)  # K is not degC
    except UnitError:
        return False


def plain(name: str) -> str:
    """v_x, v.x, V[x] and "v x" are one name."""
    return re.sub(r"[\s_.\[\]()\-]", "", name).casefold() or name


def beginning_with(table: Table, stem: str) -> list[str]:
    """Columns whose first words are those of `stem`: Kraft finds "Kraft gemessen", not Kraftwerk.

    Nothing begins with a position.
    """
    wanted = _words(stem)
    if not any(word[0].isalpha() for word in wanted):
        return []
    return [name for name in table.columns if _words(name)[: len(wanted)] == wanted]


def vectors_beginning_with(table: Table, stem: str, size: int) -> list[tuple[str, ...]]:
    """Groups of `size` columns that begin with `stem` and differ in their axis only.

    acc finds acc_x_raw acc_y_raw acc_z_raw, and "acc raw 1" to 3 where no group has x, y and z.
    """
    by_plain = {plain(name): name for name in table.columns if not table.columns[name].is_text}
    start = plain(stem)
    if not start[:1].isalpha():
        return []
    for axes in _AXES if size == 3 else ["".join(map(str, range(k, k + size))) for k in (0, 1)]:
        if found := _groups(by_plain, start, axes):
            return found
    return []


def triads(names: Sequence[str]) -> list[tuple[str, ...]]:
    """Groups of three columns that differ in their axis only: x y z, else 0 1 2 or 1 2 3."""
    by_plain = {plain(name): name for name in names}
    for axes in _AXES:
        if found := list(dict.fromkeys(_groups(by_plain, "", axes))):
            return found
    return []


def vectors(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The same of all axes at once; of four that are counted (motors, cells) none."""
    by_plain = {plain(name): name for name in names}
    four = {n for axes in ("0123", "1234") for group in _groups(by_plain, "", axes) for n in group}
    groups = dict.fromkeys(g for axes in _AXES for g in _groups(by_plain, "", axes))
    return [group for group in groups if not four.intersection(group)]


def _groups(by_plain: dict[str, str], start: str, axes: str) -> list[tuple[str, ...]]:
    found = []
    for name in by_plain:
        places = range(len(start), len(name)) if name.startswith(start) else ()
        for at in places:
            alike = [name[:at] + axis + name[at + 1 :] for axis in axes]
            if name[at] == axes[0] and all(one in by_plain for one in alike):
                found.append(tuple(by_plain[one] for one in alike))
    return found


def listed(names: Sequence[str]) -> str:
    """The columns of a file, as an error names them."""
    return ", ".join(names[:12]) + (f", … ({len(names)} in all)" if len(names) > 12 else "")


def _words(name: str) -> list[str]:
    return [word.casefold() for word in _WORD.findall(name)]
