"""One column of a table, and how its header says name and unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest import units

Values = NDArray[np.float64] | NDArray[np.str_]


#: What a cell holds where a reading is missing.
BLANK = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})


_NO_UNITS = ("-", "as", "turn", "code", "none")  # words that name things more often than units
#: Characters of a name or label that are kept: an array of labels is as wide as its longest.
LONGEST = 200
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
            blank = all(texts[k].strip().lower() in BLANK for k in wrong)
        bad = BadCell(row, _cut(text, 60), int(wrong.size), blank)
        values = np.where(np.isfinite(values), values, np.nan)
    return Column(name, unit, np.ascontiguousarray(values, dtype=np.float64), bad)


def text_column(header: str, cells: list[str]) -> Column:
    """Make a column of labels."""
    name, unit = name_and_unit(header)
    return Column(name, unit, np.array([_cut(cell, LONGEST) for cell in cells], dtype=np.str_))


def _cut(text: str, longest: int) -> str:
    """Text on one line, with what is too long cut off."""
    line = " ".join(text.split())
    return line if len(line) <= longest else line[: longest - 1] + "…"


def name_and_unit(header: str) -> tuple[str, str | None]:
    """Split `vx [m/s^2]`, `time (ms)`, `Kraft in N`, `F/kN` or `gyrox rad/s` into name and unit.

    Square brackets hold a unit unless they hold an index (`v[0]`, `v[x]`; `n [1]` has the unit 1);
    round brackets and a last word hold one only where it is a familiar unit (`value (left)` is a
    name).
    """
    text = _cut(header, LONGEST)
    if found := re.fullmatch(r"(.+?)(\s*)\[([^\[\]]*)\]", text):
        name, inside = found[1], found[3].strip()
        if (found[2] and inside == "1") or not re.fullmatch(r"\d*|[xyzXYZ]", inside):
            return _bare(name), inside
    if (found := re.fullmatch(r"(.+?)\s*\((.*)\)", text)) and units.familiar(found[2]):
        return _bare(found[1]), found[2].strip()
    name, _, word = text.rpartition(" ")
    if name.strip() and (_is_unit_word(word) or (name.endswith(" in") and units.familiar(word))):
        return _bare(name), word
    found = re.fullmatch(r"([^/]*[^/\s])\s*/\s*([^/]+)", text)
    if found and _is_divisor(text, found[2]):
        return found[1].strip(), found[2]
    return text, None


def _bare(name: str) -> str:
    """The name without what leads to its unit: "Kraft in", "Kraft /"."""
    return re.sub(r"(\s+in|\s*/)$", "", name.strip()) or name.strip()


def _is_divisor(whole: str, word: str) -> bool:
    """Whether Kraft/N is a quantity over its unit (DIN 1313), not a unit itself, as m/s is.

    T/K and T/°C are temperatures: nobody measures tesla per kelvin.
    """
    named = any(sign.isalpha() for sign in word) and word not in _NO_UNITS
    if not named or not units.familiar(word):
        return False
    return not units.familiar(whole) or units.canonical(word) in ("K", "degC", "degF")


def _is_unit_word(word: str) -> bool:
    """Whether a header's last word is a unit: "temp 1", "phase A" and "channel C" name things."""
    if len(word) == 1 and word not in "gsmTG":
        return False
    return word not in _NO_UNITS and units.familiar(word)
