"""Where compiled kernels are kept: what is loaded from there runs with the user's rights.

So only folders and files count that belong to the user and that nobody else can write, on a path
that nobody else can turn elsewhere. Without such a folder (no home, a strange environment, rights
that are too wide) there is no cache, and NumPy computes.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path


def kernel_folder() -> Path | None:
    """The user's cache folder, made if it is missing; None where there is none to be trusted."""
    folder = _named_folder()
    return folder if folder is not None and _made(folder) and _own_folder(folder) else None


def _named_folder() -> Path | None:
    """CASEST_CACHE, or `casest` in XDG_CACHE_HOME or ~/.cache; None where there is no home."""
    named = os.environ.get("CASEST_CACHE")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(base):  # the XDG rules: a relative one is as good as none
        return Path(base) / "casest"
    try:
        return Path.home() / ".cache" / "casest"
    except RuntimeError:
        return None


def own_file(path: Path) -> bool:
    """Is it a file itself, the user's, that nobody else can write?"""
    return _own(path, stat.S_ISREG)


def _made(folder: Path) -> bool:
    """Is the folder there now?"""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
    except (OSError, ValueError):
        return False
    return os.access(folder, os.R_OK | os.W_OK | os.X_OK)


def _own_folder(folder: Path) -> bool:
    """Is it a folder itself, the user's alone, and can nobody else exchange one above it?"""
    above = Path(os.path.realpath(folder.parent))
    return _own(folder, stat.S_ISDIR) and all(map(_steady, (above, *above.parents)))


def _steady(folder: Path) -> bool:
    """Belongs to the user or root, and others cannot rename what lies in it."""
    found = os.lstat(folder)
    closed = not found.st_mode & 0o022 or bool(found.st_mode & stat.S_ISVTX)
    return closed and found.st_uid in (0, _user())


def _own(path: Path, kind: Callable[[int], bool]) -> bool:
    try:
        found = os.lstat(path)
    except OSError:
        return False
    return kind(found.st_mode) and found.st_uid == _user() and not found.st_mode & 0o022


def _user() -> int:
    """Number of the user; nobody's where the system has none."""
    return os.geteuid() if hasattr(os, "geteuid") else -1
