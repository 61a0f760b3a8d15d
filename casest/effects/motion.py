"""What moves: a wheel out of balance, its axle, its slowing down; vibration; sensor's place."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, cos, der, sin
from casest.declaration.shapes import each
from casest.declaration.symbols import constant, param, signal
from casest.effects.course import legendre

#: Frequency (rad/s) below which nothing shakes.
SHAKES = 0.6


@effect(
    on="angle",
    typical={"sine": 0.05, "cosine": 0.05},
    shown_by="a slow spin: the unevenness grows with the inverse square of the speed",
    formula="angle + (sine·sin(angle) + cosine·cos(angle))/rate²",
)
def imbalance(
    angle: SX,
    t: SX = signal("s"),
    *,
    sine: SX = param("rad/s^2"),
    cosine: SX = param("rad/s^2"),
) -> SX:
    """An eccentric mass speeds the wheel up and slows it down once per turn.

    angle″ = −κ·sin(angle + β), to second order in κ/rate²; sine = κ·cos β, cosine = κ·sin β.
    """
    rate2 = der(angle, t) ** 2
    a, b = sine / rate2, cosine / rate2
    s, c = sin(angle), cos(angle)
    twice = (a**2 - b**2) * 2 * s * c + 2 * a * b * (c**2 - s**2)
    return angle + a * s + b * c + twice / 8


@effect(
    on="input",
    typical={"cosine": 0.02, "sine": 0.02},
    shown_by="several turns at a speed that changes, so that it is no vibration",
    formula="u + cosine·cos(2·angle) + sine·sin(2·angle)",
)
def axis_wobble(
    u: SX, angle: SX, *, cosine: SX = param(each, "[u]"), sine: SX = param(each, "[u]")
) -> SX:
    """The axle tumbles: what it adds comes twice per turn (once per turn is the mounting's)."""
    return u + cosine * cos(2 * angle) + sine * sin(2 * angle)


@effect(
    on="angle",
    typical={"c": 0.05},
    shown_by="a record short enough for the declared speed law",
    formula="angle + Σ c[k]·P[k+5](2·t/duration − 1), P Legendre's polynomials",
    numbers={"duration": "duration"},
)
def speed_polynomial(
    angle: SX,
    t: SX = signal("s"),
    *,
    c: SX = param(4, "rad", per="run"),
    duration: SX = constant(1.0, "s"),
) -> SX:
    """Higher terms of the speed law: degrees 5 to 8 in the angle (drag is no cubic)."""
    course = legendre(t, duration, 8)[5:]
    return angle + sum(c[k] * p for k, p in enumerate(course))


@effect(
    on="input",
    typical={"arm": 2e-3},
    shown_by="two speeds: it grows with the square of the rate",
    formula="u + arm·rate²",
)
def lever_arm(u: SX, angle: SX, t: SX = signal("s"), *, arm: SX = param(each, "m")) -> SX:
    """Each axis senses at a place of its own, `arm` away along it: rate²·arm."""
    return u + arm * der(angle, t) ** 2


@effect(
    on="output",
    typical={"sine": 0.02, "cosine": 0.02},
    profile={"frequency": "frequency"},
    shown_by="a record with the machine beside it switched off",
    formula="y + sine·sin(frequency·t) + cosine·cos(frequency·t)",
    once="passed",
)
def vibration(
    y: SX,
    t: SX = signal("s"),
    *,
    sine: SX = param(each, "[y]"),
    cosine: SX = param(each, "[y]"),
    frequency: SX = param("rad/s", bounds=(SHAKES, None)),
) -> SX:
    """A line in the spectrum that belongs to no declared motion.

    Once in ten seconds or faster: what is slower is a course, a load that is cycled, a day.
    """
    return y + sine * sin(frequency * t) + cosine * cos(frequency * t)
