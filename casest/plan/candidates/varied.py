"""Values that can be set: from lists and ranges, every combination of them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from casest import units
from casest.declaration.shapes import Array
from casest.errors import CasestError, UsageError

#: Combinations that are looked at, at most.
MOST = 20_000


def values_of(name: str, text: str, unit: str | None, size: int = 1) -> Array:
    """`20,30,40 degC`, `0:60:15 deg`, or of a vector `0,0,1; 0,1,0`: rows (N, size) in `unit`."""
    option = f"--vary {name}={text}"
    numbers, stated = _unit_behind(text)
    try:
        if ":" in numbers and size == 1:
            rows = _range(numbers, option)[:, None]
        else:
            groups = numbers.split(";") if size > 1 or ";" in numbers else numbers.split(",")
            rows = np.array([[float(x) for x in group.split(",")] for group in groups])
    except ValueError:
        raise UsageError(
            f"{option}: write values 20,30,40 or a range 0:60:15 (from, to, step), with a unit "
            "behind or none; vectors as 0,0,1; 0,1,0"
        ) from None
    if rows.shape[1] != size:
        raise UsageError(f"{option}: {name} has {size} numbers, not {rows.shape[1]}; part by ;")
    if not np.isfinite(rows).all():
        raise UsageError(f"{option}: every value must be finite")
    if stated and unit and stated != unit:
        try:
            factor, offset = units.conversion(stated, unit)
        except CasestError as error:
            raise type(error)(f"{option}: {error}") from None
        rows = factor * rows + offset
    return np.asarray(rows)


def _unit_behind(text: str) -> tuple[str, str]:
    head = text.rstrip()
    for i, letter in enumerate(head):
        exponent = letter in "eE" and i and head[i - 1].isdigit() and head[i + 1 : i + 2] in "+-"
        exponent = exponent or (letter in "eE" and head[i + 1 : i + 2].isdigit())
        if (letter.isalpha() or letter in "°%µ") and not exponent:
            return head[:i], head[i:].strip()
    return head, ""


def _range(text: str, option: str) -> Array:
    low, high, step = (float(x) for x in text.split(":"))
    if not (step > 0 and high >= low):
        raise UsageError(f"{option}: from low to high in steps above 0")
    if (high - low) / step > MOST:
        raise UsageError(f"{option}: more than {MOST} values; a larger step")
    return np.asarray(low + step * np.arange(int((high - low) / step + 1e-9) + 1))


def combined(varied: Mapping[str, Array]) -> dict[str, Array]:
    """Every combination of the rows: by name (product, size)."""
    if not varied:
        return {}
    count = int(np.prod([len(rows) for rows in varied.values()]))
    if count > MOST:
        raise UsageError(
            f"--vary: {count} combinations of {', '.join(varied)}; at most {MOST}: fewer values"
        )
    choice: Sequence[tuple[int, ...]] = list(
        itertools.product(*(range(len(rows)) for rows in varied.values()))
    )
    picked = np.array(choice).T
    return {name: rows[i] for (name, rows), i in zip(varied.items(), picked, strict=True)}
