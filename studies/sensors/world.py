"""What a simulated record is, and its truth. Plain NumPy: nothing here knows casest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sensors.motions import Array, Rng


@dataclass(frozen=True)
class World:
    """A record and its truth.

    `read` names the signal that is the sensor's reading; `clean` is that reading without noise, and
    `plain` what it were without the effect (several where the model's zero is a convention: with
    no current, or with the mean one). `truth` has the declared parameters, `compared` names those
    that mean the same with the effect and without. `shares` add up to what the effect does;
    `block` numbers the stretch or the position of each row.
    """

    model: str
    read: str
    signals: Mapping[str, Array]
    units: Mapping[str, str]
    clean: Array
    plain: tuple[Array, ...]
    truth: Mapping[str, Array | float]
    compared: tuple[str, ...]
    sigma: float
    time: Array
    columns: Mapping[str, Array]
    column_units: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    count: int = 1
    shares: tuple[Array, ...] = ()
    block: NDArray[np.int_] | None = None

    @property
    def hidden(self) -> Array:
        """What the effect does to the reading, (N, k)."""
        return self.clean - self.plain[0]

    @property
    def parts(self) -> tuple[Array, ...]:
        """The same in parts of sizes that nobody would know beforehand, each (N, k)."""
        return self.shares or (self.hidden,)


Record = Callable[[Rng, bool], World]
Sensor = Callable[[Rng, float], Record]


def noisy(rng: Rng, clean: Array, sigma: float) -> Array:
    """White noise; every fourth record's has heavier tails."""
    if rng.random() < 0.25:
        return clean + sigma * rng.standard_t(5, clean.shape) * np.sqrt(3 / 5)
    return clean + sigma * rng.standard_normal(clean.shape)


def by_axis(hidden: Array) -> tuple[Array, ...]:
    """What happens to each axis, as a part of its own."""
    return tuple(hidden * (np.arange(hidden.shape[1]) == k) for k in range(hidden.shape[1]))


def units_of(columns: Mapping[str, Array]) -> dict[str, str]:
    known = {"temperature": "degC", "supply": "V", "current": "A", "theta": "rad"}
    return {name: known[name] for name in columns}
