"""Do the units of an estimator in motion fit together? As those of a model do.

The rate of a state comes out in its unit per second, an output in that of its reading, a constraint
in any.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from casest.declaration.dimensions import (
    PLAIN,
    Size,
    followed_through,
    named,
    refuse_unless_fits,
    size_of,
)
from casest.declaration.temperatures import of_symbol
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics, traced_with
from casest.dynamics.equations import with_units


def check_units(model: Dynamics) -> None:
    """Raise UnitError where units contradict each other: names the symbols on both sides.

    A declaration that has no unit at all has none to check: its time has none either.
    """
    if not with_units(model):
        return
    model = replace(model, states=tuple(replace(s, unit=s.unit or "1") for s in model.states))
    symbols = {c.name: ca.SX.sym(c.name, *c.dims) for c in model.constants}
    t = traced_with(model, symbols)
    inputs = [
        t.x,
        *(flat(t.symbols[s.name]) for s in model.signals),
        *map(ca.vec, symbols.values()),
    ]
    f = ca.Function("units", inputs, [ca.densify(e) for e in (t.f, t.h, ca.densify(t.g))])
    place = f"dynamics {model.name}"
    rates, outputs, _ = followed_through(f, _inputs(model), place)
    constant = [s.of is not None for s in model.states for _ in range(s.size)]
    for name, unit, found, fixed in zip(
        model.names, model.state_units, rates, constant, strict=True
    ):
        if fixed:
            continue
        where = f"{place}: the rate of {name} [{unit}]"
        refuse_unless_fits(found, size_of(f"({unit})/s", {}), where)
    signals = {s.name: s for s in model.signals}
    of_reading = [n for n, o in zip(t.measured, t.outputs, strict=True)
                  for _ in range(o.predicted.numel())]  # fmt: skip
    for name, found in zip(of_reading, outputs, strict=True):
        if (declared := signals[name].unit) is not None:
            where = f"{place}: the prediction of {name} [{declared}]"
            refuse_unless_fits(found, size_of(declared, {}), where)


def _inputs(model: Dynamics) -> dict[tuple[int, int], Size]:
    """Size of every number that goes in; a signal of any unit fits anything."""
    found = {(0, i): _sized(name, unit, signal=False) for i, (name, unit) in
             enumerate(zip(model.names, model.state_units, strict=True))}  # fmt: skip
    for k, s in enumerate(model.signals):
        for i in range(s.size):
            any_unit = s.unit is None and s.kind != "rotation"
            found[1 + k, i] = PLAIN if any_unit else _sized(s.name, s.unit or "", signal=True)
    for k, c in enumerate(model.constants):
        for i in range(c.array.size):
            found[1 + len(model.signals) + k, i] = (
                _sized(c.name, c.unit, signal=False) if c.unit else PLAIN
            )
    return found


def _sized(name: str, unit: str, *, signal: bool) -> Size:
    own = named(size_of(unit or "1", {}), name, unit)
    return replace(own, zero=of_symbol(unit, signal=signal, free=True, number=None))
