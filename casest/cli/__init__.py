"""The command line: `casest COMMAND …`, its exit codes, and that no traceback reaches a user."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress

import click

from casest.cli import (
    beginning,
    budgeting,
    checking,
    comparing,
    completing,
    correcting,
    fitting,
    fleets,
    motion,
    planning,
    reporting,
    simulating,
)
from casest.cli.project import expanded
from casest.cli.shared import commands, echo, shown
from casest.errors import INTERNAL, INTERRUPTED, CasestError
from casest.interruption import remember

__all__ = ["commands", "main", "run"]

#: Every room adds its commands to the group as it is imported.
ROOMS = (
    fitting, checking, motion, comparing, correcting, budgeting, simulating, planning, fleets,
    reporting, beginning, completing,
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: exit code 0 done, 1 bad input, 2 no trustworthy estimate.

    3: internal error; 130: Ctrl-C. Neither leaves a file.
    """
    remember()
    sys.exit(run(arguments))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; no traceback reaches the user."""
    try:
        words = expanded(sys.argv[1:] if arguments is None else arguments, commands)
        result = commands.main(words, prog_name="casest", standalone_mode=False, obj=words)
        _close_output()
        return result if isinstance(result, int) else 0
    except click.exceptions.NoArgsIsHelpError as error:
        echo(error.format_message())
        return 1
    except SystemExit as error:  # click's own: after completions, or help into a closed pipe
        _close_output()
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException as error:
        return _ended(error)
    finally:
        shown.done()


def _ended(error: BaseException) -> int:
    """Say what ended the command; its exit code."""
    text, code = _said(error)
    if code == INTERNAL and os.environ.get("CASEST_TRACEBACK"):
        traceback.print_exc()
    with suppress(OSError):
        echo(f"casest: {text}", err=True)
    _close_output()
    return code


def _said(error: BaseException) -> tuple[str, int]:
    """What is said of an error, and the exit code."""
    if isinstance(error, CasestError):
        return str(error), error.exit_code
    if isinstance(error, click.Abort) and isinstance(error.__cause__, EOFError):
        error = error.__cause__  # click takes an end of anything for Ctrl-C
    if isinstance(error, click.Abort) or _is_of_ctrl_c(error):
        return "interrupted; nothing was written", INTERRUPTED
    if isinstance(error, click.ClickException):
        return error.format_message(), 1
    first = (str(error).strip().splitlines() or [""])[0]
    if isinstance(error, MemoryError):
        return f"out of memory ({first or 'nothing is left'}); give a shorter record", 1
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}", 1
    return (
        f"internal error ({type(error).__name__}: {first}), nothing was written; please report it "
        "with the command and `casest --version`; CASEST_TRACEBACK=1 shows where",
        INTERNAL,
    )


def _is_of_ctrl_c(error: BaseException | None) -> bool:
    """Is it Ctrl-C, or was it made of it? Python 3.11 wraps what is raised in `__set_name__`."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _close_output() -> None:
    """Drop what could not be printed: Python would try again at its end, and complain."""
    try:
        sys.stdout.flush()
    except AttributeError:  # closed from the beginning
        return
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
