"""The files of a data set: a file, a folder, a pattern, here or wherever fsspec reaches."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from casest.errors import DataError, library

#: Endings of files that are taken from a folder.
ENDINGS = (".parquet", ".pq", ".parq")
#: Bytes that are read ahead of a column, for a row group need not be in memory as a whole: from
#: this machine so few that they stay in the cache, from elsewhere so many that requests are few.
NEAR, FAR = 1 << 16, 1 << 20
#: What remote stores call the version of an object's content.
_TAGS = ("ETag", "etag", "md5Hash", "generation", "content_md5")


@dataclass(frozen=True)
class File:
    """One file of a data set: its name, `remote` where fsspec opens it, size in bytes.

    `tag` is what its store says of the content; `modified` when that was written, s, of a file on
    this machine.
    """

    name: str
    remote: bool
    size: int
    tag: str = ""
    modified: float = 0.0

    def folder_value(self, column: str) -> str | None:
        """VALUE of a folder `column=VALUE` that the file lies in (Hive); None where there is none.

        The innermost counts.
        """
        for part in reversed(PurePosixPath(self.name.replace("\\", "/")).parts[:-1]):
            name, equals, value = part.partition("=")
            if equals and name == column:
                return unquote(value)
        return None


def files_of(dataset: str) -> tuple[File, ...]:
    """The Parquet files that `dataset` names, in the order of their names.

    A folder stands for those in it and below it; names that begin with . or _ are left out.
    Raises DataError where there are none.
    """
    found = tuple(_remote(dataset) if "://" in dataset else _local(dataset))
    if not found:
        raise DataError(
            f"{dataset}: no Parquet files there (…{', …'.join(ENDINGS)}); name a file, a folder, "
            "or a pattern in quotes"
        )
    return found


def opened(file: File) -> Any:
    """A `pyarrow.parquet.ParquetFile`; DataError where it cannot be read as one."""
    parquet = library("pyarrow.parquet", "parquet", f"{file.name}: a Parquet file")
    try:
        source, ahead = (_stream(file), FAR) if file.remote else (file.name, NEAR)
        return parquet.ParquetFile(source, pre_buffer=False, buffer_size=ahead)
    except Exception as error:  # a damaged file can fail anywhere in the library
        raise unreadable(file, error) from error


def unreadable(file: File, error: Exception) -> DataError:
    """What is said of a file that cannot be read."""
    text = (str(error) or type(error).__name__).splitlines()[0]
    return DataError(f"{file.name}: cannot be read as Parquet ({text}); copy or export it again")


def footer_digest(table: Any) -> str:
    """SHA-256 of what a file says of itself: schema, row groups, statistics, offsets."""
    whole = hashlib.sha256()
    whole.update(str(table.metadata.to_dict()).encode())
    return whole.hexdigest()


def _local(dataset: str) -> Iterator[File]:
    path = Path(dataset)
    if path.is_dir():
        names = [p for p in path.rglob("*") if _wanted(p.relative_to(path))]
    elif path.exists():
        names = [path]
    else:
        names = [Path(name) for name in glob.glob(dataset, recursive=True)]
        names = [p for p in names if p.is_file()]
    for name in sorted(names):
        try:
            about = name.stat()
        except OSError as error:
            raise DataError(f"{name}: cannot be read ({error.strerror})") from None
        yield File(str(name), False, about.st_size, modified=about.st_mtime)


def _wanted(inside: Path) -> bool:
    """Is it a file of a data set, by its name within the folder?"""
    hidden = any(part.startswith((".", "_")) for part in inside.parts)
    return inside.suffix.lower() in ENDINGS and not hidden


def _remote(dataset: str) -> Iterator[File]:
    core = library("fsspec.core", "fleet", f"{dataset}")
    try:
        system, path = core.url_to_fs(dataset)
        if any(mark in path for mark in "*?["):
            names = system.glob(path)
        elif system.isdir(path):
            inside = {name: name.removeprefix(path).strip("/") for name in system.find(path)}
            names = [name for name, own in inside.items() if _wanted(Path(own))]
        else:
            names = [path]
        for name in sorted(names):
            about = system.info(name)
            tag = next((str(about[key]) for key in _TAGS if about.get(key)), "")
            yield File(system.unstrip_protocol(name), True, int(about.get("size") or 0), tag)
    except DataError:
        raise
    except Exception as error:  # every store has errors of its own
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise DataError(f"{dataset}: cannot be opened ({type(error).__name__}: {text})") from error


def _stream(file: File) -> Any:
    core = library("fsspec.core", "fleet", file.name)
    system, path = core.url_to_fs(file.name)
    return system.open(path, "rb")
