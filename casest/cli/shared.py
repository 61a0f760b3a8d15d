"""What all commands share. Heavy modules are imported inside the commands: help must be quick."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from casest import __version__
from casest.cli.command import Command, printed
from casest.cli.waiting import Waiting
from casest.errors import DataError
from casest.escaping import one_line, terminal
from casest.interruption import too_late

shown = Waiting()

#: Say what is going on, where somebody watches.
progress = shown.say


def echo(text: str, *, verdict: bool = False, err: bool = False, nl: bool = True) -> None:
    """Print, after what was said of the waiting is wiped away.

    Names that others wrote may hold escape sequences: none reaches the terminal, and an error is
    one line. A `verdict` is coloured.
    """
    shown.done()
    text = one_line(text) if err else terminal(text)
    if err:
        click.echo(text, err=True, nl=nl)
        return
    if verdict:
        from casest.report.text.layout import coloured

        too_late()  # what is said now to be written will be
        text = coloured(text, printed())
    try:
        click.echo(text, file=printed(), nl=nl)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise DataError(f"standard output cannot be written ({error.strerror})") from None


class Careful(click.Group):
    """Refuses a command whose results would be written over a file that it reads."""

    def invoke(self, ctx: click.Context) -> Any:
        """Before anything is read or computed."""
        from casest.errors import UsageError
        from casest.report.next_command import typed_words
        from casest.results.written import overwritten

        words = typed_words(shlex.join(["casest", *(ctx.obj or [])]))
        if words and (lost := overwritten(words.name, words.output, words.read)):
            raise UsageError(
                f"-o {words.output}: {lost} is read, and would be written over; give another -o"
            )
        return super().invoke(ctx)


@click.group(cls=Careful, context_settings={"help_option_names": ["-h", "--help"]})
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
        too_late()
        echo(f"\nWritten: {output}/{files}")
    if words := following(typed(), output, **known):
        echo(f"\n{words}")


def reported(folder: Path, page: str) -> None:
    """`report.html` beside the results."""
    from casest.report.html import REPORT

    write(folder / REPORT, page)


def write(path: Path, text: str | Iterable[str]) -> None:
    """A file in a folder that is made if it is missing."""
    from casest.data.write import make_folder, write_atomically

    make_folder(path.parent)
    write_atomically(path, text)
