"""From where a temperature counts: 20 degC is no 20 K, but a difference of two is the same in both.

Followed beside the dimensions, since degC and K have the same. A coefficient per kelvin times a
temperature in degC is what a data sheet means (zero + drift * temperature: the zero is that at
0 degC), and so are its square and cube (IEC 60751). What asks for absolute zero is refused: 1/T,
log T, roots and higher powers of T, a quantity in K, a comparison with one in K.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from casest import units
from casest.errors import UnitError

ABSOLUTE = "K"
#: Counts from a zero of the author's own: a difference, or with an unknown or number added.
OWN = "own"
_HIGHEST = 3  # powers that formulas in degC have
#: A number of this size that is added means a zero of its own (273.15; 234.5 for copper, 243.12 in
#: Magnus' formula); a smaller one corrects the reading.
_OWN_ZERO = 100.0
_COMPARED = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_FMIN, ca.OP_FMAX, ca.OP_FMOD,
             ca.OP_HYPOT, ca.OP_ATAN2, ca.OP_COPYSIGN}  # fmt: skip
_NEEDS_ABSOLUTE = {
    ca.OP_INV: "1 divided by",
    ca.OP_SQRT: "the root of",
    ca.OP_LOG: "the logarithm of",
    ca.OP_LOG1P: "the logarithm of",
}


@dataclass(frozen=True)
class Zero:
    """From which zero a value counts.

    `of`: the unit whose zero it is ("degC", "degF", "K" of a signal), OWN, or "" (not said).
    `weight`: how often that zero is in it: 1 in a reading, 0 in a difference; NaN: unknown.
    `degree`: which power of the temperature. `number`: its value, where that is known; `plain`:
    without a unit. `varies` with a signal; `free`: holds an unknown.
    """

    of: str = ""
    weight: float = 0.0
    degree: int = 1
    number: float | None = None
    plain: bool = False
    varies: bool = False
    free: bool = False

    @property
    def affine(self) -> bool:
        """Whether it counts from a zero that is not the absolute one."""
        return self.of not in ("", OWN, ABSOLUTE)


def of_symbol(unit: str, *, signal: bool, free: bool, number: float | None) -> Zero:
    """The zero of a declared symbol; that of an unknown in K may be a difference: not said."""
    if unit and "[" not in unit and units.zero_point(unit):
        return Zero(units.canonical(unit), 1.0, number=number, varies=signal, free=free)
    kelvin = signal and unit and "[" not in unit and units.size(unit)[1] == units.size("K")[1]
    of, weight = (ABSOLUTE, 1.0) if kelvin else ("", 0.0)
    return Zero(of, weight, number=number, varies=signal, free=free)


def followed(
    op: int, operands: Sequence[Zero], alike: Sequence[bool], temperature: bool, where: str
) -> Zero:
    """The zero of an operation's result.

    `alike`: which operands have the dimension of a temperature; `temperature`: whether the result
    has it, or none at all. Raises UnitError where absolute zero is asked for.
    """
    a = operands[0]
    varies, free = any(o.varies for o in operands), any(o.free for o in operands)
    if op in (ca.OP_ADD, ca.OP_SUB):
        found = _sum(op, operands, where) if any(alike) else Zero()
    elif op in _COMPARED:
        _refuse_comparison(operands, where)
        marked = [o for o in operands if o.affine]
        keeps = op in (ca.OP_FMIN, ca.OP_FMAX) and marked
        found = Zero(marked[0].of, math.nan) if keeps else Zero()
    elif op == ca.OP_IF_ELSE_ZERO:
        found = Zero(operands[1].of, math.nan) if operands[1].of else Zero()
    elif op in (ca.OP_MUL, ca.OP_DIV, ca.OP_SQ, ca.OP_POW, ca.OP_CONSTPOW):
        found = _product(op, operands, where)
        found = found if temperature or found.degree > 1 else Zero()
    elif op == ca.OP_NEG:
        found = Zero(a.of, -a.weight, a.degree)
    elif op == ca.OP_TWICE:
        found = Zero(a.of, 2 * a.weight, a.degree)
    elif op in (ca.OP_ASSIGN, ca.OP_FABS, ca.OP_FLOOR, ca.OP_CEIL):
        found = Zero(a.of, a.weight, a.degree)
    else:
        if a.affine and op in _NEEDS_ABSOLUTE:
            raise _asks_for_absolute(where, _NEEDS_ABSOLUTE[op], a.of)
        found = Zero()
    return Zero(found.of, found.weight, found.degree, varies=varies, free=free)


def refuse_other_zero(value: Zero, unit: str, where: str, names: str) -> None:
    """Raise UnitError where a value does not count from the zero of the unit it is declared in."""
    declared = units.canonical(unit) if units.zero_point(unit) else ABSOLUTE
    if declared == ABSOLUTE and value.affine:
        raise UnitError(
            f"{where}, and what it holds counts from 0 {value.of} (from {names}): declare the "
            f"signal in K (data in {value.of} are converted), or add "
            f'constant({_offset(value.of)}, "K")'
        )
    if declared != ABSOLUTE and value.of in ("", ABSOLUTE):
        raise UnitError(
            f"{where}, and what it holds counts from absolute zero or is a difference (from "
            f"{names}): declare it in K, or what it is made of in {declared}; a temperature in K "
            f"minus {_offset(declared)} is one in {declared}"
        )


def _sum(op: int, operands: Sequence[Zero], where: str) -> Zero:
    a, b = operands
    sign = -1.0 if op == ca.OP_SUB else 1.0
    if a.of and b.of and OWN not in (a.of, b.of):
        return _of_two(a, b, sign, where)
    if OWN in (a.of, b.of):
        marked = [o for o in operands if o.of not in ("", OWN)]
        return marked[0] if marked else Zero(OWN)  # a reading and a difference
    swapped = bool(b.of and not a.of) or (a.number is not None and b.number is None)
    one, other = (b, a) if swapped else (a, b)
    if other.number is not None:
        return _shifted(one, sign * other.number, other.plain, where)
    if (other.free and not other.varies) or (one.free and not one.varies and not one.of):
        return Zero(OWN)  # an unknown in K takes up whatever zero the rest has
    return Zero(one.of, one.weight)


def _of_two(a: Zero, b: Zero, sign: float, where: str) -> Zero:
    """Two temperatures, each with its zero."""
    if a.of != b.of:
        if sign < 0 and a.weight == b.weight == 1.0:
            raise UnitError(
                f"{where}: a temperature in {a.of} minus one in {b.of}: they count from two zeros; "
                f"declare both in one of them (data are converted)"
            )
        return a if a.affine else b
    weight = a.weight + sign * b.weight
    if math.isnan(weight):
        may_cancel = sign < 0 or a.weight < 0 or b.weight < 0
        return Zero(OWN) if may_cancel else Zero(a.of, math.nan)
    return Zero(a.of, weight) if weight else Zero(OWN)


def _shifted(one: Zero, by: float, plain: bool, where: str) -> Zero:
    """A temperature with a number added."""
    if not one.affine:
        celsius = abs(by + _offset("degC")) < 1.0
        return Zero("degC", 1.0) if celsius else Zero(OWN) if plain else one
    if abs(by - _offset(one.of)) < 1.0:
        return Zero(ABSOLUTE, 1.0)
    if not plain and by <= -_OWN_ZERO:
        raise UnitError(
            f"{where}: a temperature in {one.of} minus a constant of {-by:g} K, which counts from "
            f"absolute zero: declare the constant in {one.of}, or the signal in K"
        )
    return one if 0 <= by < _OWN_ZERO else Zero(OWN)


def _product(op: int, operands: Sequence[Zero], where: str) -> Zero:
    a, b = operands[0], operands[-1]
    # A difference over a number of degC that is no reading is one over a span.
    if op == ca.OP_DIV and b.affine and not (a.of == OWN and not b.varies):
        raise _asks_for_absolute(where, "a division by", b.of)
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        if not a.affine:
            return Zero()
        whole = b.number is not None and b.number in range(1, _HIGHEST + 1)
        degree = a.degree * int(b.number or 0) if whole else _HIGHEST + 1
        return _power(a.of, degree, where)
    if op == ca.OP_SQ:
        return _power(a.of, 2 * a.degree, where) if a.affine else Zero()
    if op == ca.OP_MUL and a.affine and b.affine:
        return _power(a.of, a.degree + b.degree, where)
    one, other = (b, a) if op == ca.OP_MUL and not a.of else (a, b)
    if not one.of or one.of == OWN:
        return one
    if other.number is not None and other.plain and one.degree == 1:
        factor = 1 / other.number if op == ca.OP_DIV and other.number else other.number
        return Zero(one.of, one.weight * factor) if factor else Zero()
    return Zero(one.of, math.nan, one.degree) if one.affine else Zero()


def _power(of: str, degree: int, where: str) -> Zero:
    if degree > _HIGHEST:
        raise _asks_for_absolute(where, "a root or higher power of", of)
    return Zero(of, math.nan, degree)


def _refuse_comparison(operands: Sequence[Zero], where: str) -> None:
    for one, other in (operands, operands[::-1]):
        if one.affine and not other.plain and other.of != one.of:
            raise UnitError(
                f"{where}: a temperature in {one.of} is compared with one in K: declare both in "
                f"one of them (data are converted)"
            )


def _asks_for_absolute(where: str, what: str, unit: str) -> UnitError:
    return UnitError(
        f"{where}: {what} a temperature in {unit}, which asks for one from absolute zero: declare "
        f'the signal in K (data in {unit} are converted), or add constant({_offset(unit)}, "K")'
    )


def _offset(unit: str) -> float:
    """What has to be added in the unit's own size: 273.15 to degC."""
    return round(units.zero_point(unit) / units.size(unit)[0], 2)
