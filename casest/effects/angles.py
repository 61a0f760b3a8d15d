"""What comes once or twice for each turn of a recorded angle."""

from __future__ import annotations

from typing import Any

from casest.declaration.effect import effect
from casest.declaration.physics import SX, cos, sin
from casest.declaration.shapes import each
from casest.declaration.symbols import constant, param

_OF_AN_ANGLE: dict[str, Any] = {
    "on": "output",
    "typical": {"cosine": 0.02, "sine": 0.02},
    "shown_by": "readings all round, at a speed that changes: what is not the angle's does not "
    "follow",
    "columns": {"channel": "angle"},
    "numbers": {"radian": "radian"},
}


@effect(**_OF_AN_ANGLE, formula="y + cosine·cos(radian·channel) + sine·sin(radian·channel)")
def harmonic(
    y: SX,
    channel: SX,
    *,
    cosine: SX = param(each, "[y]"),
    sine: SX = param(each, "[y]"),
    radian: SX = constant(1.0, "rad/[channel]"),
) -> SX:
    """Something comes once per turn: an eccentric axle, gravity or a field that turns with it."""
    turned = radian * channel
    return y + cosine * cos(turned) + sine * sin(turned)


@effect(**_OF_AN_ANGLE, formula="y + cosine·cos(2·radian·channel) + sine·sin(2·radian·channel)")
def second_harmonic(
    y: SX,
    channel: SX,
    *,
    cosine: SX = param(each, "[y]"),
    sine: SX = param(each, "[y]"),
    radian: SX = constant(1.0, "rad/[channel]"),
) -> SX:
    """Something comes twice per turn: an ellipse for a circle, a shaft with an angle in it."""
    turned = 2 * radian * channel
    return y + cosine * cos(turned) + sine * sin(turned)
