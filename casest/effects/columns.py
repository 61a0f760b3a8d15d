"""Offsets and gains that follow a column: temperature, or any other that was recorded."""

from __future__ import annotations

from dataclasses import replace

from casest.declaration.effect import Effect, effect
from casest.declaration.physics import SX, dot, vertcat
from casest.declaration.shapes import each
from casest.declaration.symbols import constant, param, signal
from casest.effects.response import three_axes


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
    typical={"k": 2e-3, "bend": 1e-4},
    shown_by="the same input at three values of the channel or more",
    formula="y + k·(channel − at) + bend·(channel − at)²",
    columns={"channel": "temperature"},
    numbers={"at": "mean"},
)
def temperature_curve(
    y: SX,
    channel: SX,
    *,
    k: SX = param(each, "[y]/[channel]"),
    bend: SX = param(each, "[y]/[channel]^2"),
    at: SX = constant(0.0),
) -> SX:
    """An offset that follows temperature in a bent line, about its mean `at`."""
    x = channel - at
    return y + k * x + bend * x**2


@effect(
    on="input",
    typical={"k": 3e-4, "bend": 1e-5},
    shown_by="large inputs at three values of the channel or more",
    formula="u·(1 + k·(channel − at) + bend·(channel − at)²)",
    columns={"channel": "temperature"},
    numbers={"at": "mean"},
)
def temperature_gain_curve(
    u: SX,
    channel: SX,
    *,
    k: SX = param(each, "1/[channel]"),
    bend: SX = param(each, "1/[channel]^2"),
    at: SX = constant(0.0),
) -> SX:
    """A gain that follows temperature in a bent line, about its mean `at`."""
    x = channel - at
    return u * (1 + k * x + bend * x**2)


def _of_another(of_temperature: Effect, name: str, shown_by: str) -> Effect:
    """The same of a channel that is no temperature, for which no size is typical."""
    doc = of_temperature.doc.replace("temperature", "another recorded channel")
    return replace(of_temperature, name=name, doc=doc, columns=(("channel", "other"),), typical=(),
                   shown_by=shown_by)  # fmt: skip


channel_bias = _of_another(
    temperature_bias, "channel_bias", "the same input at two values of the channel"
)
channel_gain = _of_another(
    temperature_gain, "channel_gain", "large inputs at two values of the channel"
)
channel_curve = _of_another(temperature_curve, "channel_curve", temperature_curve.shown_by)
channel_gain_curve = _of_another(
    temperature_gain_curve, "channel_gain_curve", temperature_gain_curve.shown_by
)


@effect(
    on="output",
    typical={"k": 1e-4},
    shown_by="the gyro at rest, turned to several sides: gravity turns with it",
    formula="y + K·force, K of three rows: k[0] k[1] k[2]; k[3] k[4] k[5]; k[6] k[7] k[8]",
    columns={"force": "acceleration"},
)
def g_sensitivity(y: SX, force: SX = signal(3), *, k: SX = param(9, "[y]/[force]")) -> SX:
    """A gyro answers to specific force as well (IEEE Std 528: acceleration-sensitive drift)."""
    three_axes(y)
    return y + vertcat(*(dot(k[row : row + 3], force) for row in (0, 3, 6)))
