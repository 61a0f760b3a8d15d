"""When a sensor answers: delays, lags, memory. Small against a period of the motion."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, der, sqrt
from casest.declaration.shapes import each
from casest.declaration.symbols import param, signal

#: Time (s) in which a reading with hysteresis turns round, far below a sample's.
TURN = 1e-3


@effect(
    on="t",
    typical={"delay": 5e-3},
    shown_by="an independent mark of the time (a knock seen by two sensors)",
    formula="t − delay",
)
def time_delay(t: SX, *, delay: SX = param("s")) -> SX:
    """All readings are stamped late by `delay`."""
    return t - delay


@effect(
    on="output",
    typical={"delay": 2e-3},
    shown_by="motion that changes quickly, with axes to compare",
    formula="y(t − delay)",
)
def axis_delay(y: SX, t: SX = signal("s"), *, delay: SX = param(each, "s")) -> SX:
    """Each axis is read late by its own delay (Taylor series to second order)."""
    rate = der(y, t)
    return y - delay * rate + delay**2 / 2 * der(rate, t)


@effect(
    on="output",
    typical={"tau": 5e-3},
    shown_by="the same motion at two speeds: a lag shrinks the faster one, a delay does not",
    formula="y − tau·dy/dt + tau²·d²y/dt²",
)
def low_pass(y: SX, t: SX = signal("s"), *, tau: SX = param("s")) -> SX:
    """A first-order filter with time constant tau on all axes (series to second order)."""
    rate = der(y, t)
    return y - tau * rate + tau**2 * der(rate, t)


@effect(
    on="output",
    typical={"k": 0.02},
    shown_by="the same input approached from above and from below",
    formula="y − k·sign(dy/dt)",
)
def hysteresis(y: SX, t: SX = signal("s"), *, k: SX = param(each, "[y]")) -> SX:
    """A reading that lags behind by k, whichever way it moves.

    It turns round within TURN: a jump has no derivative, and when it turns depends on parameters.
    """
    rate = der(y, t)
    return y - k * rate / sqrt(rate**2 + (TURN * der(rate, t)) ** 2 + 1e-12)
