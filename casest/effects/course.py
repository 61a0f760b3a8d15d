"""Courses of time: smooth, as sums of Legendre's polynomials over the record, or from a time on."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, fmax
from casest.declaration.shapes import each
from casest.declaration.symbols import constant, param, signal


def legendre(t: SX, duration: SX, highest: int) -> list[SX]:
    """P[0] to P[highest] over a record from 0 to duration: powers could not be told apart."""
    x = 2 * t / duration - 1
    found = [x**0, x]
    for n in range(2, highest + 1):
        found.append(((2 * n - 1) * x * found[-1] - (n - 1) * found[-2]) / n)
    return found


@effect(
    on="input",
    typical={"c": 1e-3},
    shown_by="a second sensor beside it, turned another way: both see the reference sway alike",
    formula="u·(1 + Σ c[k]·P[k+1](2·t/duration − 1)), P Legendre's polynomials",
    numbers={"duration": "duration"},
    describes=True,
)
def reference_wander(
    u: SX,
    t: SX = signal("s"),
    *,
    c: SX = param(6, per="run"),
    duration: SX = constant(1.0, "s"),
) -> SX:
    """The known reference sways: its size follows a smooth course, the same on all axes.

    What it adds goes with the direction of the reference; an offset's error does not.
    """
    course = legendre(t, duration, 6)[1:]
    return u * (1 + sum(c[k] * p for k, p in enumerate(course)))


@effect(
    on="output",
    typical={"c1": 0.01, "c2": 0.01, "c3": 0.01, "c4": 0.01, "c5": 0.01, "c6": 0.01},
    shown_by="the same pose again and again through the record",
    formula="y + Σ ck·P[k](2·t/duration − 1), P Legendre's polynomials",
    numbers={"duration": "duration"},
    describes=True,
)
def bias_course(
    y: SX,
    t: SX = signal("s"),
    *,
    c1: SX = param(each, "[y]", per="run"),
    c2: SX = param(each, "[y]", per="run"),
    c3: SX = param(each, "[y]", per="run"),
    c4: SX = param(each, "[y]", per="run"),
    c5: SX = param(each, "[y]", per="run"),
    c6: SX = param(each, "[y]", per="run"),
    duration: SX = constant(1.0, "s"),
) -> SX:
    """The offset of each axis follows a smooth course of its own, for whatever reason."""
    course = legendre(t, duration, 6)[1:]
    return y + sum(c * p for c, p in zip((c1, c2, c3, c4, c5, c6), course, strict=True))


@effect(
    on="output",
    typical={"k": 0.01},
    profile={"begin": "onset"},
    shown_by="the same pose again and again through the record",
    formula="y + k·max(t − begin, 0)",
    describes=True,
)
def bias_ramp(
    y: SX, t: SX = signal("s"), *, k: SX = param(each, "[y]/s"), begin: SX = param("s")
) -> SX:
    """The offset grows from a moment on: something warms, or a field fades.

    A jump that it foretells as well is none.
    """
    return y + k * fmax(t - begin, 0)
