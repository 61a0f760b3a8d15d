"""What casest says when it cannot go on: one line that names the thing and the way out."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class CasestError(Exception):
    """Base of everything casest raises on purpose; its text is meant for the user's eyes.

    `exit_code` is what the command line ends with.
    """

    exit_code = 1


class DeclarationError(CasestError):
    """A model, signal, parameter or effect is declared in a way that makes no sense."""


class DataError(CasestError):
    """A record cannot be used: names file, column, row, value and the way out."""


class UnitError(CasestError):
    """A unit is unknown, or does not fit where it is used."""


class UsageError(CasestError):
    """A command or call asks for something that does not exist or does not fit."""


def last_line(error: BaseException) -> str:
    """The last line of an error from elsewhere, or in plain words where it is CasADi's own."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = lines[-1] if lines else type(error).__name__
    if isinstance(error, SystemExit):
        return f"it ends the program (SystemExit: {text})"
    if "truth value" in text:
        return (
            "an `if` cannot ask about signals or unknowns, which have no value yet; "
            "write if_else(condition, one, other)"
        )
    return text


#: How `casest` ends where it is at fault itself, and where Ctrl-C was pressed.
INTERNAL, INTERRUPTED = 3, 130


class NotTrusted(CasestError):
    """There is no estimate that deserves belief; the text gives the reasons.

    `estimate` is the refused one, where there was any.
    """

    exit_code = 2
    estimate: Any = None


def library(name: str, extra: str, what: str = "this") -> Any:
    """Return the module `name`; where it is missing, UsageError says how `extra` is installed."""
    try:
        return import_module(name)
    except ImportError:
        top = name.partition(".")[0]
        raise UsageError(f"{what} needs the library {top}: pip install 'casest[{extra}]'") from None
