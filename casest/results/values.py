"""Values of a fit: every entry of a parameter with its spread, and what was held."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.estimate.estimate import Estimate
from casest.results.file import plain
from casest.results.result import Parameter
from casest.results.rounding import rounded
from casest.results.uncertainty import Input, inputs_of
from casest.results.units import entry_units, unit_table


@dataclass(frozen=True)
class Entry:
    """One number of a parameter: `below` and `above` is how far its 95 % interval reaches.

    The name says of which run it is, if there are several; a unit of 1 is empty. `missing` stands
    for a standard deviation that there is not.
    """

    name: str
    unit: str
    value: float
    std: float
    below: float
    above: float
    missing: str = "not determined"

    @property
    def shown(self) -> tuple[str, str]:
        """Value and standard deviation with the digits that mean something."""
        return rounded(self.value, self.std, self.missing)

    @property
    def on_bound(self) -> str:
        """For a value on its bound the end of its interval in words; else empty."""
        if np.isfinite(self.std) or not np.isfinite(self.below + self.above):
            return ""
        if self.above:
            return f"on its bound; below {self.value + self.above:.2g} (95 %)"
        return f"on its bound; above {self.value - self.below:.2g} (95 %)"


@dataclass(frozen=True)
class Held:
    """A constant; `frozen`: it was an unknown, and has an uncertainty of its own.

    `std` is carried into the fit, where it is known: `share` (0 to 1) is the largest part that it
    has of the variance of any entry, that of `most`.
    """

    name: str
    value: Array
    unit: str
    frozen: bool
    std: Array | None = None
    share: float = 0.0
    most: str = ""


def entries(estimate: Estimate) -> tuple[Entry, ...]:
    """Every entry of every parameter, in the order of the declaration."""
    return tuple(_entries(estimate))


def _entries(found: Estimate) -> Iterator[Entry]:
    known = _stated(unit_table(found.model, found.problem.runs))
    numbers = (found.values, found.std, *found.interval_reach)
    seen = found.identifiability.rank == found.identifiability.unknowns
    missing = "unknown" if seen else "not determined"
    for p in found.model.parameters:
        units = entry_units(p, known)
        several = found.values[p.name].ndim > len(p.shape.dims)
        for r in range(len(found.values[p.name]) if several else 1):
            run = f" ({found.problem.runs[r].name})" if several else ""
            own = [of[p.name][r] if several else of[p.name] for of in numbers]
            for name, i, unit in zip(p.entry_names, p.shape.entries, units, strict=True):
                shown = "" if unit == "1" else unit
                value, std, below, above = (float(v[i]) for v in own)
                yield Entry(name + run, shown, value, std, below, above, missing)


def held(estimate: Estimate, units: Mapping[str, str]) -> tuple[Held, ...]:
    """Constants, and parameters held at a value."""
    found = inputs_of(estimate)
    return tuple(_held(c, units.get(c.name, ""), found) for c in estimate.model.constants)


def _held(c: Constant, unit: str, inputs: Sequence[Input]) -> Held:
    own = [i for i in inputs if i.name.partition("[")[0].partition(" (")[0] == c.name]
    if not own:
        return Held(c.name, c.array, unit, c.frozen is not None)
    shares = {name: sum(i.share[name] or 0.0 for i in own) for name in own[0].share}
    most = max(shares, key=lambda name: shares[name])
    std = np.array([i.std for i in own]) if c.std is None else c.std
    return Held(c.name, c.array, unit, c.frozen is not None, std, shares[most], most)


def parameter_table(estimate: Estimate, table: Mapping[str, str]) -> dict[str, Parameter]:
    """Value, standard deviations, interval and unit of every parameter."""
    reach = estimate.interval_reach
    known = _stated(table)
    found = {}
    for p in estimate.model.parameters:
        value, std = estimate.values[p.name], estimate.std[p.name]
        below, above = reach[0][p.name], reach[1][p.name]
        own = entry_units(p, known)
        found[p.name] = Parameter(
            value=plain(value),
            std=plain(std),
            plain_std=plain(estimate.plain[p.name]),
            robust_std=plain(estimate.robust[p.name]),
            interval95=[plain(value - below), plain(value + above)],
            unit=own[0] if len(set(own)) == 1 else own,
        )
    return found


def _stated(table: Mapping[str, str]) -> dict[str, str]:
    """Units of whole symbols, without those of entries."""
    return {n: u for n, u in table.items() if "[" not in n}
