"""Offsets that change: with time, at an event, after switching on."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, exp, inf
from casest.declaration.shapes import each
from casest.declaration.symbols import param, signal


@effect(
    on="output",
    typical={"k": 1e-4},
    shown_by="the first pose repeated at the end of the record, at the temperature of its start",
    formula="y + k·t",
    once="stayed",
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
    once="stayed",
)
def bias_step(
    y: SX, t: SX = signal("s"), *, k: SX = param(each, "[y]"), when: SX = param("s")
) -> SX:
    """An offset that jumps at one moment: a knock, a change of range."""
    return y + k * (t > when)


@effect(
    on="output",
    typical={"k": 0.02},
    profile={"start": "time", "stop": "time"},
    shown_by="the same pose before, during and after the event",
    formula="y + k from t = start on, until t = stop",
    once="passed",
)
def pulse(
    y: SX,
    t: SX = signal("s"),
    *,
    k: SX = param(each, "[y]"),
    start: SX = param("s"),
    stop: SX = param("s"),
) -> SX:
    """An offset between two moments: a magnet that comes and goes, a motor that runs."""
    return y + k * (t > start) * (t <= stop)


@effect(
    on="output",
    typical={"k": 0.02},
    profile={"tau": "timescale"},
    null={"tau": inf},
    shown_by="the first pose repeated: soon after switching on, and when it has long been on",
    formula="y + k·exp(−t/tau)",
)
def warm_up(y: SX, t: SX = signal("s"), *, k: SX = param(each, "[y]"), tau: SX = param("s")) -> SX:
    """An offset that dies away from the start of the record: what settles after switching on."""
    return y + k * exp(-t / tau)
