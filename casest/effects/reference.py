"""What the sensor is compared with: its size, the table's angles."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, atan2, cos, horzcat, sin, vertcat
from casest.declaration.symbols import param, signal


@effect(
    on="attitude",
    typical={"cosine": 1e-4, "sine": 1e-4},
    shown_by="the same attitude reached by other angles of the table",
    formula="turned about the outer axis by cosine·cos(yaw) + sine·sin(yaw)",
)
def table_angle(attitude: SX, *, cosine: SX = param("rad"), sine: SX = param("rad")) -> SX:
    """The table's outer angle is wrong by a first harmonic: an eccentric encoder."""
    yaw = atan2(attitude[1, 0], attitude[0, 0])
    off = cosine * cos(yaw) + sine * sin(yaw)
    c, s = cos(off), sin(off)
    turn = vertcat(horzcat(c, -s, 0), horzcat(s, c, 0), horzcat(0, 0, 1))
    return turn @ attitude


@effect(
    on="input",
    typical={"k": 1e-6},
    shown_by="the same pose at the beginning and at the end, for large and small inputs",
    formula="u·(1 + k·t)",
    once="stayed",
)
def reference_drift(u: SX, t: SX = signal("s"), *, k: SX = param("1/s")) -> SX:
    """The known reference (field, gravity, table) changes size with time."""
    return u * (1 + k * t)
