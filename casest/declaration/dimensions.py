"""Do the declared units fit together? Dimensional analysis of a model's traced expressions.

Every operation of the body is followed with the sizes of its operands. What is added, subtracted
or compared must have one unit (cm and m differ, and so do deg and rad inside a sine); a plain
number fits anything. Factors such as 1000 may convert units: the scale of the product is unknown
then, but not its dimension. From where a temperature counts is followed too (`temperatures`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache
from typing import Any

import casadi as ca

from casest import units
from casest.declaration.effect import Attached, of_columns
from casest.declaration.model import Model
from casest.declaration.symbols import Constant, Signal, param
from casest.declaration.temperatures import Zero, followed, of_symbol, refuse_other_zero
from casest.declaration.tracing import function_of, trace
from casest.engine.operations import Operation, Powers, Units, operation_of
from casest.errors import UnitError


@dataclass(frozen=True)
class Size:
    """Powers of base units, the factor to them (None: unknown), and whose symbols are inside.

    `powers` None: a plain number, which fits anything.
    """

    powers: Mapping[str, Fraction] | None
    factor: float | None
    names: frozenset[str]
    zero: Zero = field(default_factory=Zero, compare=False)

    def __str__(self) -> str:
        if not self.powers:
            one = self.factor in (None, 1.0)
            return "a pure number" if one else f"a pure number of unit {self.factor:.4g}"
        factor = "" if self.factor in (None, 1.0) else f"{self.factor:.4g} "
        known = {b: p for b, p in self.powers.items() if not b.startswith("[")}
        name = _derived().get(frozenset(known.items()))
        powers = self.powers if name is None else {name: _ONE} | _open_units(self.powers)
        return factor + "·".join(b if p == 1 else f"{b}^{p}" for b, p in powers.items())


PLAIN = Size(None, None, frozenset())
#: A number such as 2 or 1/3, which belongs to a formula and converts no unit.
PURE = Size(None, 1.0, frozenset())
_ONE = Fraction(1)
_KELVIN = {"K": _ONE}


def check_units(model: Model) -> None:
    """Raise UnitError where units contradict each other: names the symbols on both sides.

    Quantities must come out in the unit that they are declared in, and a prediction in that of
    the reading.
    """
    open_model = model
    for fixed in model.constants:  # plain numbers would lose their units in the expression
        open_model = open_model.freed(fixed.name)
    open_model = replace(open_model, effects=tuple(map(_open, open_model.effects)))
    traced = trace(open_model)  # what effects do to the noise is no part of the body
    outputs = {q.name: ca.vec(q.value) for q in traced.quantities.values()}
    if traced.predicted is None:
        outputs["residual"] = traced.expression
    else:
        outputs["prediction"] = traced.predicted
    f = function_of(open_model, outputs, traced)
    numbers = {c.name: float(c.array) for c in model.constants if not c.dims}
    sizes = followed_through(f, _input_sizes(open_model, numbers), f"model {model.name}")
    if traced.predicted is None:
        for found in sizes[-1]:
            _refuse_counted_residual(found, model.name)
    for k, q in enumerate(traced.quantities.values()):
        if q.unit and not q.implied:  # an implied one is checked as the prediction below
            for found in sizes[k]:
                where = f"model {model.name}: quantity {q.name} is declared in {q.unit}"
                try:
                    declared = size_of(q.unit, _references(open_model))
                except UnitError as error:
                    raise UnitError(f"{where}: {error}") from None
                refuse_unless_fits(found, declared, where)
                _same_zero(found, q.unit, declared, where)
    if traced.measured is not None and not _fits_anything(model, model[traced.measured]):
        unit = model.residual_unit
        for found in sizes[-1]:
            where = f"model {model.name}: the prediction of {traced.measured} [{unit}]"
            declared = size_of(unit, _references(open_model))
            refuse_unless_fits(found, declared, where)
            _same_zero(found, unit, declared, where)


def _same_zero(found: Size, unit: str, declared: Size, where: str) -> None:
    """A temperature declared in a unit counts from that unit's zero."""
    if found.powers == declared.powers == _KELVIN and "[" not in unit:
        refuse_other_zero(found.zero, unit, where, ", ".join(sorted(found.names)) or "a number")


def _refuse_counted_residual(found: Size, name: str) -> None:
    """A residual is zero but for noise, from whichever zero temperatures count."""
    if found.powers == _KELVIN and found.zero.affine:
        refuse_other_zero(
            found.zero, "K", f"model {name}: the residual", ", ".join(sorted(found.names))
        )


def _input_sizes(model: Model, numbers: Mapping[str, float]) -> dict[tuple[int, int], Size]:
    sizes: dict[tuple[int, int], Size] = {}
    k = 0
    for p in model.parameters:
        for i in range(p.shape.coordinates):
            curved = p.shape.curved
            unit = "" if curved else p.units[i]
            size = Size({}, 1.0, frozenset()) if curved else size_of(unit, _references(model))
            number = numbers.get(p.name)
            zero = of_symbol(unit, signal=False, free=p.name not in numbers, number=number)
            sizes[0, k] = replace(named(size, p.name, unit), zero=zero)
            k += 1
    k = 0
    for s in model.signals:
        for _ in range(s.size):
            unit = "" if s.kind == "rotation" else f"[{s.name}]"
            own = size_of(s.unit if s.unit is not None else unit, _references(model))
            own = PLAIN if _fits_anything(model, s) else own
            zero = of_symbol(s.unit or "", signal=True, free=False, number=None)
            sizes[1, k] = replace(named(own, s.name, s.unit or ""), zero=zero)
            k += 1
    return sizes


def _fits_anything(model: Model, s: Signal) -> bool:
    """Of differential equations a signal of any unit is compared with states that have one."""
    return s.unit is None and s.kind == "plain" and model.traced.integrates


def _references(model: Model) -> Mapping[str, Any]:
    """What a unit may refer to: symbols, and quantities."""
    return {**model.quantities, **model.symbols}


def size_of(unit: str, symbols: Mapping[str, Any]) -> Size:
    """Size of a declared unit; `[v]` is that of the symbol v, a base of its own if v has none."""
    text = unit
    for _ in symbols:  # a unit may refer to one that refers to another
        text = _PLACEHOLDER.sub(lambda m: _replacement(m[1], symbols), text)
    own: dict[str, Fraction] = {}
    for match in _PLACEHOLDER.finditer(text):
        power = -_ONE if text[: match.start()].rstrip("( ").endswith("/") else _ONE
        raised = _POWER.match(text, match.end())
        power *= int(raised[1]) if raised else 1
        own[match[0]] = own.get(match[0], Fraction(0)) + power
    factor, dimension = units.size(_PLACEHOLDER.sub("1", text) or "1")
    # An angle is a ratio of lengths: rad counts as 1, deg as the factor to it.
    powers = {base: p for base, p in [*dimension, *own.items()] if p and base != "angle"}
    return Size(powers, factor, frozenset())


_PLACEHOLDER = re.compile(r"\[([^\]]+)\]")
_POWER = re.compile(r"[) ]*(?:\^|\*\*) *(\d+)")


def _replacement(name: str, symbols: Mapping[str, Any]) -> str:
    """The unit of a symbol or quantity in brackets, or the placeholder where it has none."""
    symbol = symbols.get(name)
    unit = symbol.unit if symbol is not None else None
    if not unit or "," in unit or unit == f"[{name}]":
        return f"[{name}]"
    return f"({unit})"


def named(size: Size, name: str, unit: str) -> Size:
    """The size, that of a symbol which messages can name."""
    return Size(size.powers, size.factor, frozenset({f"{name} [{unit}]" if unit else name}))


def _open(attached: Attached) -> Attached:
    """The effect with its numbers that have a unit as unknowns."""
    found, more = [], []
    for name, declared in attached.effect.declarations:
        if isinstance(declared, Constant) and declared.unit and not declared.dims:
            unit = of_columns(declared.unit, dict(attached.columns), {})
            opened = param(unit, start=float(declared.array))
            more.append(replace(opened, name=f"{attached.label}.{name}"))
            declared = more[-1]
        found.append((name, declared))
    effect = replace(attached.effect, declarations=tuple(found))
    return replace(attached, effect=effect, parameters=(*attached.parameters, *more))


def followed_through(
    f: Any, inputs: Mapping[tuple[int, int], Size], place: str
) -> list[list[Size]]:
    """Sizes of every output entry, by walking the instruction list; errors begin with `place`."""
    work: dict[int, Size] = {}
    outputs: list[list[Size]] = [[] for _ in range(f.n_out())]
    for k in range(f.n_instructions()):
        op, where, to = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_CONST:
            number = float(f.instruction_constant(k))
            plain = PURE if _is_mathematical(number) else PLAIN
            work[to[0]] = replace(plain, zero=Zero(number=number, plain=True))
        elif op == ca.OP_INPUT:
            work[to[0]] = inputs.get((where[0], where[1]), PLAIN)
        elif op == ca.OP_OUTPUT:
            outputs[to[0]].append(work[where[0]])
        else:
            operation = operation_of(op, place)
            work[to[0]] = _operated(operation, [work[i] for i in where], place)
    return outputs


def _is_mathematical(number: float) -> bool:
    """Small whole numbers and their inverses; others may be conversions, as 0.01745 or 1000."""
    size = abs(number)
    candidates = (size, 1 / size if size else 0.0)
    return any(abs(x - round(x)) < 1e-12 for x in candidates if x < 12.5)


def _operated(operation: Operation, operands: list[Size], place: str) -> Size:
    """Size of an operation's result, and from where it counts if it is a temperature."""
    found = _result(operation, operands, place)
    alike = [o.powers == _KELVIN for o in operands]
    temperature = found.powers == _KELVIN or not found.powers
    where = place
    if marked := sorted(frozenset().union(*(o.names for o in operands if o.zero.affine))):
        where += f", {', '.join(marked)}"
    zeros = [replace(o.zero, plain=o.powers is None) for o in operands]
    return replace(found, zero=followed(operation.code, zeros, alike, temperature, where))


def _result(operation: Operation, operands: list[Size], place: str) -> Size:
    """What comes out of an operation on operands of these sizes."""
    names = frozenset().union(*(o.names for o in operands))
    first, pure = operands[0], Size({}, 1.0, names)
    if isinstance(operation.units, tuple):
        return _product(operation.units, operands, names)
    match operation.units:
        case Units.ANY:
            return PLAIN
        case Units.FIRST:
            return Size(first.powers, first.factor, names)
        case Units.LAST:
            return operands[-1]
        case Units.SAME | Units.COMPARED:
            refuse_unless_fits(first, operands[1], place)
            if operation.units is Units.COMPARED:
                return pure
            chosen = first if first.powers is not None else operands[1]
            return Size(chosen.powers, chosen.factor, names)
        case Units.PURE | Units.ANGLE:
            factor = 1.0 if operation.units is Units.ANGLE else None
            for operand in operands:
                where = f"{place}: the argument of {operation.name}"
                refuse_unless_fits(operand, Size({}, factor, frozenset()), where)
            return pure


def _product(powers: Powers, operands: list[Size], names: frozenset[str]) -> Size:
    if all(o.powers is None for o in operands):
        return PURE if all(o.factor for o in operands) else PLAIN
    total: dict[str, Fraction] = {}
    factor: float | None = 1.0
    for operand, power in zip(operands, powers, strict=True):
        for base, p in (operand.powers or {}).items():
            total[base] = total.get(base, Fraction(0)) + p * power
        if factor is None or operand.factor is None:
            factor = None
        else:
            factor *= operand.factor ** float(power)
    return Size({b: p for b, p in total.items() if p}, factor, names)


def refuse_unless_fits(a: Size, b: Size, where: str) -> None:
    """UnitError where two sizes are not one, unless one of them fits anything."""
    if a.powers is None or b.powers is None:
        return
    same_factor = a.factor is None or b.factor is None or abs(a.factor / b.factor - 1) < 1e-9
    if dict(a.powers) == dict(b.powers) and same_factor:
        return
    sides = [f"{s}" + (f" (from {', '.join(sorted(s.names))})" if s.names else "") for s in (a, b)]
    said = f"{where}: units do not fit: {sides[0]} against {sides[1]}; {_way_out(a, b)}"
    if re.search(r"\[[FC]\]|declared in [FC]\b", said):
        said += "; F and C are degrees here: write farad and coulomb"
    raise UnitError(said)


@cache
def _derived() -> dict[frozenset[tuple[str, Fraction]], str]:
    """Names of units that are products of others, by their powers."""
    names = ("N", "Pa", "J", "W", "V", "ohm", "T", "C", "F", "H", "Wb")
    return {frozenset((b, Fraction(p)) for b, p in units.size(n)[1]): n for n in names}


def _open_units(powers: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Those of signals that have none, as `[pwm]`."""
    return {b: p for b, p in powers.items() if b.startswith("[")}


def _way_out(a: Size, b: Size) -> str:
    """What to mend: a factor between two units of one kind, or the formula."""
    if a.powers == b.powers and a.factor and b.factor:
        low, high = sorted((a.factor, b.factor))
        said = f"one kind in two units, {high / low:.4g} to 1: declare both in one of them"
        degrees = abs(high / low * math.pi / 180 - 1) < 1e-9
        return said + (", or multiply degrees by pi / 180" if degrees else "")
    one, other = (_open_units(s.powers or {}) for s in (a, b))
    more = [u for u in one | other if one.get(u, 0) != other.get(u, 0)]
    if not more:
        return "declare another unit, or mend the formula"
    alone = next((s for s in (a, b) if s.powers == {more[0]: _ONE}), None)
    base = a if more[0] not in one else b
    size = f"{base}" if base.powers else "1"
    unit = more[0] if alone is not None else f"{size}/{more[0]}"
    why = f"{more[0]} is the unit of a signal that has none" + ("" if alone else ", and multiplied")
    return f'declare another unit, like param("{unit}") ({why}), or mend the formula'
