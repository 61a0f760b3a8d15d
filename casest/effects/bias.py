"""Offsets and gains that change: with time, at an event, with temperature, with any channel."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX
from casest.declaration.shapes import each
from casest.declaration.symbols import constant, param, signal


@effect(
    on="output",
    typical={"k": 1e-4},
    shown_by="the first pose repeated at the end of the record, at the temperature of its start",
    formula="y + k·t",
)
def bias_drift(y: SX, t: SX = signal("s"), *, k: SX = param(each, "[y]/s")) -> SX:
    """An offset that drifts linearly in time."""
    return y + k * t


@effect(
    on="output",
    typical={"k": 0.02},
    profile={"when": "time"},
    shown_by="the same pose before and after the event",
    formula="y + k from t = when on",
)
def bias_step(
    y: SX, t: SX = signal("s"), *, k: SX = param(each, "[y]"), when: SX = param("s")
) -> SX:
    """An offset that jumps at one moment: a knock, a change of range."""
    return y + k * (t > when)


@effect(
    on="output",
    typical={"k": 2e-3},
    shown_by="the same pose at two temperatures, not rising with time alone",
    formula="y + k·(channel − at)",
    columns={"channel": "temperature"},
    numbers={"at": "mean"},
)
def temperature_bias(
    y: SX, channel: SX, *, k: SX = param(each, "[y]/[channel]"), at: SX = constant(0.0)
) -> SX:
    """An offset that follows temperature, about its mean `at`."""
    return y + k * (channel - at)


@effect(
    on="input",
    typical={"k": 3e-4},
    shown_by="large inputs at two temperatures, not rising with time alone",
    formula="u·(1 + k·(channel − at))",
    columns={"channel": "temperature"},
    numbers={"at": "mean"},
)
def temperature_gain(
    u: SX, channel: SX, *, k: SX = param(each, "1/[channel]"), at: SX = constant(0.0)
) -> SX:
    """A gain that follows temperature, about its mean `at`."""
    return u * (1 + k * (channel - at))


@effect(
    on="output",
    shown_by="the same input at two values of the channel",
    formula="y + k·(channel − at)",
    columns={"channel": "other"},
    numbers={"at": "mean"},
)
def channel_bias(
    y: SX, channel: SX, *, k: SX = param(each, "[y]/[channel]"), at: SX = constant(0.0)
) -> SX:
    """An offset that follows another recorded channel, about its mean `at`."""
    return y + k * (channel - at)


@effect(
    on="input",
    shown_by="large inputs at two values of the channel",
    formula="u·(1 + k·(channel − at))",
    columns={"channel": "other"},
    numbers={"at": "mean"},
)
def channel_gain(
    u: SX, channel: SX, *, k: SX = param(each, "1/[channel]"), at: SX = constant(0.0)
) -> SX:
    """A gain that follows another recorded channel, about its mean `at`."""
    return u * (1 + k * (channel - at))


@effect(
    on="input",
    typical={"k": 1e-6},
    shown_by="the same pose at the beginning and at the end, for large and small inputs",
    formula="u·(1 + k·t)",
)
def reference_drift(u: SX, t: SX = signal("s"), *, k: SX = param("1/s")) -> SX:
    """The known reference (field, gravity, table) changes size with time."""
    return u * (1 + k * t)
