"""What a motion may not exceed: inputs, states, and the rates of either."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest import units
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.equations import per_second
from casest.errors import CasestError, UsageError

RATE = "rate of "
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_WRITTEN = re.compile(rf"\s*({_NUMBER})(?:\s*:\s*({_NUMBER}))?\s*(.*?)\s*$")


@dataclass(frozen=True)
class Limit:
    """Of an input, a state, or the rate of either, in its own unit.

    `length`: the greatest length of the vector; or `low` and `high` of each of its numbers.
    """

    of: str
    rate: bool
    unit: str
    length: float | None = None
    low: float = -np.inf
    high: float = np.inf

    @property
    def name(self) -> str:
        """As it is typed."""
        return f"{RATE}{self.of}" if self.rate else self.of

    @property
    def size(self) -> float:
        """How large a number of it may be."""
        return self.length or max(abs(self.low), abs(self.high))

    def share(self, values: Array) -> float:
        """How much of what is allowed some values (N, size) take, at most; 1 is all of it."""
        if self.length is not None:
            return float(np.linalg.norm(values, axis=1).max() / self.length)
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        return float(np.abs(values - middle).max() / half)

    def within(self, share: float) -> Limit:
        """The same, so much narrower."""
        if self.length is not None:
            return Limit(self.of, self.rate, self.unit, self.length * share)
        middle, half = 0.5 * (self.low + self.high), 0.5 * share * (self.high - self.low)
        return Limit(self.of, self.rate, self.unit, None, middle - half, middle + half)

    def kept(self, values: Array) -> Array:
        """Values (N, size) brought back to within it."""
        if self.length is None:
            return np.asarray(np.clip(values, self.low, self.high))
        norm = np.linalg.norm(values, axis=1, keepdims=True)
        return np.asarray(values * np.minimum(1.0, self.length / np.maximum(norm, 1e-300)))

    def __str__(self) -> str:
        """`omega at most 0.5 rad/s`."""
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        if self.length is not None:
            return f"{self.name} at most {self.length:.4g}{unit}"
        return f"{self.name} from {self.low:.4g} to {self.high:.4g}{unit}"


def limits_of(model: Dynamics, given: Sequence[tuple[str, str]]) -> tuple[Limit, ...]:
    """Limits as typed, `("rate of omega", "30 deg/s^2")`; every input has one.

    UsageError names what cannot be limited, is not understood, or has no limit.
    """
    found = tuple(_limit(model, name.strip(), text) for name, text in given)
    names = [limit.name for limit in found]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice:
        raise UsageError(f"--limit {twice}=… is given twice")
    free = [n for n in model.input_signals if n not in names]
    if free:
        unit = _units(model)[free[0]]
        raise UsageError(
            f"{model.name}: say how large {free[0]} may be, --limit '{free[0]}=MAX"
            f"{f' {unit}' if unit else ''}'; without a limit no motion is the best"
        )
    return found


def _units(model: Dynamics) -> dict[str, str]:
    """Unit of every input and state."""
    found = {s.name: s.unit for s in model.states}
    return found | {s.name: s.unit or "" for s in model.signals if s.name in model.input_signals}


def _limit(model: Dynamics, name: str, text: str) -> Limit:
    option = f"--limit '{name}={text}'"
    rate, of, known = name.startswith(RATE), name.removeprefix(RATE).strip(), _units(model)
    if of not in known:
        raise UsageError(
            f"{option}: {model.name} has {', '.join(known)} to limit, and the rate of each "
            f"('{RATE}{next(iter(known))}=…')"
        )
    said = _WRITTEN.fullmatch(text)
    if said is None:
        raise UsageError(f"{option}: write MAX, or LOW:HIGH, with a unit behind or none")
    own = per_second(known[of]) if rate else known[of]
    first, second = (None if x is None else _in_unit(option, float(x), said[3], own)
                     for x in (said[1], said[2]))  # fmt: skip
    assert first is not None
    if second is None:
        if not 0 < first < np.inf:
            raise UsageError(f"{option}: a limit is above zero, or LOW:HIGH")
        return Limit(of, rate, own, length=first)
    if not first < second:
        raise UsageError(f"{option}: {second:g} does not lie above {first:g}")
    return Limit(of, rate, own, None, first, second)


def _in_unit(option: str, value: float, unit: str, own: str) -> float:
    if not unit or unit == own:
        return value
    try:
        factor, offset = units.conversion(unit, own or "1")
    except CasestError as error:
        raise type(error)(f"{option}: {error}") from None
    return factor * value + offset
