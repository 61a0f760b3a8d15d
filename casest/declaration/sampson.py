"""An implicit residual with effects in it, still in the unit of its readings.

What an implicit residual says of a sample is how far the readings are from satisfying the model,
to first order: an expression that would vanish, over its slope in the readings (Sampson 1982). The
body divides by the slope that it knows, its own. An effect on the way changes the slope, and where
that is not divided by as well, effects that make it smaller look as if they explained the residual:
they contract the noise. So a residual with effects is divided by what they do to its slope.

Readings are the signals that the body declares, but for time and attitude, which are exact; so
are columns that only effects read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from casest.declaration.physics import SX
from casest.declaration.tracing import Declared, Traced, flat, reached_signals, reading_symbol

#: The slope is taken to fall to this share of the declared one, at most: a residual that no longer
#: sees its reading (beyond saturation) stays finite.
LEAST = 1e-3
#: Keeps a slope that is zero from being divided by.
NONE = 1e-300


def sampson(model: Declared, traced: Traced, straight: Traced) -> Traced:
    """The trace with its residual in units of the readings; as it is, where no slope is changed.

    `straight` is the trace in which effects let changes of what they act on pass as they are.
    """
    reading = reading_symbol(model, straight)
    if not any(ca.depends_on(ca.vec(change), reading) for _, change in straight.steps):
        return traced
    # A signal that the body does not read, and an effect does, is exact like a column.
    seen = reached_signals(model, straight, straight.expression)
    names = [s.name for s in model.readings if s.name in seen]
    own = _squares(straight, names)
    for step, change in reversed(straight.steps):
        own = ca.substitute(own, ca.vec(step), ca.densify(ca.vec(change)))
    own = ca.substitute(own, _symbols(model, straight), _symbols(model, traced))
    factor = _ratio(own, _squares(traced, names))
    return replace(traced, expression=ca.densify(traced.expression * factor))


def _squares(traced: Traced, names: Sequence[str]) -> SX:
    """Squared length of every residual's slope in each of these signals, (m, signals)."""
    slopes = [ca.jacobian(traced.expression, flat(traced.symbols[name])) for name in names]
    return ca.densify(ca.horzcat(*[ca.sum2(slope**2) for slope in slopes]))


def _ratio(own: SX, changed: SX) -> SX:
    """Slope of each residual in the noise of all signals together, declared over changed, (m,)."""
    # A signal's noise is what the residual that sees it best makes of it.
    best = own[0, :] + NONE
    for i in range(1, own.size1()):
        best = ca.fmax(best, own[i, :])
    best = ca.repmat(best, own.size1(), 1)
    seen, left = ca.sum2(own / best) + NONE, ca.sum2(changed / best)
    return ca.sqrt(seen / ca.fmax(left, LEAST**2 * seen))


def _symbols(model: Declared, traced: Traced) -> SX:
    """All that an expression of the trace is made of."""
    signals = [flat(traced.symbols[s.name]) for s in model.columns]
    return ca.vertcat(traced.coordinates, traced.references, *signals)
