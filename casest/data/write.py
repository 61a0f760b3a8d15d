"""Writing results so that a reader never meets half a file, nor half of what belongs together."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from casest.errors import DataError
from casest.interruption import held_back


@dataclass(frozen=True)
class _Pending:
    """Files written so far of those that appear together, name to come by temporary name; folders
    that were made for them, outer ones first."""

    files: dict[str, Path] = field(default_factory=dict)
    folders: list[Path] = field(default_factory=list)


_together: ContextVar[_Pending | None] = ContextVar("together", default=None)


@contextlib.contextmanager
def written_together() -> Iterator[None]:
    """Within it files keep temporary names; all get their own at its end, none on an error.

    A folder that was made for them and holds nothing in the end is removed again.
    """
    pending = _Pending()
    token = _together.set(pending)
    try:
        yield
        _rename(pending.files)
    finally:
        _together.reset(token)
        for temporary in pending.files:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        for folder in reversed(pending.folders):
            with contextlib.suppress(OSError):  # it is not empty
                folder.rmdir()


@contextlib.contextmanager
def written_at_once() -> Iterator[None]:
    """Within it each file gets its name as soon as it is whole, also within `written_together`."""
    token = _together.set(None)
    try:
        yield
    finally:
        _together.reset(token)


def make_folder(folder: Path) -> None:
    """Make a folder to write into, and those above it, where there is none.

    Raises DataError where it cannot be made.
    """
    pending = _together.get()
    try:
        missing = [f for f in (folder, *folder.parents) if not f.exists()]
        if pending is not None:
            pending.folders.extend(reversed(missing))
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made ({error.strerror}); give another -o") from None


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
        _write(Path(path), text, pending.files)
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
