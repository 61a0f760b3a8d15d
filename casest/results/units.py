"""Units as the user sees them: `[v]` in a declared unit becomes the unit that the data have."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from casest import units
from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.symbols import Constant, Parameter
from casest.errors import UnitError

#: Readings of no stated unit that differ so many times from a norm of none are in another unit.
APART = 3.0
_PLACEHOLDER = re.compile(r"\[([^\]]+)\]")


def unit_table(model: Model, runs: Sequence[Run]) -> dict[str, str]:
    """Unit of every signal, constant and parameter entry (`offset[0]`), and of the residual.

    Where neither the data nor the user state a unit, the placeholder itself remains: `[v]` reads
    "the unit of v". Raises UnitError where a fixed value's unit contradicts that of the data.
    """
    known: dict[str, str] = {}
    for s in model.signals:
        stated = next((run.units.get(s.name) for run in runs if run.units.get(s.name)), None)
        known[s.name] = s.unit or stated or f"[{s.name}]"
    for p in model.parameters:  # a norm that was freed: others are in its unit
        own = p.units[0]
        if p.shape.size == 1 and own and ("[" not in own or _PLACEHOLDER.fullmatch(own)):
            known[p.name] = resolved(own, known)
    for c in model.constants:
        # Raw counts are no unit in which a field or gravity is known: such a norm is a pure number.
        counted = c.unit in {f"[{n}]" for n, u in known.items() if _counts(n, u, c, runs)}
        known[c.name] = "1" if counted else resolved(c.unit, known)
    for c in model.constants:
        if c.like:
            _check_like(c.name, c.unit, resolved(c.like, known))
        if c.frozen is not None:
            _check_fixed(c.name, c.unit, resolved(c.frozen.units[0], known))
    table = dict(known)
    for p in model.parameters:
        table.update(zip(p.entry_names, entry_units(p, known), strict=True))
    for q in model.quantities.values():
        table.setdefault(q.name, resolved(q.unit, known) if q.unit else "")
    table["residual"] = resolved(model.residual_unit, known)
    return table


def _counts(name: str, unit: str, c: Constant, runs: Sequence[Run]) -> bool:
    """Are readings raw counts beside a constant: called so, or of no stated unit and size?

    Readings 300 long and a norm of 1 cannot both be in "the unit of v".
    """
    if unit != f"[{name}]":
        return unit == "count"
    lengths = [length for run in runs if (length := _length(run, name))]
    size = float(np.linalg.norm(c.array))
    return bool(lengths and size and not 1 / APART < lengths[0] / size < APART)


def _length(run: Run, name: str) -> float:
    """How long a reading is, of some that stand for all; 0 where there are none."""
    values = np.asarray(run.signals.get(name, ()), float)
    some = values[:: max(1, len(values) // 1000)]
    lengths = np.linalg.norm(some.reshape(len(some), -1), axis=1) if len(some) else np.zeros(1)
    return float(np.median(lengths))


def entry_units(parameter: Parameter, known: Mapping[str, str]) -> list[str]:
    """Resolved unit of every stored entry."""
    return [resolved(u, known) for u in parameter.units]


def resolved(unit: str, known: Mapping[str, str]) -> str:
    """The unit with every placeholder replaced by what it stands for."""
    quotient = re.fullmatch(r"\[([^\]]+)\]/\[([^\]]+)\]", unit)
    if quotient:
        a, b = (known.get(name, f"[{name}]") for name in quotient.groups())
        return _quotient(a, _difference(b))
    over = re.fullmatch(r"\(([^\[\]]+)\)/\[([^\]]+)\]", unit)
    if over:
        return _quotient(over[1], _difference(known.get(over[2], f"[{over[2]}]")))
    alone = _PLACEHOLDER.fullmatch(unit)
    if alone:
        return known.get(alone[1], unit)

    def replacement(match: re.Match[str]) -> str:
        value = _difference(known.get(match[1], match[0]))
        return f"({value})" if "/" in value or "*" in value else value

    return _plainer(_PLACEHOLDER.sub(replacement, unit) or "1")


def _plainer(unit: str) -> str:
    """Without parentheses that nobody needs: 1/((m/s^2))^2, 1/(g), (rad/s)."""
    unit = re.sub(r"\(\(([^()]*)\)\)", r"(\1)", unit)
    return re.sub(r"(?<!\w)\((\w+)\)|^\(([^()]*)\)$", lambda m: m[1] or m[2], unit)


def _difference(unit: str) -> str:
    """In a compound unit a temperature is a difference: per kelvin."""
    return "K" if unit == "degC" else unit


def _quotient(a: str, b: str) -> str:
    if a == b:
        return "1"
    if "[" in a + b:
        return f"{a}/{b}" if b != "1" else a
    return units.quotient(a, b)


def _check_like(name: str, stated: str, like: str) -> None:
    """A norm in kg for readings in m/s² is a mistake; for raw counts any unit may be right."""
    if not stated or "[" in stated + like or like in ("count", "1"):
        return
    try:
        units.conversion(stated, like)
    except UnitError as error:
        raise UnitError(
            f"{name} is set in {stated}, and the readings are in {like}: {error}"
        ) from None


def _check_fixed(name: str, stated: str, needed: str) -> None:
    if not stated or stated == needed or "[" in stated + needed:
        return
    try:
        factor, _ = units.conversion(stated, needed)
    except UnitError:
        factor = 0.0
    if abs(factor - 1) > 1e-9:
        raise UnitError(
            f"the fixed {name} is in {stated}, but with these data it must be in {needed}; "
            "give the data in the unit of the first calibration (--unit), or calibrate anew"
        )
