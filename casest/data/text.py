"""Bytes that are text, in the encodings that instruments and spreadsheets write."""

from __future__ import annotations

from pathlib import Path

from casest.errors import DataError

#: Signs that no text has: control characters but tab, line ends, form feed and escape.
_BINARY = bytes(k for k in range(32) if k not in (9, 10, 12, 13, 27))
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_START = 4096  # bytes that tell whether a file is text


def is_text(start: bytes) -> bool:
    """Whether bytes at the beginning of a file can be text: next to no control characters."""
    if start.startswith(_UTF16):
        return True
    wrong = len(start) - len(start.translate(None, _BINARY))
    return b"\x00" not in start and wrong <= 0.01 * len(start)


def decoded(file: Path, raw: bytes) -> str:
    """Return a file's text; raise DataError where it is binary or damaged."""
    if not is_text(raw[:_START]):
        raise DataError(f"{file}: is no text but binary; export it as CSV, Parquet, .npy or .mat")
    try:
        if raw.startswith(_UTF16):
            return raw.decode("utf-16")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{file}: its UTF-16 text is damaged at byte {error.start}; export it again"
        ) from error
    if (zero := raw.find(b"\x00")) >= 0:
        line = raw.count(b"\n", 0, zero) + 1
        raise DataError(
            f"{file}: line {line} holds a zero byte: the recording is damaged or was cut off "
            f"there; delete the file from that line on"
        )
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")  # headers such as "µT" or "°C" from Windows
