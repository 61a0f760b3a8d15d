"""What the rate of a state may lack: damping, friction, what drives it.

Each acts on the rate of any state that follows differential equations, but for rates that are
another state by definition (the rate of an angle that is a speed).
"""

from __future__ import annotations

from casest.declaration.effect import RATES, effect
from casest.declaration.physics import SX, fabs, sign
from casest.declaration.shapes import each
from casest.declaration.symbols import param, signal


@effect(
    on=RATES,
    columns={"x": "itself"},
    shown_by="a decay from a small state",
    formula="rate − k·x",
)
def linear_damping(r: SX, x: SX = signal(), *, k: SX = param(each, "[r]/[x]")) -> SX:
    """Viscous friction, or a leak: a state decays in proportion to itself."""
    return r - k * x


@effect(
    on=RATES,
    columns={"x": "itself"},
    shown_by="decays from a small and from a large state",
    formula="rate − k·x·|x|",
)
def quadratic_damping(r: SX, x: SX = signal(), *, k: SX = param(each, "[r]/([x])^2")) -> SX:
    """Drag of air or water at speed: a state decays with its square."""
    return r - k * x * fabs(x)


@effect(
    on=RATES,
    columns={"x": "itself"},
    shown_by="the end of a decay, until rest",
    formula="rate − k·sign(x)",
)
def dry_friction(r: SX, x: SX = signal(), *, k: SX = param(each, "[r]")) -> SX:
    """Dry friction: as large at every speed, against it (C. Coulomb, 1785)."""
    return r - k * sign(x)


@effect(on=RATES, shown_by="the place where it comes to rest", formula="rate + k")
def steady_drive(r: SX, *, k: SX = param(each, "[r]")) -> SX:
    """Something that drives a state steadily: a source, a slope, a wrong zero."""
    return r + k


@effect(
    on=RATES,
    columns={"other": "state"},
    shown_by="a record in which the other state moves by itself",
    formula="rate + k·other",
)
def coupling(r: SX, other: SX = signal(), *, k: SX = param(each, "[r]/[other]")) -> SX:
    """Another state drives this one in proportion."""
    return r + k * other


@effect(
    on=RATES,
    columns={"channel": "any"},
    shown_by="a record in which the column moves by itself",
    formula="rate + k·channel",
)
def forcing(r: SX, channel: SX, *, k: SX = param(each, "[r]/[channel]")) -> SX:
    """What was recorded beside the model drives a state in proportion."""
    return r + k * channel
