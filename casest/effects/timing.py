"""When a sensor answers: delays, lags, memory. Small against a period of the motion."""

from __future__ import annotations

from casest.declaration.effect import RECORDED, effect
from casest.declaration.physics import SX, der, exp, fabs, fmax, fmin, sqrt
from casest.declaration.shapes import each
from casest.declaration.symbols import param, signal

#: Time (s) in which a reading with hysteresis turns round, far below a sample's.
TURN = 1e-3
#: Time (s) below which none is told from zero.
SHORTEST = 1e-9


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
    kind="sequence",
    profile={"tau": "memory"},
    memory={"rate": 0.0, "before": "y"},
    formula="y − tau·lowpass(dy/dt, tau)",
)
def _filtered(y: SX, rate: SX, before: SX, dt: SX, *, tau: SX = param("s")) -> tuple[SX, ...]:
    """A first-order filter with time constant tau on all axes, run through the record.

    Exact for a reading that is straight between samples. What is left out is tau times the rate
    of what comes out, which is the rate of what goes in, filtered alike: at tau = 0 the difference
    of two samples, so that the slope there is right. A lag below zero is a lead, to first order.
    """
    a = exp(-dt / fmax(fabs(tau), SHORTEST))
    rate = a * rate + (1 - a) * (y - before) / fmax(dt, SHORTEST)
    return y - tau * rate, rate, y


@effect(
    on="output",
    typical={"tau": 5e-3},
    shown_by="the same motion at two speeds: a lag shrinks the faster one, a delay does not",
    formula="y − tau·dy/dt + tau²·d²y/dt²",
    otherwise=_filtered,
)
def low_pass(y: SX, t: SX = signal("s"), *, tau: SX = param("s")) -> SX:
    """A first-order filter with time constant tau on all axes.

    Series to second order where the model knows how fast its reading changes; elsewhere the filter
    itself, run through the record.
    """
    rate = der(y, t)
    return y - tau * rate + tau**2 * der(rate, t)


@effect(
    on="output",
    kind="sequence",
    typical={"k": 5e-3},
    profile={"tau": "timescale"},
    shown_by="a step of the input, held for several times tau",
    formula="y − k·(y − lowpass(y, tau))",
    memory={"gap": 0.0, "before": "y"},
    # A response that comes late as a whole is a low pass, and more than all of one is delayed, or
    # late twice; between samples nobody knows how the input went, which looks like a lead of a few
    # hundredths. Nor too early.
    within={"k": (-1.0, 0.9)},
    # A spring gives way slowly, and heat arrives slowly: a field, a turn, a proof mass do neither.
    foreign_to=("T", "rad/s", "m/s^2"),
)
def creep(
    y: SX,
    gap: SX,
    before: SX,
    dt: SX,
    *,
    k: SX = param(each),
    tau: SX = param("s", start=10.0, bounds=(0.0, None)),
) -> tuple[SX, ...]:
    """A part k of each axis' response comes late, with the time constant tau (creep, slow warming).

    Exact for a reading that is straight between samples; each stretch of a record begins at rest.
    """
    tau = fmax(tau, SHORTEST)
    a = exp(-dt / tau)
    gap = a * gap + (1 - a) * tau * (y - before) / fmax(dt, SHORTEST)
    return y - k * gap, gap, y


@effect(
    on="output",
    kind="sequence",
    profile={"turn": "share"},
    memory={"middle": "y"},
    formula="y − k·(y − play(y, w))/w, w = turn·span/2",
)
def _looped(
    y: SX,
    middle: SX,
    span: SX,
    *,
    k: SX = param(each, "[y]"),
    turn: SX = param(start=0.02, bounds=(1e-3, 0.5)),
) -> tuple[SX, ...]:
    """A reading that lags behind by k, whichever way it moved last, run through the record.

    It turns round over the part `turn` of the record's span (Prandtl's element: sharp for a small
    one, play where it is 2k): what moves less, as noise does, switches nothing.
    """
    half = fmax(turn * span / 2, 1e-12)
    middle = fmin(fmax(middle, y - half), y + half)
    return y - k * (y - middle) / half, middle


@effect(
    on="output",
    typical={"k": 0.02},
    shown_by="the same input approached from above and from below",
    formula="y − k·sign(dy/dt)",
    otherwise=_looped,
    foreign_to=("rad/s",),  # turned one way or the other, a gyroscope comes back to where it was
)
def hysteresis(y: SX, t: SX = signal("s"), *, k: SX = param(each, "[y]")) -> SX:
    """A reading that lags behind by k, whichever way it moves: a loop 2k high.

    It turns round within TURN: a jump has no derivative, and when it turns depends on parameters.
    Where nothing says how fast it changes, it follows the record, and turns over the part `turn` of
    its span: that is fitted too.
    """
    rate = der(y, t)
    return y - k * rate / sqrt(rate**2 + (TURN * der(rate, t)) ** 2 + 1e-12)


@effect(
    on=RECORDED,
    kind="time",
    typical={"delay": 1e-2},
    profile={"delay": "lag"},
    shown_by="a quick turn from rest, seen by both instruments",
    formula="x(t − delay)",
)
def signal_lag(t: SX, *, delay: SX = param("s")) -> SX:
    """The reading answers another instrument's signal `delay` later: it goes with x(t − delay).

    For any recorded signal but the time and what is measured: an attitude, a current, a reference.
    Below zero it is the signal that was recorded late.
    """
    return t - delay
