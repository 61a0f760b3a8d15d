"""What the next measurements are for: a criterion, or standard deviations to be reached."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casest import units
from casest.declaration.shapes import Array
from casest.errors import CasestError, UsageError

_WRITTEN = re.compile(r"\s*([\w.]+(?:\[[\d, ]+\])?)\s*<=?\s*([-+.\deE]+)\s*(.*?)\s*$")


@dataclass(frozen=True)
class Goal:
    """Standard deviations of some combinations that are to be below `limit`, in `unit`.

    columns (n, c): the combinations of the unknowns.
    """

    name: str
    limit: float
    unit: str
    columns: Array

    @property
    def scaled(self) -> Array:
        """Combinations whose variance is 1 where the goal is just reached."""
        return np.asarray(self.columns / self.limit)

    def std(self, C: Array) -> float:
        """The largest standard deviation of the combinations."""
        variances = np.einsum("ij,ik,kj->j", self.columns, C, self.columns)
        return float(np.sqrt(max(variances.max(), 0.0)))

    def __str__(self) -> str:
        """As it is typed."""
        return f"{self.name}<{self.limit:g}{' ' + self.unit if self.unit not in ('', '1') else ''}"


@dataclass(frozen=True)
class Measures:
    """What a goal can be about: unknowns by name with their units, and corrected readings.

    corrected (n, c): slopes of the corrected quantity over the range of the candidates.
    """

    names: Sequence[str]
    units: Mapping[str, str]
    corrected_name: str = ""
    corrected_unit: str = ""
    corrected: Array | None = None

    def goal(self, text: str) -> Goal:
        """`offset<0.001 m/s^2`, `offset[2]<1 mg` or `corrected<0.01 m/s^2`."""
        found = _WRITTEN.fullmatch(text)
        try:
            limit = float(found[2]) if found else np.nan
        except ValueError:
            limit = np.nan
        if found is None or not 0 < limit < np.inf:
            raise UsageError(
                f"--until {text!r}: write NAME<NUMBER UNIT, a standard deviation to be reached: "
                f"--until '{self.names[0]}<0.001'"
            )
        name, unit = found[1].replace(" ", ""), found[3]
        columns, own = self.columns(name, f"--until {text!r}")
        if unit and unit != own:
            try:
                limit = _converted(limit, unit, own)
            except CasestError as error:
                raise type(error)(f"--until {text!r}: {error}") from None
        return Goal(name, limit, own, columns)

    def columns(self, name: str, option: str) -> tuple[Array, str]:
        """Combinations (n, c) that a name stands for, and their unit."""
        if self.corrected is not None and name in ("corrected", self.corrected_name):
            return self.corrected, self.corrected_unit
        own = [i for i, n in enumerate(self.names) if n == name or n.partition("[")[0] == name]
        own = own or [i for i, n in enumerate(self.names) if n.partition(" ")[0] == name]
        if not own:
            near = difflib.get_close_matches(name, self.names, 1)
            there = dict.fromkeys(n.partition("[")[0].partition(" ")[0] for n in self.names)
            also = [] if self.corrected is None else ["corrected"]
            hint = f"did you mean {near[0]}? " if near else ""
            raise UsageError(
                f"{option}: a measurement says nothing of {name!r}; {hint}there is "
                f"{', '.join([*there, *also])}"
            )
        own_units = {self.units[self.names[i]] for i in own}
        if len(own_units) > 1:
            raise UsageError(
                f"{option}: entries of {name} have different units; name one, {self.names[own[0]]}"
            )
        return np.eye(len(self.names))[:, own], own_units.pop()


def _converted(value: float, unit: str, into: str) -> float:
    """A standard deviation in another unit: a zero point does not matter."""
    if "[" in into:
        raise UsageError(
            f"nobody stated the unit that {unit} is to be compared with: leave it out, or say "
            "--unit SIGNAL=UNIT"
        )
    factor, _ = units.conversion(unit, into or "1")
    return value * factor
