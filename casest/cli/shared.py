"""What all commands share. Heavy modules are imported inside the commands: help must be quick."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from casest import __version__
from casest.cli.command import Command, printed
from casest.cli.waiting import Waiting
from casest.errors import DataError

shown = Waiting()

#: Say what is going on, where somebody watches.
progress = shown.say


def echo(text: str, **how: Any) -> None:
    """Print, after what was said of the waiting is wiped away."""
    shown.done()
    if how.get("err"):
        click.echo(text, **how)
        return
    try:
        click.echo(text, file=printed(), **how)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise DataError(f"standard output cannot be written ({error.strerror})") from None


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="casest")
def commands() -> None:
    """Calibrate sensors, prove the answer, and say what the data could not determine.

    MODEL is a shipped name (see `casest list`) or `file.py[:name]`.
    """


commands.command_class = Command


def typed() -> str:
    """The command as it can be typed again."""
    return shlex.join(["casest", *click.get_current_context().obj])


def last_words(output: Path | None, files: str, **known: Any) -> None:
    """What has been written, and what to type next."""
    from casest.report.next_command import following

    if output is not None:
        echo(f"\nWritten: {output}/{files}")
    if words := following(typed(), output, **known):
        echo(f"\n{words}")


def reported(folder: Path, page: str) -> None:
    """`report.html` beside the results."""
    from casest.report.html import REPORT

    write(folder / REPORT, page)


def write(path: Path, text: str) -> None:
    """A file in a folder that is made if it is missing."""
    from casest.data.write import write_atomically

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{path.parent}: cannot be made ({error.strerror})") from None
    write_atomically(path, text)
