"""Offsets and gains over a whole range of a column: cubics and tables, which one has to ask for.

The loop does not try them: a curve of five numbers finds something in many residuals.
"""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, fabs, fmax, fmin
from casest.declaration.shapes import each
from casest.declaration.symbols import constant, param

#: Nodes of a table, evenly over the range of the column; the offset, or a gain of one, is its
#: middle one.
NODES = 5


@effect(
    on="output",
    typical={"k": 2e-3, "bend": 1e-4, "twist": 1e-6},
    shown_by="the same input at four values of the channel or more",
    formula="y + k·(channel − at) + bend·(channel − at)² + twist·(channel − at)³",
    columns={"channel": "temperature"},
    numbers={"at": "mean"},
)
def temperature_cubic(
    y: SX,
    channel: SX,
    *,
    k: SX = param(each, "[y]/[channel]"),
    bend: SX = param(each, "[y]/[channel]^2"),
    twist: SX = param(each, "[y]/[channel]^3"),
    at: SX = constant(0.0),
) -> SX:
    """An offset that follows temperature in a cubic, about its mean `at`."""
    x = channel - at
    return y + x * (k + x * (bend + x * twist))


@effect(
    on="input",
    typical={"k": 3e-4, "bend": 1e-5, "twist": 1e-7},
    shown_by="large inputs at four values of the channel or more",
    formula="u·(1 + k·(channel − at) + bend·(channel − at)² + twist·(channel − at)³)",
    columns={"channel": "temperature"},
    numbers={"at": "mean"},
)
def temperature_gain_cubic(
    u: SX,
    channel: SX,
    *,
    k: SX = param(each, "1/[channel]"),
    bend: SX = param(each, "1/[channel]^2"),
    twist: SX = param(each, "1/[channel]^3"),
    at: SX = constant(0.0),
) -> SX:
    """A gain that follows temperature in a cubic, about its mean `at`."""
    x = channel - at
    return u * (1 + x * (k + x * (bend + x * twist)))


def _in_table(channel: SX, low: SX, high: SX, *values: SX) -> SX:
    """Straight lines between values at even steps from `low` to `high`, the end's beyond."""
    place = (NODES - 1) * (channel - low) / (high - low)
    inside = fmin(fmax(place, 0), NODES - 1)
    nodes = (0, 1, 3, 4)  # the middle one is none: the offset
    return sum(v * fmax(0, 1 - fabs(inside - n)) for v, n in zip(values, nodes, strict=True))


@effect(
    on="output",
    typical={"coldest": 2e-2, "cold": 1e-2, "warm": 1e-2, "warmest": 2e-2},
    shown_by="the same input all over the channel's range",
    formula="y + straight lines between coldest, cold, 0, warm, warmest, from low to high",
    columns={"channel": "temperature"},
    numbers={"low": "least", "high": "greatest"},
)
def temperature_table(
    y: SX,
    channel: SX,
    *,
    coldest: SX = param(each, "[y]"),
    cold: SX = param(each, "[y]"),
    warm: SX = param(each, "[y]"),
    warmest: SX = param(each, "[y]"),
    low: SX = constant(0.0, "[channel]"),
    high: SX = constant(1.0, "[channel]"),
) -> SX:
    """An offset as a table over temperature: what it adds at five even steps of the range."""
    return y + _in_table(channel, low, high, coldest, cold, warm, warmest)


@effect(
    on="input",
    typical={"coldest": 2e-3, "cold": 1e-3, "warm": 1e-3, "warmest": 2e-3},
    shown_by="large inputs all over the channel's range",
    formula="u·(1 + straight lines between coldest, cold, 0, warm, warmest, from low to high)",
    columns={"channel": "temperature"},
    numbers={"low": "least", "high": "greatest"},
)
def temperature_gain_table(
    u: SX,
    channel: SX,
    *,
    coldest: SX = param(each),
    cold: SX = param(each),
    warm: SX = param(each),
    warmest: SX = param(each),
    low: SX = constant(0.0, "[channel]"),
    high: SX = constant(1.0, "[channel]"),
) -> SX:
    """A gain as a table over temperature: what it adds at five even steps of the range."""
    return u * (1 + _in_table(channel, low, high, coldest, cold, warm, warmest))
