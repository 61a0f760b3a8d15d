"""The tags of a MATLAB file up to version 7: SciPy ends the process where one of them is damaged.

"MAT-File Format", MathWorks, chapter 1: an element is a type, a number of bytes and as many bytes;
a matrix holds elements, a compressed one is an element.
"""

from __future__ import annotations

import mmap
import zlib
from pathlib import Path

_HEADER = 128
_COMPLEX = 0x800
_NUMBERS = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18)  # and text, which is numbers too
_MATRIX, _COMPRESSED = 14, 15
_FLAGS, _DIMENSIONS, _NAME = 6, 5, (1, 2)  # types of the first three elements of a matrix
#: How many elements of numbers a class has: text, sparse (row, column, value), dense.
_PARTS = {4: 1, 5: 3} | dict.fromkeys(range(6, 16), 1)
_CLASSES, _OPAQUE = range(1, 18), 17
_DEEPEST = 30

Bytes = bytes | mmap.mmap | memoryview


def check_tags(file: Path) -> None:
    """Raise ValueError where an element of the file has an unknown type or leaves its bounds."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as raw:
        if len(raw) < _HEADER:
            raise ValueError("its header is cut off")
        order = raw[126:128]
        if order not in (b"IM", b"MI"):
            raise ValueError("its header does not say the order of bytes")
        _Elements(raw, "little" if order == b"IM" else "big").check(_HEADER, len(raw), 0)


class _Elements:
    """A stretch of a file in one order of bytes."""

    def __init__(self, raw: Bytes, order: str) -> None:
        self.raw, self.little = raw, order == "little"

    def number(self, at: int, size: int = 4) -> int:
        return int.from_bytes(self.raw[at : at + size], "little" if self.little else "big")

    def tag(self, at: int, end: int) -> tuple[int, int, int, int]:
        """Type, first byte, number of bytes, and where the next element begins."""
        if at + 8 > end:
            raise ValueError(f"cut off at byte {at}")
        first = self.number(at)
        if first >> 16:  # small: type and size in four bytes, the data in the next four
            kind, size, start, after = first & 0xFFFF, first >> 16, at + 4, at + 8
            whole = size <= 4
        else:
            kind, size, start = first, self.number(at + 4), at + 8
            padding = 0 if kind == _COMPRESSED else -size % 8
            whole = start + size <= end
            after = min(start + size + padding, end)
        if not whole:
            raise ValueError(f"the element at byte {at} is longer than what there is")
        return kind, start, size, after

    def check(self, at: int, end: int, depth: int) -> None:
        """All elements of a stretch: those of the file, or matrices within one."""
        while at < end:
            kind, start, size, after = self.tag(at, end)
            if kind == _COMPRESSED and depth == 0:
                inside = zlib.decompress(bytes(self.raw[start : start + size]))
                order = "little" if self.little else "big"
                _Elements(memoryview(inside), order).check(0, len(inside), 1)
            elif kind == _MATRIX:
                self.check_matrix(start, start + size, depth + 1)
            else:
                raise ValueError(f"the element at byte {at} has the unknown type {kind}")
            at = after

    def check_matrix(self, at: int, end: int, depth: int) -> None:
        """Flags, dimensions and name, then numbers or further matrices."""
        if at == end:
            return  # an empty one
        if depth > _DEEPEST:
            raise ValueError("its matrices lie too deep in each other")
        kind, start, size, at = self.tag(at, end)
        first, content = start, self.number(start) & 0xFF
        if kind != _FLAGS or size != 8 or content not in _CLASSES:
            raise ValueError(f"the matrix before byte {at} is of no known class")
        if content != _OPAQUE:
            kind, _, size, at = self.tag(at, end)
            if kind != _DIMENSIONS or size < 8 or size % 4:
                raise ValueError(f"the dimensions before byte {at} are damaged")
            kind, _, _, at = self.tag(at, end)
            if kind not in _NAME:
                raise ValueError(f"the name before byte {at} is damaged")
        parts = _PARTS.get(content, 0) + bool(content in _PARTS and self.is_complex(first))
        while at < end:
            kind, start, size, after = self.tag(at, end)
            parts -= 1
            if kind == _MATRIX and content not in _PARTS:
                self.check_matrix(start, start + size, depth + 1)
            elif kind not in _NUMBERS:
                raise ValueError(f"the numbers at byte {at} are of the unknown type {kind}")
            at = after
        if content in _PARTS and parts:
            raise ValueError(f"the matrix before byte {at} has not the numbers that it announces")

    def is_complex(self, flags: int) -> bool:
        """Whether a matrix has an imaginary part."""
        return bool(self.number(flags) & _COMPLEX)
