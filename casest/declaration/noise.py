"""Noise that was stated: a residual in units of it, with the true values of the signals beside.

Every noisy signal s has a true value ξ, for which the residual r(x, ξ) vanishes, and the likeliest
ξ take Σ(s - ξ)ᵀC⁻¹(s - ξ) as small as that lets it be. To first order around an estimate of ξ the
residual is w = r(x, ξ) + G(s - ξ) with G = ∂r/∂ξ, of covariance V = GCGᵀ, and the likeliest ξ is
s - CGᵀV⁻¹w. Where x makes Σ|e|² least, e = V^(-1/2)w with ξ, G and V held, and ξ, G and V are those
at x, the gradient in all unknowns and all true values together is zero (Gauss & Helmert; P. Boggs,
R. Byrd, R. Schnabel, 1987). Predicted readings and implicit relations go the same way. Each sample
has a small matrix of its own; nothing grows with the record. Held, the matrices cannot be made
large to make a residual small.

Of an implicit relation w has a mean b that is not zero where the relation bends (a norm of noisy
readings is too long): it is taken off, so that the estimate is right to second order of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import casadi as ca

from casest.declaration.physics import SX
from casest.declaration.symbols import Signal
from casest.declaration.tracing import Traced, flat

#: What a sample holds: V^(-1/2), G, ξ of its noisy signals, b; and of each the root of C.
WHITENING, SLOPE, TRUE, MEAN = "noise.whitening", "noise.slope", "noise.true", "noise.mean"
ROOT = "noise.root."


@dataclass(frozen=True)
class Stated:
    """Noise of each sample is known of these `signals`, in the model's order.

    `residuals` is their number m, `scale` a usual residual's standard deviation: so a residual in
    units of its noise stays one in the unit of the reading. `groups`: signals whose noise is
    correlated stand together, in the order of `signals`; empty where each is for itself. `as_read`:
    e = V^(-1/2)r(x, s), at the readings themselves: to look for what is missing.
    """

    signals: tuple[str, ...]
    residuals: int
    # No part of the relation: what was built for one record serves the next, of other noise.
    scale: float = field(default=1.0, compare=False)
    groups: tuple[tuple[str, ...], ...] = ()
    as_read: bool = False

    @property
    def together(self) -> tuple[tuple[str, ...], ...]:
        """Every signal, with those that its noise is correlated with."""
        return self.groups or tuple((name,) for name in self.signals)

    def columns(self, signals: Mapping[str, Signal]) -> tuple[Signal, ...]:
        """What a sample holds of it behind the signals: (m²,), (m·k,), (k,), (m,), row by row."""
        k, m = sum(signals[name].size for name in self.signals), self.residuals
        sizes = {WHITENING: m * m, SLOPE: m * k, TRUE: k, MEAN: m}
        return tuple(Signal(name, size, None) for name, size in sizes.items())


def root_of(group: tuple[str, ...]) -> str:
    """Where a sample holds the root of the covariance of the noise of signals together."""
    return ROOT + ",".join(group)


def in_units_of_noise(traced: Traced, noise: Stated) -> Traced:
    """The trace with its residual divided by what the stated noise makes of it."""
    m, w, stages = noise.residuals, traced.expression, traced.stages
    whitening = ca.reshape(traced.symbols[WHITENING], m, m).T
    if not noise.as_read:
        # A signal at another time is read there, and has a true value there.
        late = {s.attached.on: s.given for s in stages if s.attached and s.attached.kind == "time"}
        reading = ca.vertcat(*[late.get(n, flat(traced.symbols[n])) for n in noise.signals])
        slope, true = ca.reshape(traced.symbols[SLOPE], reading.numel(), m).T, traced.symbols[TRUE]
        w = ca.substitute(w, reading, true) + slope @ (reading - true) - traced.symbols[MEAN]
        # What looks at other samples takes true values there: their noise is in G(s - ξ) once.
        stages = tuple(replace(s, taken=ca.substitute(s.taken, reading, true)) for s in stages)
    return replace(traced, expression=ca.densify(ca.tril(whitening) @ w), stages=stages)


def at_true(traced: Traced, noise: Stated, value: SX) -> SX:
    """A value of the trace at the true values of its noisy signals."""
    reading = ca.vertcat(*[flat(traced.symbols[name]) for name in noise.signals])
    return ca.substitute(value, reading, traced.symbols[TRUE])


def slope_in_noisy(traced: Traced, names: tuple[str, ...]) -> SX:
    """G = ∂r/∂s of a trace without stated noise, (m, k)."""
    return ca.jacobian(traced.expression, ca.vertcat(*[flat(traced.symbols[n]) for n in names]))
