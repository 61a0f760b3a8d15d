"""An effect on some of its axes only: the others are held at null and cost nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca

from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Shape
from casest.declaration.symbols import Parameter, Undecided, make_parameter


def restricted(effect: Effect, kept: Sequence[int], model: Model) -> Effect:
    """The effect with one scalar unknown per kept axis, `k_x`, in place of every vector `k`."""
    size = _size(effect, model)
    other = effect.otherwise and replace(effect.otherwise, on=effect.on)
    sizes_there = lengths(other, model) if other else set()
    if sizes_there and max(kept, default=0) >= max(sizes_there):
        other = None  # the form that it has on fewer axes
    vectors, declarations = {}, []
    for name, declared in effect.declarations:
        parameter = declared.decided((size,)) if isinstance(declared, Undecided) else declared
        if not isinstance(parameter, Parameter) or len(parameter.shape.dims) != 1:
            declarations.append((name, declared))
            continue
        names = [f"{name}_{entry_name(effect, i, parameter.shape.size)}" for i in kept]
        vectors[name] = (parameter.shape.size, dict(zip(kept, names, strict=True)))
        declarations += [
            (n, make_parameter(Shape("array", ()), parameter.units[i], None, None, parameter.scope))
            for i, n in zip(kept, names, strict=True)
        ]

    def function(*args: Any, **unknowns: Any) -> Any:
        for name, (length, places) in vectors.items():
            vector = ca.SX.zeros(length)
            vector[:] = effect.null_of(name)
            for i, own in places.items():
                vector[i] = unknowns.pop(own)
            unknowns[name] = vector
        return effect.function(*args, **unknowns)

    function.__wrapped__ = effect.function  # type: ignore[attr-defined]
    null = dict(effect.null)
    more = {own: null.get(n, 0.0) for n, (_, p) in vectors.items() for own in p.values()}
    typical = dict(effect.typical)
    sizes = {own: typical[n] for n, (_, p) in vectors.items() if n in typical for own in p.values()}
    plain = {
        own: value
        for name, value in effect.plain
        for own in (vectors[name][1].values() if name in vectors else [name])
    }
    return replace(
        effect,
        function=function,
        declarations=tuple(declarations),
        null=tuple(sorted({**null, **more}.items())),
        typical=tuple({**typical, **sizes}.items()),
        plain=tuple(plain.items()),
        otherwise=other and restricted(other, kept, model),
    )


def lengths(effect: Effect, model: Model) -> set[int]:
    """How long the effect's vectors of unknowns are, where it is attached."""
    size = _size(effect, model)
    own = [d.decided((size,)) if isinstance(d, Undecided) else d for _, d in effect.declarations]
    return {d.shape.size for d in own if isinstance(d, Parameter) and len(d.shape.dims) == 1}


def _size(effect: Effect, model: Model) -> int:
    """Numbers of the quantity or of the vector signal that it acts on; 0 of anything else."""
    if effect.on in model.quantities:
        return int(model.quantities[effect.on].declared.numel())
    return next((s.size for s in model.signals if s.name == effect.on and s.size > 1), 0)


def entry_name(effect: Effect, i: int, size: int) -> str:
    """As in the names of the restricted unknowns: the axis, of a 3x3 matrix row and column; the
    number where the effect's formula counts its terms, which are no axes."""
    if size == 9:
        return "xyz"[i // 3] + "xyz"[i % 3]
    return "xyz"[i] if size == 3 and f"[{i}]" not in effect.formula else str(i)
