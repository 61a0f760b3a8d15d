"""Which files a command writes, and whether it reads one of them: that would be lost."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

_FITTED = ("result.json", "residuals.csv", "report.html")
#: Names in the folder of -o.
_NAMES = {
    "calibrate": _FITTED,
    "close": (*_FITTED, "formula.py"),
    "check": ("check.json", "report.html"),
    "observe": ("observe.json", "report.html"),
    "filter": ("filter.json", "states.csv", "report.html"),
    "compare": ("compare.json", "compare.png", "compare.svg"),
    "plan": ("plan.json", "plan.csv", "plan.html"),
    "simulate": ("record.csv", "truth.json", "truth.csv"),
}
#: Where a command writes that is not told.
_UNTOLD = {"simulate": "simulated"}


def overwritten(command: str, output: str | Path | None, words: Sequence[str]) -> str:
    """The word that names a file which the command would write over; empty if there is none.

    `words` are its arguments and the values of its options but -o. What a result was made from
    counts as read with it.
    """
    output = output or _UNTOLD.get(command)
    if output is None:
        return ""
    lost = {_entry(path) for path in _targets(command, Path(output))}
    for k, word in enumerate(words):
        for path in _read(word, result=k == 0 and command in ("apply", "check", "export", "plan")):
            # A link in the place of the output is replaced itself, not what it leads to.
            if lost & {_entry(path), os.path.realpath(path)}:
                return word
    return ""


def apart(command: str, output: str | Path, words: Sequence[str]) -> Path:
    """The output, with a number where the command would write over what it reads."""
    first = found = Path(output)
    number = 2
    while overwritten(command, found, words):
        found = first.with_name(f"{first.stem}-{number}{first.suffix}")
        number += 1
    return found


def corrected_file(output: Path) -> Path:
    """Where `apply` writes: a .csv file, or corrected.csv in a folder."""
    return output if output.suffix == ".csv" else output / "corrected.csv"


def _targets(command: str, output: Path) -> list[Path]:
    if command == "apply":
        return [corrected_file(output)]
    return [output / name for name in _NAMES[command]] if command in _NAMES else [output]


def _read(word: str, *, result: bool) -> Iterator[Path]:
    """Files that a word may name: itself, `file.py:name`, `flight.bag:/imu`, `name=@result`."""
    _, held, named = word.rpartition("@")
    for text in (word, word.partition(":")[0], named):
        yield Path(text)
    if result or held:  # a folder stands for the result in it
        yield Path(named) / "result.json"
    if result:
        yield from _made_from(Path(word))


def _made_from(result: Path) -> Iterator[Path]:
    """Data, model and effects that a saved result was made from, as far as it can be read."""
    try:
        text = (result / "result.json" if result.is_dir() else result).read_text(encoding="utf-8")
        content = json.loads(text)
        declared, effects = content.get("declared_in") or {}, content.get("effects") or []
        names = [*content.get("data", []), declared.get("file"), *(e.get("file") for e in effects)]
    except (OSError, ValueError, TypeError, AttributeError):
        return  # whoever reads it says what is wrong
    yield from (Path(name) for name in names if isinstance(name, str))


def _entry(path: Path) -> str:
    """A place in a folder, whatever lies there."""
    return os.path.join(os.path.realpath(path.parent), path.name)
