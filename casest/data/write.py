"""Writing results so that a reader never meets half a file, nor half of what belongs together."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path

from casest.errors import DataError
from casest.interruption import held_back

#: Files written so far of those that appear together: name to come by temporary name.
_together: ContextVar[dict[str, Path] | None] = ContextVar("together", default=None)


@contextlib.contextmanager
def written_together() -> Iterator[None]:
    """Within it files keep temporary names; all get their own at its end, none on an error."""
    pending: dict[str, Path] = {}
    token = _together.set(pending)
    try:
        yield
        _rename(pending)
    finally:
        _together.reset(token)
        for temporary in pending:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


#: What a file holds: text, bytes, or text in pieces that need not be in memory together.
Content = str | bytes | Iterable[str]


def write_atomically(path: str | os.PathLike[str], text: Content) -> None:
    """Write text (in UTF-8) or bytes to `path`: it holds the old content or all of the new.

    The text, whole or in pieces, goes to a temporary name in the same folder, reaches the disk, and
    is then renamed.
    What is no character, as in the name of a file that is not UTF-8, becomes a question mark.
    Raises DataError where the folder is missing or cannot be written.
    """
    pending = _together.get()
    if pending is not None:
        _write(Path(path), text, pending)
        return
    with written_together():
        write_atomically(path, text)


def _write(target: Path, text: Content, pending: dict[str, Path]) -> None:
    """The text under a temporary name, which `pending` lists from the moment it exists."""
    try:
        with held_back():
            handle, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
            pending[temporary] = target
    except OSError as error:
        raise DataError(
            f"{target}: cannot be written ({error.strerror}); "
            f"give a folder that exists and may be written to"
        ) from error
    try:
        with os.fdopen(handle, "wb") as file:
            for piece in [text] if isinstance(text, str | bytes) else text:
                file.write(piece.encode(errors="replace") if isinstance(piece, str) else piece)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, _usual_mode())  # mkstemp makes files that only the owner can read
    except OSError as error:
        raise DataError(f"{target}: cannot be written ({error.strerror})") from error


def _rename(pending: dict[str, Path]) -> None:
    """Give every file its name: all of them, also where Ctrl-C is pressed meanwhile."""
    with held_back():
        for temporary, target in list(pending.items()):
            try:
                os.replace(temporary, target)
            except OSError as error:
                raise DataError(f"{target}: cannot be written ({error.strerror})") from error
            del pending[temporary]


def _usual_mode() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
