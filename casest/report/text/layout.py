"""Layout of what a prompt prints: 80 columns, points, tables of values, colours."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import TextIO

from casest.declaration.shapes import in_digits
from casest.results.rounding import percent
from casest.results.values import Entry, Held

WIDTH = 80

#: Verdicts and their colours (SGR codes): red, magenta, yellow, cyan, green.
_COLOURS = {
    r"NOT\s+(TRUSTED|VALID)|no\s+trustworthy\s+estimate": 31,
    r"unexplained(?=:)": 35,
    r"trusted,\s+but\s+the\s+residual\s+is\s+not\s+noise": 33,
    r"extended(?=:)": 36,
    r"(trusted|valid)$|adequate(?=:)": 32,
}


def coloured(text: str, stream: TextIO) -> str:
    """The text with its verdict in colour on a terminal, where NO_COLOR does not forbid it."""
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    head, gap, rest = text.partition("\n\n")
    for verdict, code in _COLOURS.items():
        head, found = re.subn(verdict, f"\x1b[1;{code}m\\g<0>\x1b[0m", head, count=1)
        if found:
            break
    return head + gap + rest


def item(text: str) -> str:
    """A point of a list, wrapped."""
    return textwrap.fill(text, WIDTH, initial_indent="  - ", subsequent_indent="    ")


def wrapped(lines: Sequence[str]) -> list[str]:
    """Lines that fit 80 columns."""
    return [
        textwrap.fill(line, WIDTH, subsequent_indent=" " * 4, break_on_hyphens=False)
        for line in lines
    ]


def note_lines(notes: Sequence[str]) -> list[str]:
    """What was assumed, a line each."""
    return ["", *(f"  note: {note}" for note in notes)] if notes else []


def value_table(entries: Sequence[Entry]) -> Iterator[str]:
    """One line per value: name, value ± standard deviation, unit."""
    rows = [(e.name, *_value_and_std(e), e.unit) for e in entries]
    width = max(len(r[0]) for r in rows)
    left = max(len(r[1]) for r in rows)
    middle = max(len(r[2]) for r in rows)
    yield f"  {'parameter':<{width}}  {'value':>{left}}   {'std':<{middle}}  unit"
    for name, value_text, std_text, unit in rows:
        sign = " " if std_text.startswith("on its bound") else "±"
        line = f"  {name:<{width}}  {value_text:>{left}} {sign} {std_text:<{middle}}  {unit}"
        yield line.rstrip()


def _value_and_std(e: Entry) -> tuple[str, str]:
    return (f"{e.value:.6g}", e.on_bound) if e.on_bound else e.shown


def held_lines(held: Sequence[Held]) -> Iterator[str]:
    """Constants, and parameters held at a value: as much a part of the answer as the unknowns."""
    for c in held:
        unit = "" if c.unit == "1" else c.unit
        spread = "" if c.std is None else f" ± {in_digits(c.std, 2)}"
        line = f"  {c.name} = {in_digits(c.value, 9)}{spread} {unit}".rstrip() + f" ({_known(c)})"
        yield textwrap.fill(line, WIDTH, subsequent_indent="      ", break_on_hyphens=False)
    if any(c.frozen and c.std is None for c in held):
        yield "  (the uncertainty of held values is not in the standard deviations above)"


def _known(c: Held) -> str:
    """What is known of a constant's uncertainty, and how much of the values' that is."""
    if c.std is None:
        return "held"
    return f"held; up to {percent(c.share)} of a variance above: that of {c.most}"
