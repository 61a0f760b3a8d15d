"""Raw counts to physical values as a data sheet says it: `int16/256+25`."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.errors import DataError, UsageError

Array = NDArray[np.float64]

_BITS = {"int8": 8, "int16": 16, "int32": 32, "uint8": 8, "uint16": 16, "uint32": 32}
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_STEP = re.compile(rf"\s*([-+*/])\s*([-+]?{_NUMBER})\s*")


@dataclass(frozen=True)
class Scale:
    """A reinterpretation of the stored number, then steps in the order written."""

    kind: str | None
    steps: tuple[tuple[str, float], ...]

    def apply(self, values: Array, file: str, column: str) -> Array:
        """Return the scaled values, (N,); raises DataError naming a row that does not fit."""
        result = self._reinterpreted(values, file, column) if self.kind else values.copy()
        with np.errstate(over="ignore", under="ignore"):  # what is too large is refused by its user
            return self._stepped(result)

    def _stepped(self, result: Array) -> Array:
        for sign, number in self.steps:
            if sign == "*":
                result = result * number
            elif sign == "/":
                result = result / number
            else:
                result = result + (number if sign == "+" else -number)
        return result

    def _reinterpreted(self, values: Array, file: str, column: str) -> Array:
        """Two's complement: 65236 stored in 16 bits is -300; NaN (an unused bad cell) stays."""
        kind = str(self.kind)
        range_ = 2.0 ** _BITS[kind]
        with np.errstate(invalid="ignore"):
            wrong = (values != np.round(values)) | (values < -range_ / 2) | (values >= range_)
        wrong &= ~np.isnan(values)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise DataError(
                f"{file}: column {column} row {row} holds {values[row]:g}, which is no {kind}; "
                f"leave {kind} out of --scale {column}=… if the values are scaled already"
            )
        unsigned = np.mod(values, range_)
        if kind.startswith("uint"):
            return np.asarray(unsigned)
        return np.where(unsigned >= range_ / 2, unsigned - range_, unsigned)


def parse_scale(text: str) -> Scale:
    """Read `int16/256+25`, `/131`, `0.001-2`; steps apply from left to right.

    Raises UsageError that says how a scale is written.
    """
    rest = text.strip()
    found = re.match(r"u?int\d+", rest)
    kind = found[0] if found else None
    rest = rest[len(kind) :] if kind else rest
    if kind is None and re.match(_NUMBER, rest):  # 1/16384 is a factor and a divisor
        rest = f"*{rest}"
    steps = []
    while rest:
        step = _STEP.match(rest)
        if step is None or (step[1] == "/" and float(step[2]) == 0.0):
            raise _misread(text, rest)
        steps.append((step[1], float(step[2])))
        rest = rest[step.end() :]
    if (kind is not None and kind not in _BITS) or (kind is None and not steps):
        raise _misread(text, text)
    return Scale(kind, tuple(steps))


def _misread(text: str, at: str) -> UsageError:
    return UsageError(
        f"scale '{text}' is not understood at '{at}': write /number *number +number "
        f"-number, behind a type ({', '.join(_BITS)}) if need be: /16384, int16/256+25"
    )
