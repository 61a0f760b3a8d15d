"""The one table of CasADi's operations: NumPy, C, units and exported text are all read from here.

A new operation is a new row, and nothing else; `tests/test_operations.py` compares every row's
kernel, C and exported text with CasADi, and its rule for units with what scaling does to it.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.errors import CasestError

Floats = NDArray[np.float64]
#: f(operand, ..., out). An operand is a row of samples or a 0-d array. Kernels of several calls
#: finish every read of their operands before they write, since `out` may be one of them.
Kernel = Callable[..., object]


class Units(Enum):
    """What an operation asks of its operands' units, and what its result has."""

    SAME = auto()  # operands and result have one unit
    COMPARED = auto()  # operands have one unit, the result is a pure number
    FIRST = auto()  # the unit of the first operand
    LAST = auto()  # the unit of the last operand
    PURE = auto()  # operands are pure numbers, and so is the result
    ANGLE = auto()  # as PURE, but an operand in degrees does not fit
    ANY = auto()  # nothing is asked, and what comes out fits anything


#: The result is the product of the operands' units, each to its power.
Powers = tuple[Fraction, ...]


@dataclass(frozen=True)
class Operation:
    """One operation of CasADi."""

    #: CasADi's number of it.
    code: int
    #: In messages and in exported programs.
    name: str
    #: On samples.
    kernel: Kernel
    #: On the operands {0} and {1}, doubles, in a compiled kernel: without branches.
    c: str
    units: Units | Powers
    #: A function that needs `np` alone, for exported modules; None: it is not exported.
    numpy: str | None
    #: On operands of the type `real`, for exported C with <tgmath.h>; `c` where there is none.
    real: str = ""
    #: On Python's numbers, where those follow IEEE 754 without an exception; else `kernel` is used.
    #: The second operand may be the first again.
    python: Callable[[float, float], float] | None = None
    #: May the operands change places?
    commutative: bool = False
    #: Is the result the first operand as it is?
    same: bool = False
    #: Has no SIMD form everywhere: gets a loop to itself in compiled kernels, so that it does not
    #: keep what stands beside it from being vectorised.
    alone: bool = False
    #: Has corners, steps or turns: its slope at a place does not say what it does elsewhere.
    broken: bool = False

    @property
    def arity(self) -> int:
        """How many operands it reads."""
        return 2 if "{1}" in self.c else 1

    @property
    def exported_c(self) -> str:
        """On operands of the type `real`, for exported C."""
        return self.real or self.c


def _twice(a: Floats, out: Floats) -> None:
    np.add(a, a, out)


def _sign(a: Floats, out: Floats) -> None:
    # Not np.sign, which loses the sign of -0.0.
    np.copyto(out, np.where(a < 0, -1.0, np.where(a > 0, 1.0, a)))


def _if_else_zero(condition: Floats, a: Floats, out: Floats) -> None:
    # Not a product: 0 * inf is nan.
    np.copyto(out, np.where(condition != 0, a, 0.0))


def _fmin(a: Floats, b: Floats, out: Floats) -> None:
    # Not np.fmin: of 0.0 and -0.0 it takes either, CasADi the first.
    np.copyto(out, np.where((a <= b) | (b != b), a, b))


def _fmax(a: Floats, b: Floats, out: Floats) -> None:
    np.copyto(out, np.where((a >= b) | (b != b), a, b))


def _remainder(a: Floats, b: Floats, out: Floats) -> None:
    """IEEE 754 remainder, exact (np.remainder is Python's %): the algorithm of FreeBSD's libm."""
    y = np.abs(b)
    # 2y overflows only where |a| < 2y holds anyway, and fmod(x, inf) is x.
    r = np.fmod(np.abs(a), y + y)
    # r > y/2, in a form that is exact for both tiny and huge y.
    tiny = y < 1.0
    over = np.where(tiny, r + r > y, r > 0.5 * y)
    r = np.where(over, r - y, r)
    over &= np.where(tiny, r + r >= y, r >= 0.5 * y)
    r = np.where(over, r - y, r)
    np.copyto(out, np.where(np.signbit(a), -r, r))


def _pow(a: Floats, b: Floats, out: Floats) -> None:
    # For a single exponent of 0.5 NumPy takes the square root, which is -0.0 of -0.0 and nan of
    # -inf, where pow is 0.0 and inf.
    if b.ndim == 0 and b == 0.5:
        np.copyto(out, np.where(np.isinf(a), np.abs(a), np.sqrt(a) + 0.0))
    else:
        np.power(a, b, out)


def _erf(a: Floats, out: Floats) -> None:
    from scipy.special import erf  # imported late: few models use it, and SciPy loads slowly

    erf(a, out)


def _divided(a: float, b: float) -> float:
    return a / b if b else float(np.divide(a, b))


def _powers(*powers: int | Fraction) -> Powers:
    return tuple(map(Fraction, powers))


#: In the order of an exported module's table.
OPERATIONS = (
    Operation(
        ca.OP_ADD, "add", np.add, "{0} + {1}", Units.SAME, "np.add",
        python=operator.add, commutative=True,
    ),
    Operation(
        ca.OP_SUB, "sub", np.subtract, "{0} - {1}", Units.SAME, "np.subtract", python=operator.sub
    ),
    Operation(
        ca.OP_MUL, "mul", np.multiply, "{0} * {1}", _powers(1, 1), "np.multiply",
        python=operator.mul, commutative=True,
    ),
    Operation(
        ca.OP_DIV, "div", np.divide, "{0} / {1}", _powers(1, -1), "np.divide", python=_divided
    ),
    Operation(
        ca.OP_NEG, "neg", np.negative, "-{0}", Units.FIRST, "np.negative", python=lambda a, _: -a
    ),
    Operation(ca.OP_EXP, "exp", np.exp, "exp({0})", Units.PURE, "np.exp"),
    Operation(ca.OP_LOG, "log", np.log, "log({0})", Units.PURE, "np.log"),
    Operation(ca.OP_LOG1P, "log1p", np.log1p, "log1p({0})", Units.PURE, "np.log1p", alone=True),
    Operation(ca.OP_EXPM1, "expm1", np.expm1, "expm1({0})", Units.PURE, "np.expm1", alone=True),
    # The exponent's value is not followed, and the unit depends on it.
    Operation(ca.OP_POW, "pow", _pow, "pow({0}, {1})", Units.ANY, "np.power"),
    Operation(ca.OP_CONSTPOW, "pow", _pow, "pow({0}, {1})", Units.ANY, "np.power"),
    Operation(ca.OP_SQRT, "sqrt", np.sqrt, "sqrt({0})", _powers(Fraction(1, 2)), "np.sqrt"),
    Operation(
        ca.OP_SQ, "square", np.square, "{0} * {0}", _powers(2), "np.square", python=operator.mul
    ),
    Operation(
        ca.OP_TWICE, "twice", _twice, "{0} + {0}", Units.FIRST, "lambda a: 2 * a",
        python=operator.add,
    ),
    Operation(
        ca.OP_INV, "inverse", np.reciprocal, "1.0 / {0}", _powers(-1), "lambda a: 1 / a",
        real="1 / {0}", python=lambda a, _: _divided(1.0, a),
    ),
    Operation(ca.OP_SIN, "sin", np.sin, "sin({0})", Units.ANGLE, "np.sin"),
    Operation(ca.OP_COS, "cos", np.cos, "cos({0})", Units.ANGLE, "np.cos"),
    Operation(ca.OP_TAN, "tan", np.tan, "tan({0})", Units.ANGLE, "np.tan", alone=True),
    Operation(ca.OP_ASIN, "asin", np.arcsin, "asin({0})", Units.PURE, "np.arcsin", alone=True),
    Operation(ca.OP_ACOS, "acos", np.arccos, "acos({0})", Units.PURE, "np.arccos", alone=True),
    Operation(ca.OP_ATAN, "atan", np.arctan, "atan({0})", Units.PURE, "np.arctan", alone=True),
    Operation(ca.OP_SINH, "sinh", np.sinh, "sinh({0})", Units.PURE, "np.sinh", alone=True),
    Operation(ca.OP_COSH, "cosh", np.cosh, "cosh({0})", Units.PURE, "np.cosh", alone=True),
    Operation(ca.OP_TANH, "tanh", np.tanh, "tanh({0})", Units.PURE, "np.tanh", alone=True),
    Operation(ca.OP_ASINH, "asinh", np.arcsinh, "asinh({0})", Units.PURE, "np.arcsinh", alone=True),
    Operation(ca.OP_ACOSH, "acosh", np.arccosh, "acosh({0})", Units.PURE, "np.arccosh", alone=True),
    Operation(ca.OP_ATANH, "atanh", np.arctanh, "atanh({0})", Units.PURE, "np.arctanh", alone=True),
    Operation(
        ca.OP_ATAN2, "atan2", np.arctan2, "atan2({0}, {1})", Units.COMPARED, "np.arctan2",
        alone=True, broken=True,
    ),
    Operation(
        ca.OP_HYPOT, "hypot", np.hypot, "hypot({0}, {1})", Units.SAME, "np.hypot", alone=True
    ),
    Operation(
        ca.OP_FMIN, "fmin", _fmin, "(({0} <= {1}) | ({1} != {1})) ? {0} : {1}", Units.SAME,
        "np.fmin", real="fmin({0}, {1})", broken=True,
    ),
    Operation(
        ca.OP_FMAX, "fmax", _fmax, "(({0} >= {1}) | ({1} != {1})) ? {0} : {1}", Units.SAME,
        "np.fmax", real="fmax({0}, {1})", broken=True,
    ),
    Operation(ca.OP_FABS, "fabs", np.fabs, "fabs({0})", Units.FIRST, "np.abs", broken=True),
    # Rounded to a whole number of the unit that the reading happens to be in: taken as it is.
    Operation(ca.OP_FLOOR, "floor", np.floor, "floor({0})", Units.FIRST, "np.floor", broken=True),
    Operation(ca.OP_CEIL, "ceil", np.ceil, "ceil({0})", Units.FIRST, "np.ceil", broken=True),
    Operation(
        ca.OP_FMOD, "fmod", np.fmod, "fmod({0}, {1})", Units.SAME, None, alone=True, broken=True
    ),
    Operation(
        ca.OP_REMAINDER, "remainder", _remainder, "remainder({0}, {1})", Units.SAME, None,
        alone=True, broken=True,
    ),
    Operation(
        ca.OP_SIGN, "sign", _sign, "{0} < 0 ? -1.0 : {0} > 0 ? 1.0 : {0}", Units.ANY, "np.sign",
        real="(real)(({0} > 0) - ({0} < 0))", broken=True,
    ),
    Operation(
        ca.OP_COPYSIGN, "copysign", np.copysign, "copysign({0}, {1})", Units.SAME, "np.copysign",
        broken=True,
    ),
    Operation(ca.OP_ERF, "erf", _erf, "erf({0})", Units.PURE, None, alone=True),
    Operation(
        ca.OP_ASSIGN, "assign", np.positive, "{0}", Units.FIRST, "lambda a: a", same=True
    ),
    Operation(ca.OP_LIFT, "assign", np.positive, "{0}", Units.FIRST, "lambda a: a", same=True),
    Operation(
        ca.OP_LT, "less", np.less, "{0} < {1}", Units.COMPARED, "lambda a, b: 1.0 * (a < b)",
        real="(real)({0} < {1})", broken=True,
    ),
    Operation(
        ca.OP_LE, "less_equal", np.less_equal, "{0} <= {1}", Units.COMPARED,
        "lambda a, b: 1.0 * (a <= b)", real="(real)({0} <= {1})", broken=True,
    ),
    Operation(
        ca.OP_EQ, "equal", np.equal, "{0} == {1}", Units.COMPARED, "lambda a, b: 1.0 * (a == b)",
        real="(real)({0} == {1})", broken=True,
    ),
    Operation(
        ca.OP_NE, "not_equal", np.not_equal, "{0} != {1}", Units.COMPARED,
        "lambda a, b: 1.0 * (a != b)", real="(real)({0} != {1})", broken=True,
    ),
    Operation(
        ca.OP_NOT, "not", np.logical_not, "!{0}", Units.PURE, "lambda a: 1.0 * (a == 0)",
        real="(real)!({0} != 0)",
    ),
    Operation(
        ca.OP_AND, "and", np.logical_and, "({0} != 0) & ({1} != 0)", Units.PURE,
        "lambda a, b: 1.0 * ((a != 0) & (b != 0))", real="(real)({0} != 0 && {1} != 0)",
    ),
    Operation(
        ca.OP_OR, "or", np.logical_or, "({0} != 0) | ({1} != 0)", Units.PURE,
        "lambda a, b: 1.0 * ((a != 0) | (b != 0))", real="(real)({0} != 0 || {1} != 0)",
    ),
    Operation(
        ca.OP_IF_ELSE_ZERO, "if_else_zero", _if_else_zero, "{0} != 0 ? {1} : 0.0", Units.LAST,
        "lambda a, b: np.where(a != 0, b, 0.0)", real="({0} != 0) ? {1} : (real)0", broken=True,
    ),
)  # fmt: skip

BY_CODE = {operation.code: operation for operation in OPERATIONS}


def operation_of(code: int, where: str) -> Operation:
    """The row of CasADi's number `code`; `where` says whose expression has it.

    Raises CasestError, which names the operation, where there is no such row.
    """
    if code not in BY_CODE:
        names = [n for n in dir(ca) if n.startswith("OP_") and getattr(ca, n) == code]
        raise CasestError(
            f"{where} uses the operation {names[0] if names else f'number {code}'}, which casest"
            " does not know: write the expression without it"
        )
    return BY_CODE[code]
