"""What is known of a partition besides its rows: counts, who is rejected and why, moments."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import msgspec
import numpy as np

from casest.declaration.shapes import Array

#: Why something has no trusted numbers: a file that cannot be read, a row without a name, a name
#: that is there twice, readings that cannot be used, a fit that is refused.
FILE, NAMELESS, TWICE, READINGS, REFUSED = "file", "nameless", "twice", "readings", "refused"


class Rejected(msgspec.Struct, frozen=True):
    """One of whom there are no trusted numbers."""

    file: str
    row: int | None
    sensor: str | None
    kind: str
    reason: str


class Moments(msgspec.Struct, frozen=True):
    """Count, mean, Σ(x − mean)², least and largest of some numbers."""

    count: int = 0
    mean: float = 0.0
    squares: float = 0.0
    least: float = float("inf")
    largest: float = float("-inf")

    @classmethod
    def of(cls, values: Array) -> Moments:
        """Of an array; what is not finite does not count."""
        finite = np.isfinite(values)
        values = values if finite.all() else values[finite]
        if not values.size:
            return cls()
        mean = float(values.mean())
        squares = float(np.sum((values - mean) ** 2))
        return cls(len(values), mean, squares, float(values.min()), float(values.max()))

    def joined(self, other: Moments) -> Moments:
        """Of both (Chan, Golub & LeVeque, 1983)."""
        count = self.count + other.count
        if not self.count or not other.count:
            return other if other.count else self
        apart = other.mean - self.mean
        return Moments(
            count,
            self.mean + apart * other.count / count,
            self.squares + other.squares + apart**2 * self.count * other.count / count,
            min(self.least, other.least),
            max(self.largest, other.largest),
        )

    @property
    def std(self) -> float:
        """Standard deviation; NaN of fewer than two."""
        return float(np.sqrt(self.squares / (self.count - 1))) if self.count > 1 else float("nan")


class Tally(msgspec.Struct):
    """Of one partition, or of several put together in their order."""

    sensors: int = 0
    trusted: int = 0
    #: Of refused sensors: how often what is the first that speaks against them.
    codes: dict[str, int] = {}
    moments: dict[str, Moments] = {}
    rejected: list[Rejected] = []

    def reject(self, one: Rejected) -> None:
        """Put one on the list."""
        self.rejected.append(one)


class Total(NamedTuple):
    """All partitions together."""

    sensors: int
    trusted: int
    codes: dict[str, int]
    moments: dict[str, Moments]
    rejected: dict[str, int]


def added(tallies: Iterable[Tally]) -> Total:
    """All tallies in their order: the same digits whoever made them."""
    sensors = trusted = 0
    codes: Counter[str] = Counter()
    rejected: Counter[str] = Counter()
    moments: dict[str, Moments] = {}
    for tally in tallies:
        sensors, trusted = sensors + tally.sensors, trusted + tally.trusted
        codes.update(tally.codes)
        rejected.update(one.kind for one in tally.rejected)
        for name, own in tally.moments.items():
            moments[name] = moments.get(name, Moments()).joined(own)
    return Total(sensors, trusted, dict(codes.most_common()), moments, dict(rejected))
