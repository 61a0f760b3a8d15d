"""From the fields of a frozen dataclass to the flags of a command, and back to one value.

A field made by `flag` is an option; one whose default is a dataclass of the same sort is a group
of options. Their order is that of `--help`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import Field, field, fields
from enum import Enum
from functools import wraps
from typing import Any, TypeVar

import click

from casest.errors import UsageError

T = TypeVar("T")
R = TypeVar("R")


class Kind(Enum):
    """What a model is: fitted to records, or followed along one."""

    FITTED = "fitted"
    MOVING = "moving"


def flag(
    default: T,
    *flags: str,
    of: Callable[[str, str], Any] | None = None,
    only: Kind | None = None,
    **how: Any,
) -> T:
    """A field that is an option: its flags, the long one last, and what click is told of it.

    Where the default is () it may be repeated, where it is False it takes no value. `of` makes
    what one of several holds, from the long flag and the word behind it. `only` is the kind of
    model that has the option, where not every kind has it.
    """
    metadata = {"flags": flags, "of": of, "only": only, "how": how}
    made: T = field(default=default, metadata=metadata)
    return made


def taking(group: Callable[[], Any]) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a command the options of a dataclass; they reach it as one value called `options`."""

    def decorate(command: Callable[..., R]) -> Callable[..., R]:
        @wraps(command)
        def called(**words: Any) -> R:
            return command(options=built(group, words), **words)

        return _declared(group, called)

    return decorate


def refuse(given: Any, kind: Kind, why: str) -> None:
    """UsageError about an option that was given and that only models of `kind` have."""
    for name in _given(given, kind):
        raise UsageError(f"{name} {why}")


def _declared(group: Any, command: Callable[..., R]) -> Callable[..., R]:
    """The command with every option of the group; click takes the last one first."""
    for option in reversed(fields(group)):
        if option.metadata:
            add = click.option(*option.metadata["flags"], option.name, **_words(option))
            command = add(command)
        else:
            command = _declared(option.default_factory, command)
    return command


def _words(option: Field[Any]) -> dict[str, Any]:
    how: dict[str, Any] = option.metadata["how"]
    if option.default == ():
        return {"multiple": True, **how}
    if how.get("required"):  # to click a default of None is one: it would never be missing
        return how
    return {"default": option.default, "is_flag": option.default is False, **how}


def built(group: Any, words: dict[str, Any]) -> Any:
    """The group with what click found, which is taken out of `words`."""
    return group(**{option.name: _value(option, words) for option in fields(group)})


def _value(option: Field[Any], words: dict[str, Any]) -> Any:
    if not option.metadata:
        return built(option.default_factory, words)
    found, of = words.pop(option.name), option.metadata["of"]
    if not of:
        return found
    long = option.metadata["flags"][-1]
    _refuse_two_values(long, found)
    return tuple(of(long, word) for word in found)


def _refuse_two_values(option: str, given: Sequence[str]) -> None:
    """UsageError where a name is given two values: one of them would be left out without a word."""
    first: dict[str, str] = {}
    for word in given:
        name = word.partition("=")[0]
        if first.setdefault(name, word) != word:
            raise UsageError(f"{option} {first[name]} and {option} {word}: {name} has one value")


def _given(group: Any, kind: Kind) -> Iterator[str]:
    """Long flags of what was given: groups first, in each the last declared first."""
    for option in fields(group):
        if not option.metadata:
            yield from _given(getattr(group, option.name), kind)
    for option in reversed(fields(group)):
        if option.metadata.get("only") is kind and getattr(group, option.name):
            yield option.metadata["flags"][-1]
