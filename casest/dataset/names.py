"""Names of sensors: which rows belong to one, and which name is there twice.

A sensor that is there twice cannot be seen from its own partition. So the names of all files, a
small part of their bytes, are looked through first: as numbers of 64 bits, that are sorted; names
whose numbers are alike are then compared themselves. Of more names than SORTED at once, a part is
looked at in each of several passes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.data.column import LONGEST

Numbers = NDArray[np.uint64]

#: Names that are sorted at once: 400 MB.
SORTED = 50_000_000
#: Rows of names that are read at once; and of which the bytes are looked at at once: few enough to
#: stay in the cache.
PIECE, FEW = 1 << 17, 1 << 13
#: Names that are there twice, of which more would be a wrong column.
MOST = 100_000


class Names(NamedTuple):
    """Names of sensors (an Arrow array) and the row in the file at which each begins."""

    names: Any
    rows: NDArray[np.int64]


def text(name: Any) -> str:
    """A sensor's name as it is written in results."""
    return str(name)


def empty(names: Any) -> NDArray[np.bool_]:
    """Which rows of an Arrow array hold no name."""
    import pyarrow
    import pyarrow.compute

    gone = names.is_null()
    if pyarrow.types.is_string(names.type) or pyarrow.types.is_large_string(names.type):
        blank = pyarrow.compute.or_(
            pyarrow.compute.equal(names, ""), pyarrow.compute.utf8_is_space(names)
        )
        gone = pyarrow.compute.or_(gone, pyarrow.compute.fill_null(blank, True))
    return np.asarray(gone.to_numpy(zero_copy_only=False), dtype=bool)


def plain(names: Any) -> Any:
    """An Arrow array of names as large strings or numbers of 64 bits, in one piece."""
    import pyarrow

    if isinstance(names, pyarrow.ChunkedArray):
        names = names.combine_chunks()
    if pyarrow.types.is_dictionary(names.type):
        names = names.cast(names.type.value_type)
    if pyarrow.types.is_integer(names.type):
        kind = pyarrow.uint64() if pyarrow.types.is_uint64(names.type) else pyarrow.int64()
        return names.cast(kind)
    return names.cast(pyarrow.large_string())


def numbers_of(names: Any) -> Numbers:
    """A number for each name, equal where names are equal; (N,). Rows without a name are 0.

    Multilinear: Σ (byte + 1)·random, which for two different names agree in 64 bits by chance only.
    """
    import pyarrow

    if pyarrow.types.is_integer(names.type):
        filled = names.fill_null(0).to_numpy(zero_copy_only=False)
        return _mixed(np.ascontiguousarray(filled).view(np.uint64))
    bounds = np.frombuffer(names.buffers()[1], np.int64)[names.offset :][: len(names) + 1]
    content = names.buffers()[2]
    data = np.frombuffer(content, np.uint8) if content is not None else np.zeros(0, np.uint8)
    sums = [_sums(data, bounds[k : k + FEW + 1]) for k in range(0, len(names), FEW)]
    return _mixed(np.concatenate([np.zeros(0, np.uint64), *sums]))


def _sums(data: NDArray[np.uint8], bounds: NDArray[np.int64]) -> Numbers:
    """The sum of each name, (N,), whose bytes begin and end at these places of `data`, (N + 1,)."""
    weights, length = _weights(), np.diff(bounds)
    place = np.arange(bounds[0], bounds[-1]) - np.repeat(bounds[:-1], length)
    if length.max(initial=0) > LONGEST:
        place %= LONGEST
    terms = (data[bounds[0] : bounds[-1]].astype(np.uint64) + 1) * weights[place]
    total = np.concatenate([np.zeros(1, np.uint64), np.cumsum(terms, dtype=np.uint64)])
    ends = bounds - bounds[0]
    return np.asarray(
        total[ends[1:]] - total[ends[:-1]] + length.astype(np.uint64) * weights[-1], np.uint64
    )


@lru_cache(maxsize=1)
def _weights() -> Numbers:
    """A random number for each place of a byte in a name, and one for its length."""
    return np.random.default_rng(20_24).integers(0, 2**64, LONGEST + 1, dtype=np.uint64)


def _mixed(values: Numbers) -> Numbers:
    """Each bit spread over all others (the finaliser of MurmurHash3), and never 0."""
    with np.errstate(over="ignore"):
        values = values ^ (values >> np.uint64(33))
        values = values * np.uint64(0xFF51AFD7ED558CCD)
        values = values ^ (values >> np.uint64(33))
        values = values * np.uint64(0xC4CEB9FE1A85EC53)
        values = values ^ (values >> np.uint64(33))
    return np.asarray(values | np.uint64(1), dtype=np.uint64)


def runs(pieces: Iterable[Any]) -> Iterator[Names]:
    """Names of sensors whose rows follow each other, from names row by row in pieces.

    A name that goes on from one piece to the next is told once.
    """
    row, last = 0, None
    for piece in pieces:
        names = plain(piece)
        if not len(names):
            continue
        code = numbers_of(names)
        code[empty(names)] = 0
        begins = np.concatenate([[last is None or code[0] != last], code[1:] != code[:-1]])
        places = np.flatnonzero(begins)
        yield Names(names.take(places), row + places)
        row, last = row + len(names), code[-1]


def twice(
    read: Callable[[], Iterator[tuple[int, Names]]],
    total: int,
    known: Sequence[Numbers] | None = None,
) -> dict[str, list[Any]]:
    """Names that are there more than once, each with its places (file's number, row).

    `read` goes through the names of all files, `total` of them, and is called again for each pass;
    not at all where their numbers are `known` and none occurs twice.
    """
    if known is None:
        alike = np.unique(np.concatenate([_alike(read, k, total) for k in range(passes(total))]))
    else:
        alike = _repeated(known)
    if not alike.size:
        return {}
    places: dict[str, list[Any]] = {}
    for number, (names, rows) in read():
        chosen = np.flatnonzero(np.isin(numbers_of(names), alike) & ~empty(names))
        for k in chosen:
            places.setdefault(text(names[int(k)].as_py()), []).append((number, int(rows[k])))
    return {name: found for name, found in places.items() if len(found) > 1}


def passes(total: int) -> int:
    """How often so many names are read, so that not too many are sorted at once."""
    return max(1, -(-total // SORTED))


def _alike(read: Callable[[], Iterator[tuple[int, Names]]], k: int, total: int) -> Numbers:
    """Numbers that occur more than once, of those that belong to pass k."""
    parts = np.uint64(passes(total))
    kept = []
    for _, (names, _rows) in read():
        own = numbers_of(names)[~empty(names)]
        kept.append(own if parts == 1 else own[(own >> np.uint64(1)) % parts == k])
    return _repeated(kept)


def _repeated(kept: Sequence[Numbers]) -> Numbers:
    found = np.concatenate(kept) if kept else np.zeros(0, np.uint64)
    found.sort()
    return np.asarray(np.unique(found[1:][found[1:] == found[:-1]]))
