"""The command line: `casest COMMAND …`, its exit codes, and that no traceback reaches a user."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import click

from casest.cli import comparing, completing, correcting, fitting, motion, simulating
from casest.cli.shared import commands, echo, shown
from casest.errors import CasestError

__all__ = ["commands", "main", "run"]

#: Every room adds its commands to the group as it is imported.
ROOMS = (fitting, motion, comparing, correcting, simulating, completing)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: exit code 0 done, 1 bad input, 2 no trustworthy estimate."""
    sys.exit(run(arguments))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; no traceback reaches the user."""
    try:
        words = list(sys.argv[1:] if arguments is None else arguments)
        result = commands.main(words, prog_name="casest", standalone_mode=False, obj=words)
        return result if isinstance(result, int) else 0
    except CasestError as error:
        echo(f"casest: {error}", err=True)
        return error.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        echo(error.format_message())
        return 1
    except click.ClickException as error:
        echo(f"casest: {error.format_message()}", err=True)
        return 1
    except (click.Abort, KeyboardInterrupt):
        echo("casest: interrupted; nothing was written", err=True)
        return 2
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if os.environ.get("CASEST_TRACEBACK"):
            raise
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        echo(
            f"casest: internal error, please report it ({text}); CASEST_TRACEBACK=1 shows where",
            err=True,
        )
        return 2
    finally:
        shown.done()
