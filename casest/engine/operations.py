"""CasADi's operations in NumPy: f(operand, ..., out).

An operand is a row of samples or a 0-d array. The composite ones finish every read of their
operands before they write, since `out` may be one of them.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Kernel = Callable[..., object]


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


KERNELS: dict[int, Kernel] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_LOG1P: np.log1p,
    ca.OP_EXPM1: np.expm1,
    ca.OP_POW: _pow,
    ca.OP_CONSTPOW: _pow,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: _twice,
    ca.OP_INV: np.reciprocal,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_HYPOT: np.hypot,
    ca.OP_FMIN: _fmin,
    ca.OP_FMAX: _fmax,
    ca.OP_FABS: np.fabs,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_FMOD: np.fmod,
    ca.OP_REMAINDER: _remainder,
    ca.OP_SIGN: _sign,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_ERF: _erf,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_NOT: np.logical_not,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
}
