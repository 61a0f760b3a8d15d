"""`--sensor-noise x,y=…`: noise that signals have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from casest.declaration.symbols import Signal
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.shapes import Array


class Option(Protocol):
    """What was said of one signal, or of several that have something in common."""

    @property
    def flag(self) -> str:
        """How it is called where it was said."""

    @property
    def text(self) -> str:
        """All that was said, for errors."""

    def pair(self) -> tuple[str, str]:
        """The signals, and what is said of them."""


def joint(option: Option, text: str, signals: Sequence[Signal], run: Run, used: set[str]) -> Array:
    """Covariance (1, k, k) or (N, k, k) of all numbers of signals one after the other.

    Rows `a,b;c,d`, a file of them, or the columns of its lower triangle, row by row, in the
    products of the model's units.
    """
    size = sum(s.size for s in signals)
    words = [word.strip() for word in text.split(",")]
    if all(word in run.columns for word in words):
        used.update(words)
        return _of_columns(option, words, size, run)
    if text.startswith("@"):
        matrix = matrix_in(option, text[1:])
    else:
        try:
            matrix = np.array([[float(cell) for cell in row.split(",")] for row in text.split(";")])
        except ValueError:
            there = ", ".join(run.columns) or "no more columns"
            raise UsageError(
                f"{option.flag} {option.text}: {text!r} is no covariance, rows a,b;c,d or @FILE, "
                f"and no columns of {run.file or run.name}; it has {there}"
            ) from None
    if matrix.shape != (size, size):
        names = " and ".join(s.name for s in signals)
        raise UsageError(
            f"{option.flag} {option.text}: {names} have {size} components, and the covariance is "
            f"{' by '.join(map(str, matrix.shape))}"
        )
    return matrix[None]


def matrix_in(option: Option, file: str) -> Array:
    """A matrix in a text file, its cells apart by commas or blanks."""
    try:
        with open(file, encoding="utf-8") as lines:
            return np.loadtxt((line.replace(",", " ") for line in lines), ndmin=2)
    except (OSError, ValueError) as error:
        said = error.strerror if isinstance(error, OSError) else "it is no matrix of numbers"
        raise UsageError(f"{option.flag} {option.text}: {file}: {said}") from None


def _of_columns(option: Option, words: Sequence[str], size: int, run: Run) -> Array:
    rows, columns = np.tril_indices(size)
    if len(words) != len(rows):
        raise UsageError(
            f"{option.flag} {option.text}: a covariance of {size} numbers has {len(rows)} columns, "
            f"its lower triangle row by row, not {len(words)}"
        )
    found = np.zeros((len(run), size, size))
    for word, i, j in zip(words, rows, columns, strict=True):
        found[:, i, j] = found[:, j, i] = numbers_in(word, run)
    return found


def numbers_in(name: str, run: Run) -> Array:
    """A column of numbers (N,)."""
    values = run.columns[name]
    if not np.issubdtype(values.dtype, np.number):
        raise UsageError(f"{run.file}: column {name} holds text, no numbers")
    return np.asarray(values, float)


def correlation(
    option: Option, text: str, first: Array, second: Array, run: Run, used: set[str]
) -> Array:
    """Covariances (N, 2, 2) from standard deviations (1,), (1, 1) or (N, 1) and a correlation."""
    if text in run.columns:
        used.add(text)
        r = numbers_in(text, run)
    else:
        try:
            r = np.full(len(run), float(text))
        except ValueError:
            raise UsageError(
                f"{option.flag} {option.text}: {text!r} is no correlation, and no column of "
                f"{run.file or run.name}"
            ) from None
    bad = np.flatnonzero(~(np.abs(r) <= 1))
    if bad.size:
        raise UsageError(
            f"{option.flag} {option.text}: a correlation lies between -1 and 1, and {r[bad[0]]:g} "
            "does not"
        )
    found = np.empty((len(run), 2, 2))
    a, b = (np.broadcast_to(np.reshape(s, -1), (len(run),)) for s in (first, second))
    found[:, 0, 0], found[:, 1, 1] = a**2, b**2
    found[:, 0, 1] = found[:, 1, 0] = r * a * b
    return found
