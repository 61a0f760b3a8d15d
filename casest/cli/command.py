"""What every command does: its files appear together or not at all, its words alone are printed."""

from __future__ import annotations

import mmap
import sys
from contextlib import redirect_stdout
from contextvars import ContextVar
from typing import Any, TextIO

import click

from casest.errors import DeclarationError, UsageError
from casest.interruption import too_late

#: Bytes of address space below which linear algebra does not fail but waits for memory for ever:
#: OpenBLAS did at 0.40 to 0.60 GB on two cores.
NEEDED = 1_000_000_000

_printed: ContextVar[TextIO | None] = ContextVar("printed", default=None)


def printed() -> TextIO:
    """Standard output, for the words of a command."""
    return _printed.get() or sys.stdout


class Command(click.Command):
    """A command of `casest`.

    What a model's file prints goes to standard error, so that `--json` is JSON whatever it prints.
    """

    def invoke(self, ctx: click.Context) -> Any:
        """Run it; files get their names at the end, also where the reader closes the pipe."""
        from casest.data.write import written_together

        if sys.stdout is None:
            raise UsageError("standard output is closed; send it to a file, or to /dev/null")
        _refuse_little_memory()
        token = _printed.set(sys.stdout)
        try:
            with redirect_stdout(sys.stderr), written_together():
                try:
                    result = super().invoke(ctx)
                except SystemExit as error:
                    raise DeclarationError(
                        f"the model's code ends the program (SystemExit: {error}); let it return"
                    ) from None
                except BrokenPipeError:  # who reads no further has seen enough
                    result = None
                too_late()
            return result
        finally:
            _printed.reset(token)


def _refuse_little_memory() -> None:
    """UsageError where a limit leaves less address space than is NEEDED."""
    try:
        import resource
    except ImportError:  # there are no such limits
        return
    if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        return
    try:
        mmap.mmap(-1, NEEDED).close()  # only reserved
    except OSError:
        raise UsageError(
            f"less than {NEEDED / 1e9:g} GB of address space are free, and linear algebra would "
            "wait for more without end; raise the limit (ulimit -v)"
        ) from None
