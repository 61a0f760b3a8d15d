"""Writing results so that a reader never meets half a file."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from casest.errors import DataError


def write_atomically(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` (UTF-8) to `path` so that it holds the old content or all of the new.

    The text goes to a temporary name in the same folder, reaches the disk, and is then renamed.
    What is no character, as in the name of a file that is not UTF-8, becomes a question mark.
    Raises DataError where the folder is missing or cannot be written.
    """
    target = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    except OSError as error:
        raise DataError(
            f"{target}: cannot be written ({error.strerror}); "
            f"give a folder that exists and may be written to"
        ) from error
    try:
        with os.fdopen(handle, "w", encoding="utf-8", errors="replace", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, _usual_mode())  # mkstemp makes files that only the owner can read
        os.replace(temporary, target)
    except OSError as error:
        raise DataError(f"{target}: cannot be written ({error.strerror})") from error
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)


def _usual_mode() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
