"""Delimited text: which delimiter, where the table starts, and its body as fast as C reads it."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from casest import units
from casest.data.column import Column, numeric_column, text_column
from casest.data.moments import looks_like_a_moment
from casest.errors import DataError

_DELIMITERS = (",", ";", "\t", "|", None)  # None: any white space
_NAMES = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", None: "white space"}
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_DECIMAL_POINT = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")
_GROUP = re.compile(r"[-+]?[1-9]\d{0,2}[.,]\d{3}")  # 1,234: a decimal, or thousands
_NO_GROUP = re.compile(r",\d{1,2}(?!\d)|,\d{4}|\d{4},\d|(?<!\d)0,\d|(?<!\d),\d")
_HEAD = 500  # lines within which a table must start
_SAMPLE = 60  # lines that decide on the delimiter


@dataclass(frozen=True)
class Layout:
    """How a text file is cut into cells."""

    delimiter: str | None
    decimal_comma: bool
    width: int

    def cells(self, line: str) -> list[str]:
        """Cut one line into stripped cells, quotes removed, decimal commas made points."""
        return [self.with_point(cell) for cell in self.cut(line)]

    def cut(self, line: str) -> list[str]:
        """Cut one line into stripped cells as they are written, quotes removed."""
        if self.delimiter is None:
            found = line.split()
        elif '"' in line:
            found = next(csv.reader([line], delimiter=self.delimiter, skipinitialspace=True))
        else:
            found = line.split(self.delimiter)
        return [cell.strip() for cell in found]

    def with_point(self, cell: str) -> str:
        """A number with a decimal comma made one with a point."""
        if self.decimal_comma and _DECIMAL_COMMA.fullmatch(cell):
            return cell.replace(",", ".")
        return cell


@dataclass(frozen=True)
class Contents:
    """What a reader found in a file, whatever its format."""

    columns: list[Column]
    notes: list[str] = field(default_factory=list)
    preamble: dict[str, str] = field(default_factory=dict)


def read_delimited(file: str, text: str) -> Contents:
    """Read delimited text; `file` is only named in errors.

    Raises DataError where the file is empty, has a header only, or has a row of another width.
    """
    try:
        return _read(file, text)
    except csv.Error as error:
        raise DataError(
            f"{file}: a quoted cell cannot be read ({error}); is a quotation mark missing?"
        ) from error


def _read(file: str, text: str) -> Contents:
    all_lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    lines = [line for line in all_lines if line and not line.isspace()]
    comments: list[str] = []
    if "#" in text or "%" in text:
        comments = [line for line in lines if line.lstrip()[0] in "#%"]
        lines = [line for line in lines if line.lstrip()[0] not in "#%"]
    if not lines:
        raise DataError(f"{file}: holds no data: the file is empty; check the export")
    layout = _layout(lines)
    start, names = _find_table(file, lines, layout, comments)
    body = lines[start:]
    if not body:
        raise DataError(f"{file}: holds a header but no rows below it; check the export")
    columns, dropped = _columns(_Body(file, body, layout, all_lines), names)
    before = lines[: start - (1 if names and not _is_comment_header(comments, names) else 0)]
    preamble, notes = _preamble(before, comments, layout)
    notes += _commas_said(body, layout)
    if dropped:
        notes.append(f"{_counted(dropped, 'column')} without name and content left out")
    return Contents(columns, notes, preamble)


def number(cell: str) -> float:
    """Read one cell; NaN where it is no number."""
    try:
        return float(cell) if "_" not in cell else math.nan
    except ValueError:
        return math.nan


def _is_number(cell: str) -> bool:
    return not math.isnan(number(cell)) or cell.lower() in ("nan", "-nan")


def _layout(lines: list[str]) -> Layout:
    """Choose the delimiter that cuts the middle of the file into rows of one width of numbers."""
    middle = min(len(lines) // 2, _HEAD)
    sample = lines[middle : middle + _SAMPLE]
    best, best_score = Layout(",", False, 1), (0.0, 0.0)
    for delimiter in _DELIMITERS:
        decimal = _has_decimal_commas(sample, delimiter)
        cut = Layout(delimiter, decimal, 0).cells
        rows = [cut(line) for line in sample]
        widths = Counter(len(row) for row in rows)
        overall = Counter(len(cut(line)) for line in lines[:_SAMPLE])  # decides between equals
        width = max(widths, key=lambda w: (widths[w], overall[w]))
        agree = widths[width]
        cells = [cell for row in rows for cell in row]
        right = sum(_rightness(cell) for cell in cells) / len(cells)
        score = right * agree / len(rows) * (1.0 if width > 1 else 0.5)
        # Tabs here and spaces there: of two that cut the middle alike, what cuts the top so too.
        whole = round(score, 9), overall[width] / overall.total()
        if score > 0 and whole > best_score:
            best, best_score = Layout(delimiter, decimal, width), whole
    return best if best_score[0] > 0 else _layout_of_labels(lines)


def _rightness(cell: str) -> int:
    """What a cell says for the delimiter that cut it; one that was not cut speaks against it."""
    if not cell or _is_number(cell) or looks_like_a_moment(cell):
        return 1
    return -1 if any(sign in cell for sign in ";\t|") else 0


def _has_decimal_commas(sample: list[str], delimiter: str | None) -> bool:
    """Whether some number has a comma; where none has a point either, one may come later."""
    cut = Layout(delimiter, False, 0).cut
    cells = [cell for line in sample for cell in cut(line)]
    if any(_DECIMAL_COMMA.fullmatch(cell) for cell in cells):
        return True
    return delimiter != "," and not any(_DECIMAL_POINT.fullmatch(cell) for cell in cells)


def _commas_said(body: list[str], layout: Layout) -> list[str]:
    """A note where each comma has three digits behind it: thousands would look the same."""
    if not layout.decimal_comma or layout.delimiter == ",":
        return []
    text = "\n".join(body)
    first = next((c for c in layout.cut(body[0]) if _GROUP.fullmatch(c) and "," in c), None)
    if first is None or "." in text or _NO_GROUP.search(text):
        return []
    return [
        f"commas are read as decimal points, {first} as {first.replace(',', '.')}; if they "
        f"separate thousands, export the file without them"
    ]


def _layout_of_labels(lines: list[str]) -> Layout:
    """Nothing is a number (a header alone, labels only): the most cells win."""
    widths = [(len(Layout(d, False, 0).cells(lines[-1])), d) for d in _DELIMITERS]
    width, delimiter = max(widths, key=lambda found: found[0])
    return Layout(delimiter, False, width)


def _find_table(
    file: str, lines: list[str], layout: Layout, comments: list[str]
) -> tuple[int, list[str] | None]:
    """Return the index of the first data line, and the header's cells or None."""
    head = [layout.cells(line) for line in lines[:_HEAD]]
    numbers = _numeric_positions(lines, layout)
    first = next((i for i, row in enumerate(head) if _is_data(row, layout, numbers)), len(head))
    for at, row in enumerate(head[: first + 1]):
        if not _is_header(row, layout) or (at + 1 < len(head) and at + 1 < first):
            continue
        _refuse_too_few_names(file, row, lines[first:], layout)
        if at > 0 and _is_units_row(row) and _is_header(head[at - 1], layout):
            return at + 1, _with_units(head[at - 1], row)
        return at + 1, row
    if first == len(head):
        raise DataError(f"{file}: no table of numbers found in its first {len(head)} lines")
    if first > 0 and layout.width > 2 and len(head[first - 1]) > layout.width:
        _refuse_header(file, head[first - 1], layout)
    positions = [str(i) for i in range(layout.width)]
    if head[first] == positions and layout.width > 1 and first + 1 < len(head):
        return first + 1, head[first]  # pandas writes positions as names
    return first, _commented_header(comments, layout)


def _numeric_positions(lines: list[str], layout: Layout) -> list[int]:
    """Return the positions that hold numbers in the middle of the file."""
    middle = min(len(lines) // 2, _HEAD)
    rows = [layout.cells(line) for line in lines[middle : middle + _SAMPLE]]
    rows = [row for row in rows if len(row) == layout.width]
    return [
        i
        for i in range(layout.width)
        if rows and 2 * sum(not row[i] or _is_number(row[i]) for row in rows) > len(rows)
    ]


def _is_data(row: list[str], layout: Layout, numbers: list[int]) -> bool:
    """Whether most of the cells that should be numbers are; `Fs,100` is not a row of two."""
    if len(row) != layout.width or not numbers:
        return False
    right = sum(not row[i] or _is_number(row[i]) for i in numbers)
    return any(_is_number(row[i]) for i in numbers) and (
        right == len(numbers) or (len(numbers) > 2 and 2 * right >= len(numbers))
    )


def _is_header(row: list[str], layout: Layout) -> bool:
    cells = row[:-1] if len(row) == layout.width + 1 and not row[-1] else row
    right_width = len(cells) in (layout.width, layout.width - 1 if layout.width > 1 else 1)
    filled = [cell for cell in cells if cell]
    return right_width and bool(filled) and not any(_is_number(cell) for cell in filled)


def _is_units_row(row: list[str]) -> bool:
    words = [cell.strip("[]() ") for cell in row if cell.strip("[]() ")]
    return bool(words) and all(units.familiar(word) for word in words)


def _with_units(names: list[str], row: list[str]) -> list[str]:
    marks = [cell.strip("[]() ") for cell in row] + [""] * len(names)
    return [f"{n} [{u}]" if u else n for n, u in zip(names, marks, strict=False)]


def _refuse_too_few_names(file: str, row: list[str], below: list[str], layout: Layout) -> None:
    """One name less than cells is right only where each line ends with a delimiter."""
    ends = [layout.cells(line)[-1] for line in below[:_SAMPLE]]
    if len(row) == layout.width - 1 and any(ends):
        _refuse_header(file, row, layout)


def _refuse_header(file: str, row: list[str], layout: Layout) -> None:
    if row[-1] and not any(_is_number(cell) for cell in row):
        raise DataError(
            f"{file}: the header names {len(row)} columns and the rows have {layout.width} cells "
            f"({_NAMES[layout.delimiter]} between them); give every column one name"
        )


def _commented_header(comments: list[str], layout: Layout) -> list[str] | None:
    """numpy.savetxt writes its header as a comment; the last such line names the columns."""
    if not comments:
        return None
    row = layout.cells(comments[-1].lstrip("#% \t"))
    return row if len(row) == layout.width > 1 and _is_header(row, layout) else None


def _is_comment_header(comments: list[str], names: list[str]) -> bool:
    return bool(comments) and all(name in comments[-1] for name in names)


def _preamble(
    before: list[str], comments: list[str], layout: Layout
) -> tuple[dict[str, str], list[str]]:
    """Keep `key, value` lines above the table (and in comments), and say what was skipped."""
    pairs: dict[str, str] = {}
    for line in [*before, *(comment.lstrip("#% \t") for comment in comments)]:
        found = [cell for cell in layout.cells(line) if cell]
        if len(found) != 2 or layout.delimiter is None:
            found = [part.strip() for part in re.split(r"[:=,;\t]", line, maxsplit=1)]
        if len(found) == 2 and found[0] and found[1]:
            pairs.setdefault(found[0].lstrip("/ "), found[1])
    notes = []
    if before:
        shown = " / ".join(line.strip() for line in before[:5]) + (" / …" if before[5:] else "")
        notes.append(f"{_counted(len(before), 'line')} before the table skipped: {shown[:200]}")
    if comments:
        notes.append(f"{_counted(len(comments), 'comment line')} skipped")
    return pairs, notes


def _counted(n: int, thing: str) -> str:
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


@dataclass(frozen=True)
class _Body:
    """The data lines of a file, and all its lines to count from when one is wrong."""

    file: str
    lines: list[str]
    layout: Layout
    all_lines: list[str]

    def line_number(self, row: int) -> int:
        """Return the number of the line (from 1) that data row `row` stands on."""
        left = len(self.lines) - row  # counted from the end: above the table anything may stand
        for at in range(len(self.all_lines), 0, -1):
            line = self.all_lines[at - 1].strip()
            left -= bool(line) and line[0] not in "#%"
            if left == 0:
                return at
        return 0


def _columns(body: _Body, names: list[str] | None) -> tuple[list[Column], int]:
    """Read all columns; return them and how many nameless empty ones were left out."""
    fast = _fast(body)
    if fast is not None:
        headers = _headers(names, fast.shape[1])
        cells = (_texts_if_needed(body, fast[:, i], i) for i in range(fast.shape[1]))
        return [
            numeric_column(h, fast[:, i], c)
            for i, (h, c) in enumerate(zip(headers, cells, strict=True))
        ], 0
    rows = _slow(body)
    headers = _headers(names, body.layout.width)
    decimals = body.layout.decimal_comma
    points = decimals and any(_plain_point(cell) for row in rows for cell in row)
    texts = [list(column) for column in zip(*rows, strict=True)]
    kept = [i for i, t in enumerate(texts) if any(t) or (names and i < len(names) and names[i])]
    typed = [_typed(headers[i], texts[i], body.layout, points) for i in kept]
    return typed, len(texts) - len(kept)


def _plain_point(cell: str) -> bool:
    """Whether a cell is a number whose point separates no thousands."""
    return bool(_DECIMAL_POINT.fullmatch(cell)) and not _GROUP.fullmatch(cell)


def _headers(names: list[str] | None, width: int) -> list[str]:
    """Return one header per column; the position from 0 where there is none."""
    given = list(names or [])[:width]
    given += [""] * (width - len(given))
    return [name or str(i) for i, name in enumerate(given)]


def _fast(body: _Body) -> NDArray[np.float64] | None:
    """Read the whole body with NumPy's C reader; None where a cell or row resists."""
    lines, layout = body.lines, body.layout
    if layout.decimal_comma:
        if layout.delimiter == "," or any("." in line for line in lines):
            return None  # what comma and point mean is looked at cell by cell
        lines = "\n".join(lines).replace(",", ".").split("\n")
    try:
        values = np.loadtxt(lines, delimiter=layout.delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return values if values.shape == (len(lines), layout.width) else None


def _texts_if_needed(body: _Body, values: NDArray[np.float64], at: int) -> list[str] | None:
    if np.isfinite(values).all():
        return None
    return [body.layout.cells(line)[at] for line in body.lines]


def _slow(body: _Body) -> list[list[str]]:
    rows = [body.layout.cut(line) for line in body.lines]
    width = body.layout.width
    for row, cells in enumerate(rows):
        if len(cells) == width + 1 and not cells[-1]:
            del cells[-1]  # a delimiter at the end of some lines only
        if len(cells) != width:
            last = "; the last line looks cut off: delete it" if row == len(rows) - 1 else ""
            raise DataError(
                f"{body.file}: row {row} (line {body.line_number(row)}) has {len(cells)} cells "
                f"where the table has {width}: '{body.lines[row].strip()[:60]}'"
                f"{last or '; repair or delete that line'}"
            )
    return rows


def _typed(header: str, cells: list[str], layout: Layout, points: bool) -> Column:
    """Numbers where at least half of the filled cells are numbers, else labels.

    `points`: the file has numbers with a decimal point, so that its commas may be something else.
    A number that may be two (1.234 beside 0,5) is none: it is left to those who use the column.
    """
    values = np.array([number(layout.with_point(cell)) for cell in cells])
    right = np.count_nonzero(~np.isnan(values)) + sum(_is_nan_word(cell) for cell in cells)
    if 2 * right < sum(bool(cell) for cell in cells):
        return text_column(header, cells)
    if layout.decimal_comma:
        values[_open_to_doubt(cells, points or layout.delimiter == ",")] = np.nan
    return numeric_column(header, values, cells)


def _open_to_doubt(cells: list[str], points: bool) -> list[int]:
    """Rows of 1.234 or 1,234 where nothing in the column says what the sign means."""
    doubtful: list[int] = []
    for sign, form in ((".", _DECIMAL_POINT), (",", _DECIMAL_COMMA)):
        written = [k for k, cell in enumerate(cells) if sign in cell and form.fullmatch(cell)]
        if (sign == "." or points) and all(_GROUP.fullmatch(cells[k]) for k in written):
            doubtful += written
    return doubtful


def _is_nan_word(cell: str) -> bool:
    return cell.lower() in ("nan", "-nan", "na", "n/a", "null", "none")
