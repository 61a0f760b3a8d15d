"""What happens between two samples: Φ, forced step and process noise, for A(t) a straight line.

From a step's end backwards, Φ(t₁, t₁ − τh) = ΣFₖτᵏ with (k + 1)Fₖ₊₁ = h(FₖA₁ − Fₖ₋₁(A₁ − A₀)):
one series gives the transition over any part of the step; A(t) need not commute with itself. The
integrals of input and noise are Gauss's sums over those parts, so that a covariance is a sum of
squares, and right in its leading power of h in every entry: a position's, driven through three
integrators, too (by Simpson's rule it is not). Fast motion is cut into pieces, and what is still
fast in a piece is doubled with A held: exact where A is constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics.stepping import Pattern, entries
from casest.engine import Columns, Replay, evaluated

#: Share of the largest entry below which one is nothing that units need to make even.
NOTHING = 1e-60
#: How much of a motion, ‖A‖h, a series of so many terms follows to rounding.
_SLOW, _SERIES = (0.05, 0.25), (8, 12)
#: Into how many pieces a fast step is cut at most; what is faster still is doubled in each.
_PIECES = 64
#: Doublings at most: what is faster than this is no motion that samples could follow.
DOUBLINGS = 60


@dataclass(frozen=True)
class Motions:
    """Steps x(t₁) = Φ x(t₀) + u + w: Phi (K, n, n), forced u (K, n), Q (K, n, n) of w."""

    Phi: Array
    forced: Array
    Q: Array


def motions(
    A: Array, c: Array, Xi: Array, h: Array, ending: tuple[Array, Array] | None = None
) -> Motions:
    """Of every step between samples: A (N, n, n), c (N, n), intensity Ξ, h (N − 1,).

    Ξ (n, n), or (N, n, n) where it changes; between samples all are straight lines. `ending`: A and
    c at the end of every step, where they jump there. Where a motion grows beyond what numbers
    hold, what is not finite is returned.
    """
    return with_noises(A, c, [Xi], h, ending)[0]


def with_noises(
    A: Array,
    c: Array,
    Xis: Sequence[Array],
    h: Array,
    ending: tuple[Array, Array] | None = None,
) -> list[Motions]:
    """The same of one motion with each of several noises: Φ and forced step are found once."""
    A1, c1 = ending or (A[1:], c[1:])
    ends = A[:-1], A1, c[:-1], c1
    noises = [(Xi[:-1], Xi[1:]) if Xi.ndim == 3 else (Xi, Xi) for Xi in Xis]
    high, low = _range(A)
    fast = balance(np.maximum(high, -low))[1] * h
    if fast.max(initial=0.0) <= _SLOW[-1]:
        there = _there(high, low) if ending is None else None
        return _slow(ends, noises, h, float(fast.max(initial=0.0)), there)
    with np.errstate(all="ignore"):
        return [_any((*ends, *noise), h, fast) for noise in noises]


def order_of(size: Array, h: Array) -> int | None:
    """Terms of the series for a motion whose A is at most `size` (n, n); None where it is fast."""
    fast = balance(size)[1] * float(h.max(initial=0.0))
    return _SERIES[int(fast > _SLOW[0])] if fast <= _SLOW[-1] else None


def _any(ends: Sequence[Array], h: Array, fast: Array) -> Motions:
    """Slow steps at once, faster ones in as many pieces as they need."""
    n = ends[0].shape[1]
    found = Motions(*(np.full((len(h), *s), np.nan) for s in ((n, n), (n,), (n, n))))
    held = ends[4] if ends[4].ndim == 2 else None
    pieces = np.exp2(np.ceil(np.log2(np.maximum(fast / _SLOW[-1], 1.0))))
    pieces = np.where(np.isfinite(pieces), np.minimum(pieces, _PIECES), 0)  # no pieces help there
    for count in np.unique(pieces[pieces > 0]):
        rows = pieces == count
        own = _cut([e if e is held else e[rows] for e in ends], h[rows], int(count), fast[rows])
        for name in ("Phi", "forced", "Q"):
            getattr(found, name)[rows] = getattr(own, name)
    return found


def _cut(ends: Sequence[Array], h: Array, count: int, fast: Array) -> Motions:
    whole: Motions | None = None
    A0, A1, c0, c1, X0, X1 = ends
    for k in range(count):
        a, b = k / count, (k + 1) / count
        piece = [M for s, e in ((A0, A1), (c0, c1), (X0, X1))
                 for M in (s + a * (e - s), s + b * (e - s))]  # fmt: skip
        left = max(float(fast.max()) / count / _SLOW[-1], 1.0)
        own = _doubled(piece, h / count, int(np.ceil(np.log2(left))))
        whole = own if whole is None else _after(whole, own)
    assert whole is not None
    return whole


def _doubled(piece: list[Array], h: Array, times: int) -> Motions:
    if times:  # held: two halves are alike
        piece = [
            M for s, e in zip(piece[::2], piece[1::2], strict=True) for M in 2 * [0.5 * (s + e)]
        ]
    (own,) = _slow(piece[:4], [(piece[4], piece[5])], h / 2.0**times, _SLOW[-1])
    for _ in range(min(times, DOUBLINGS)):
        own = _after(own, own)
    return own


def _after(first: Motions, then: Motions) -> Motions:
    """Both, one after the other."""
    Phi = then.Phi
    moved = (Phi @ first.forced[:, :, None])[:, :, 0]
    Q = Phi @ first.Q @ Phi.transpose(0, 2, 1) + then.Q
    return Motions(Phi @ first.Phi, moved + then.forced, 0.5 * (Q + Q.transpose(0, 2, 1)))


def balance(size: Array) -> tuple[Array, float]:
    """Units (n,) in which a matrix of such entries is smallest, and its norm there."""
    from scipy.linalg import matrix_balance

    if not np.isfinite(size).all():
        return np.ones(len(size)), np.inf
    size = np.where(size > NOTHING * size.max(initial=0.0), size, 0.0)
    with np.errstate(invalid="ignore"):  # it casts units to integers too, of no use here
        even, (units, _) = matrix_balance(size, permute=False, separate=True)
    return np.asarray(units, float), float(even.sum(axis=1).max())


def _slow(
    ends: Sequence[Array],
    noises: Sequence[tuple[Array, Array]],
    h: Array,
    fast: float,
    there: Any = None,
) -> list[Motions]:
    """`there`: which entries of A are anything but nothing, where that is known."""
    A0, A1, c0, c1 = ends
    n, count = A0.shape[1], len(h)
    of_A = _pattern(_there(*_range(A0)) | _there(*_range(A1)) if there is None else there)
    a = _picked(A1, of_A)
    d = a - _picked(A0, of_A)
    changing = np.flatnonzero(_there(*_range(d)))
    of_D = tuple(of_A[k] for k in changing)
    columns, given, of_X = [a, d[:, changing], c0, c1], [np.zeros(0)], []
    for X0, X1 in noises:
        even = X0.ndim == 2
        there = X0 != 0 if even else _there(*_range(X0)) | _there(*_range(X1))
        own = _pattern(np.triu(there))
        of_X.append((own, even))
        if even:
            given.append(X0[tuple(np.array(own, int).reshape(-1, 2).T)])
        else:
            columns += [_picked(X0, own), _picked(X1, own)]
    order = _SERIES[int(fast > _SLOW[0])]
    replay = _replay(n, of_A, of_D, tuple(of_X), order)
    Phi, forced, *Q = evaluated(replay, np.concatenate(given), Columns([*columns, h[:, None]]))
    Phi, forced = np.asarray(Phi), np.asarray(forced).reshape(count, n)
    return [Motions(Phi, forced, np.asarray(each)) for each in Q]


def _range(matrices: Array) -> tuple[Array, Array]:
    """Largest and smallest of every entry, (n, n) each."""
    return matrices.max(axis=0, initial=0.0), matrices.min(axis=0, initial=0.0)


def _there(high: Array, low: Array) -> Any:
    """Which entries are anything but nothing; what is no number is something."""
    return (high != 0) | (low != 0)


def _pattern(there: Any) -> Pattern:
    return tuple((int(i), int(j)) for i, j in np.argwhere(there))


def _picked(matrices: Array, pattern: Pattern) -> Array:
    rows, columns = np.array(pattern, int).reshape(-1, 2).T
    return np.ascontiguousarray(matrices[:, rows, columns])


@lru_cache(maxsize=32)
def _replay(
    n: int, of_A: Pattern, of_D: Pattern, of_X: tuple[tuple[Pattern, bool], ...], order: int
) -> Replay:
    """`of_X`: of every noise its pattern, and whether it is the same everywhere."""
    (a, A), (d, D) = (_symbols(name, n, p) for name, p in (("A", of_A), ("D", of_D)))
    c0, c1, h = ca.SX.sym("c0", n), ca.SX.sym("c1", n), ca.SX.sym("h")
    sample, known, noises = [a, d, c0, c1], [ca.SX(0, 1)], []
    for pattern, even in of_X:
        (x0, X0), (x1, X1) = (_symbols(name, n, pattern, True) for name in ("X0", "X1"))
        known += [x0] if even else []
        sample += [] if even else [x0, x1]
        noises.append((X0, X0 if even else X1))

    def at(tau: float) -> tuple[Any, list[Any]]:
        each = [X1 if X0 is X1 else X1 - tau * (X1 - X0) for X0, X1 in noises]
        return c1 - tau * (c1 - c0), each

    Phi, forced, Q = expressions(A, D, at, h, order)
    outputs = [ca.densify(e) for e in (Phi, forced, *Q)]
    names = ["parameters", "sample"], [f"o{k}" for k in range(len(outputs))]
    given = [ca.densify(ca.vertcat(*known)), ca.vertcat(*sample, h)]
    return Replay(ca.Function("between", given, outputs, *names))


def expressions(
    A: Any, D: Any, at: Callable[[float], tuple[Any, list[Any]]], h: Any, order: int
) -> tuple[Any, Any, list[Any]]:
    """Φ, forced step and every Q of one step in CasADi's symbols: A at its end, D what A has
    changed by, c and each Ξ at τ, which runs from the end, 0, back to the beginning, 1."""
    n = A.size1()
    *parts, (whole, _, _) = _parts(A, D, h, order)
    forced, Q = ca.SX(n, 1), [ca.SX(n, n) for _ in at(0.0)[1]]
    for Phi, tau, weight in parts:
        c, noises = at(tau)
        forced += weight * (Phi @ c)
        Q = [own + weight * ca.triu(Phi @ Xi @ Phi.T) for own, Xi in zip(Q, noises, strict=True)]
    return whole, forced, [own + ca.triu(own, False).T for own in Q]


def noise_of(A: Any, D: Any, Xi: Callable[[float], Any], h: Any) -> Any:
    """Q alone of a step with ‖A‖h up to a half."""
    none = ca.SX(A.size1(), 1)
    (Q,) = expressions(A, D, lambda tau: (none, [Xi(tau)]), h, _SERIES[-1])[2]
    return Q


def _parts(A: Any, D: Any, h: Any, order: int) -> list[tuple[Any, float, Any]]:
    """Φ(t₁, t₁ − τh), τ and weight at Gauss's places, and of the whole step."""
    series = _series(h * A, h * D, order)
    places = [(tau, weight * h) for tau, weight in _nodes(entries(A), A.size1())] + [(1.0, 0 * h)]
    return [
        (sum((tau**k * F for k, F in enumerate(series[1:], 1)), series[0]), tau, weight)
        for tau, weight in places
    ]


def _series(A: Any, D: Any, order: int) -> list[Any]:
    """Fₖ of Φ(t₁, t₁ − τh) = ΣFₖτᵏ, A being h·A(t₁) and D h·(A(t₁) − A(t₀))."""
    series = [ca.SX.eye(A.size1()), A]
    for k in range(1, order):
        series.append((series[k] @ A - series[k - 1] @ D) / (k + 1))
    return series


def _nodes(of_A: Pattern, n: int) -> list[tuple[float, float]]:
    """Gauss's places and weights on a step, enough for the slowest entry's leading power of it."""
    there, path = np.zeros((n, n), bool), 0
    there[tuple(np.array(of_A, int).reshape(-1, 2).T)] = True
    reached = np.eye(n, dtype=bool)
    while (more := reached | (there @ reached)).sum() > reached.sum():
        reached, path = more, path + 1
    places, weights = np.polynomial.legendre.leggauss(path + 3)
    return [(float(0.5 + 0.5 * p), float(0.5 * w)) for p, w in zip(places, weights, strict=True)]


def _symbols(name: str, n: int, pattern: Pattern, both: bool = False) -> tuple[Any, Any]:
    """Symbols for the entries of a pattern, and the matrix of them (`both`: of a symmetric one)."""
    symbols, matrix = ca.SX.sym(name, len(pattern)), ca.SX(n, n)
    for k, (i, j) in enumerate(pattern):
        matrix[i, j] = symbols[k]
        if both:
            matrix[j, i] = symbols[k]
    return symbols, matrix
