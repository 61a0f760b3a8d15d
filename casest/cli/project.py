"""`--project FILE`: what a TOML file says of a bench, as the words that one would have typed.

The words come before those that were typed, so that these override: of an option that is given
twice the last counts; a `name=value` is left out where that name is given another one.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import click

from casest.errors import UsageError

FLAG = "--project"
#: Entries that are arguments, not options.
ARGUMENTS = ("model", "data")
#: Entries with another name than their option.
_NAMED = {"constants": "--set", "units": "--unit", "scales": "--scale"}
#: Options whose values are files or folders, and those that may hold some.
_FILES = ("--holdout", "--output")
_MAY_BE_FILES = ("--effects", "--fix", "--prior")


def expanded(words: Sequence[str], group: click.Group) -> list[str]:
    """A command line with its project file written out; the same where it names none."""
    if not words or words[0] not in group.commands:
        return list(words)
    command = group.commands[words[0]]
    arguments, options, project = _taken_apart(words[1:], command)
    if project is None:
        return list(words)
    content = _read(Path(project))
    _refuse_unknown(project, content, group)
    own = content.get(words[0], {}) if isinstance(content.get(words[0]), dict) else {}
    placed = _Placed(Path(project).parent)
    own_words = _without(_options(own, command, placed), _names(options))
    said = _without(_options(content, command, placed), _names([*own_words, *options]))
    found = _arguments(arguments, content, command, placed)
    return [words[0], *found, *said, *own_words, *options]


def _names(words: Sequence[str]) -> set[tuple[str, str]]:
    """Options and the names that are given a value behind them."""
    split = [w.partition("=")[::2] if w.startswith("--") and "=" in w else (w,) for w in words]
    flat = [part for parts in split for part in parts]
    return {(o, w.partition("=")[0]) for o, w in pairwise(flat) if o.startswith("--") and "=" in w}


def _without(words: Iterable[str], later: set[tuple[str, str]]) -> list[str]:
    """Words of options but for names that are given another value later."""
    kept = list[str]()
    for word in words:
        if not word.startswith("--") and (kept[-1], word.partition("=")[0]) in later:
            kept.pop()
        else:
            kept.append(word)
    return kept


class _Placed:
    """Names in a project file are seen from its folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, name: str) -> str:
        """A file or folder, also several joined by +."""
        return "+".join(str(self.folder / part.strip()) for part in name.split("+"))

    def perhaps(self, text: str) -> str:
        """`@result.json` and `file.py:name`; what names no file stays."""
        before, at, path = text.rpartition("@")
        if at:
            return f"{before}@{self.folder / path}"
        return str(self.folder / text) if ".py" in text else text


def _taken_apart(
    words: Sequence[str], command: click.Command
) -> tuple[list[str], list[str], str | None]:
    """Arguments, options with their values, and the project file that a command line names."""
    flags = {
        name
        for p in command.params
        if isinstance(p, click.Option) and (p.is_flag or p.count)
        for name in p.opts
    }
    arguments, options, project = list[str](), list[str](), None
    rest = iter(words)
    for word in rest:
        if word == FLAG:
            project = next(rest, "")
        elif word.startswith(f"{FLAG}="):
            project = word.partition("=")[2]
        elif not word.startswith("-") or word == "-":
            arguments.append(word)
        elif word in flags or "=" in word or (not word.startswith("--") and len(word) > 2):
            options.append(word)
        else:
            options += [word, *([value] if (value := next(rest, None)) is not None else [])]
    return arguments, options, project


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(
            f"{FLAG} {path}: {error.strerror}; `casest init DATA` writes one"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{FLAG} {path}: is no TOML: {error}") from None


def _refuse_unknown(project: str, content: Mapping[str, Any], group: click.Group) -> None:
    """Refuse what no command has: a typing error would be left out without a word."""
    every = {o for c in group.commands.values() for p in c.params for o in p.opts if o[:2] == "--"}
    own = {name: flag for name, flag in _NAMED.items() if flag in every}
    known = [*ARGUMENTS, *own, *(o[2:].replace("-", "_") for o in sorted(every - {FLAG}))]
    for name, value in content.items():
        if name in known or (name in group.commands and isinstance(value, dict)):
            continue
        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(known[:12])} …"
        raise UsageError(f"{FLAG} {project}: no option {name}; {hint}")


def _arguments(
    typed: Sequence[str], content: Mapping[str, Any], command: click.Command, placed: _Placed
) -> list[str]:
    """MODEL or RESULT, then DATA: as typed, else as the file has them."""
    names = [p.name for p in command.params if isinstance(p, click.Argument)]
    found, typed = list[str](), list(typed)
    for name in names:
        if name == "data":
            data = content.get("data", [])
            listed = [data] if isinstance(data, str) else data
            found += typed or [placed.file(str(d)) for d in listed]
        elif name == "model_name":
            own = content.get("model")
            first = typed.pop(0) if typed and (own is None or _is_model(typed[0])) else None
            found += [first] if first else [placed.perhaps(str(own))] if own else []
        elif name == "result_path":
            own = content.get("output")
            first = typed.pop(0) if len(typed) > 1 or not own else None
            found += [first] if first else [placed.file(str(own))]
    return found


def _is_model(word: str) -> bool:
    """Is this a model's name or file, and no record?"""
    from casest.cli.completing import declared_names

    shipped = [n for v in ("SHIPPED", "MOVING") for n in declared_names("results/find.py", v)]
    return word in shipped or word.partition(":")[0].endswith(".py")


def _options(content: Mapping[str, Any], command: click.Command, placed: _Placed) -> Iterator[str]:
    """The entries that are options of this command; those of other commands are left out."""
    known = {o: p for p in command.params if isinstance(p, click.Option) for o in p.opts}
    for name, value in content.items():
        option = _NAMED.get(name, f"--{name.replace('_', '-')}")
        if option in known and name not in ARGUMENTS:
            yield from _words(option, value, placed, flag=known[option].is_flag)


def _words(option: str, value: Any, placed: _Placed, *, flag: bool) -> Iterator[str]:
    if flag or isinstance(value, bool):
        if not isinstance(value, bool):
            raise UsageError(f"{FLAG}: {option[2:]} is true or false, not {value!r}")
        yield from [option] if value else []
    elif isinstance(value, dict):
        for name, own in value.items():
            yield from (option, f"{name}={_text(option, own, placed)}")
    elif isinstance(value, list):
        for own in value:
            yield from (option, _text(option, own, placed))
    else:
        yield from (option, _text(option, value, placed))


def _text(option: str, value: Any, placed: _Placed) -> str:
    """A value as one would type it: 1,2,3 and rows 1,0;0,1."""
    if isinstance(value, list):
        rows = any(isinstance(own, list) for own in value)
        return (";" if rows else ",").join(_text("", own, placed) for own in value)
    text = str(value)
    if option in _FILES:
        return placed.file(text)
    return placed.perhaps(text) if option in _MAY_BE_FILES else text
