"""One column of a table, and how its header says name and unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest import units

Values = NDArray[np.float64] | NDArray[np.str_]


#: What a cell holds where a reading is missing.
_BLANK = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})


_GROUPS = re.compile(r"[-+]?[1-9]\d{0,2}([.,' ]\d{3})+([.,]\d+)?")
_THOUSANDS = ", where thousands and decimals cannot be told apart: export without separators"


def _grouped(text: str) -> bool:
    """Whether a cell looks like 1.234,5 or 1'234: digits in groups of three."""
    return bool(_GROUPS.fullmatch(text))


@dataclass(frozen=True)
class BadCell:
    """The first cell of a column that is no finite number: its data row, its text, how many."""

    row: int
    text: str
    count: int
    #: No cell holds anything but nothing (or `nan`): readings that are missing.
    blank: bool = False

    def __str__(self) -> str:
        """Say what is wrong, as it goes into an error or a note."""
        what = f"holds '{self.text}'" if self.text else "is empty"
        more = f" (and {self.count - 1} more such rows)" if self.count > 1 else ""
        return f"row {self.row} {what}{more}{_THOUSANDS if _grouped(self.text) else ''}"


@dataclass(frozen=True)
class Column:
    """One column: numbers as float64 (n_rows,), or labels as strings (n_rows,).

    A cell that is no finite number is NaN in `values` and recorded in `bad`: it matters only to
    those who use the column. `unit` is as the file spells it, None where the file is silent.
    """

    name: str
    unit: str | None
    values: Values
    bad: BadCell | None = None

    @property
    def is_text(self) -> bool:
        """Whether the column holds labels."""
        return self.values.dtype.kind == "U"


def numeric_column(header: str, values: NDArray[np.float64], texts: list[str] | None) -> Column:
    """Make a column of numbers; `texts` are the cells as written, where they are still known."""
    name, unit = name_and_unit(header)
    wrong = np.flatnonzero(~np.isfinite(values))
    bad = None
    if wrong.size:
        row = int(wrong[0])
        text = texts[row] if texts is not None else str(values[row])
        if texts is None:
            blank = bool(np.isnan(values[wrong]).all())
        else:
            blank = all(texts[k].strip().lower() in _BLANK for k in wrong)
        bad = BadCell(row, text.strip(), int(wrong.size), blank)
        values = np.where(np.isfinite(values), values, np.nan)
    return Column(name, unit, np.ascontiguousarray(values, dtype=np.float64), bad)


def text_column(header: str, cells: list[str]) -> Column:
    """Make a column of labels."""
    name, unit = name_and_unit(header)
    return Column(name, unit, np.array([cell.strip() for cell in cells], dtype=np.str_))


def name_and_unit(header: str) -> tuple[str, str | None]:
    """Split `vx [m/s^2]`, `time (ms)` or `gyrox rad/s` into name and unit.

    Square brackets hold a unit unless they hold an index (`v[0]`, `v[x]`); round brackets and a
    last word hold one only where it is a familiar unit (`value (left)` is a name).
    """
    text = header.strip()
    if found := re.fullmatch(r"(.+?)\s*\[([^\[\]]*)\]", text):
        name, inside = found[1], found[2].strip()
        if not re.fullmatch(r"\d*|[xyzXYZ]", inside):
            return name.strip(), inside
    if (found := re.fullmatch(r"(.+?)\s*\((.*)\)", text)) and units.familiar(found[2]):
        return found[1].strip(), found[2].strip()
    name, _, word = text.rpartition(" ")
    if name.strip() and _is_unit_word(word):
        return name.strip(), word
    return text, None


def _is_unit_word(word: str) -> bool:
    """Whether a header's last word is a unit: "temp 1", "phase A" and "channel C" name things."""
    if len(word) == 1 and word not in "gsmTG":
        return False
    return word not in ("-", "as", "turn", "code", "none") and units.familiar(word)
