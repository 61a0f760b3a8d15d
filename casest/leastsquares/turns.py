"""Rotations between rests: a rate integrated over the raw record, with its slopes.

A body whose attitude C (body to reference) obeys C′ = C[ω]× turns by R = C(t₀)ᵀC(t₁) from rest to
rest: a vector that stands still is u before and Rᵀu after. Between readings the rate is a
straight line; the turn over that step is the exponential of Magnus' series to fourth order,
φ = ½(ω₀ + ω₁)h + (h²/12)·ω₀ × ω₁ (Iserles, Munthe-Kaas, Nørsett, Zanna, Acta Numerica 2000,
sec. 5; the sign is that of C′ = C[ω]×), and rotations are multiplied as they are: no step is taken
to be small. Slopes follow the product: with R(θ + δ) = R·exp([Sδ]×),
S = Σ P_iᵀ J_r(φ_i) ∂φ_i, where P_i is what is turned after step i and J_r the right Jacobian.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array

#: Squared angle below which functions of it are taken from their series (rounding is 1e-16 then).
_SMALL = 1e-4
#: Steps that are multiplied side by side.
PIECE = 32
#: Steps whose numbers fit into a processor's cache, and into memory that need not be asked for.
TOGETHER = 2048
#: A rotation as the first row (a, b) of its matrix in SU(2): the half of a quaternion's products.
Pair = tuple[NDArray[np.complex128], NDArray[np.complex128]]


def rotations(
    rate: Array, slopes: Array, time: Array, spans: NDArray[np.int_]
) -> tuple[Array, Array]:
    """Turn over each span of samples (both ends included), (K, 3, 3), and its slopes (K, 3, n).

    rate (N, 3) in rad/s at `time` (N,) s, slopes (N, 3, n) of it; spans (K, 2) follow each other. A
    slope is the small rotation, in the body's frame at the end of the span, by which a unit of the
    unknown turns the result.
    """
    place = np.concatenate([np.zeros(0, np.int_), *(np.arange(a, b) for a, b in spans)])
    ends = np.cumsum(spans[:, 1] - spans[:, 0])
    groups, turns = _groups(ends), []
    for first, last in groups:
        turns.append(_pair(_magnus(rate, time, place[_steps(ends, first, last)])[0]))
    a, b = (np.concatenate(part) for part in zip(*turns, strict=True))
    whole, behind = _products((a, b), ends, sloped=slopes.shape[2] > 0)
    found = np.ascontiguousarray(_matrix(whole).transpose(2, 0, 1))
    S = np.zeros((len(spans), 3, slopes.shape[2]))
    if behind is None:
        return found, S
    for first, last in groups:
        own = _steps(ends, first, last)
        here = behind[0][own], behind[1][own]
        before, after = _weights(here, *_magnus(rate, time, place[own]))
        end = 0
        for k in range(first, last):
            begin, (left, right) = end, spans[k]
            end += right - left
            part = np.zeros((3, 3, right - left + 1))
            part[:, :, :-1] += before[:, :, begin:end]
            part[:, :, 1:] += after[:, :, begin:end]
            S[k] = sum(part[:, j] @ slopes[left : right + 1, j] for j in range(3))
    return found, S


def steps(rate: Array, time: Array) -> tuple[Array, Array, Array, Array]:
    """Length (N - 1,) of each step of a record, rotation in it, and what a small rate at its
    beginning and at its end turns that by, in the frame of its end: (N - 1, 3, 3) each.

    Of neighbours that do not belong together what comes out means nothing.
    """
    phi, h, w0, w1 = _magnus(rate, time, np.arange(len(rate) - 1))
    own = _weights(_pair(np.zeros_like(phi)), phi, h, w0, w1)
    before, after = (np.ascontiguousarray(w.transpose(2, 0, 1)) for w in own)
    return h, exponential(phi.T), before, after


def _groups(ends: Array) -> list[tuple[int, int]]:
    """Spans first to last, one after the other, of together TOGETHER steps at most, or one."""
    found, first = [], 0
    for k in range(1, len(ends) + 1):
        begin = ends[first - 1] if first else 0
        if k == len(ends) or ends[k] - begin > TOGETHER:
            found.append((first, k))
            first = k
    return found


def _steps(ends: Array, first: int, last: int) -> slice:
    """Steps of some spans."""
    return slice(ends[first - 1] if first else 0, ends[last - 1])


def _magnus(rate: Array, time: Array, place: NDArray[np.int_]) -> tuple[Array, Array, Array, Array]:
    """Rotation vectors (3, N) of steps, their lengths (N,), and the rates (3, N) at both ends."""
    h = time[place + 1] - time[place]
    w0, w1 = np.ascontiguousarray(rate[place].T), np.ascontiguousarray(rate[place + 1].T)
    return 0.5 * h * (w0 + w1) + h**2 / 12 * _crossed(w0, w1), h, w0, w1


def _weights(behind: Pair, phi: Array, h: Array, w0: Array, w1: Array) -> tuple[Array, Array]:
    """What a small rate before and after each step turns the whole by, (3, 3, N) each.

    S = Σ M_i ∂φ_i with ∂φ_i = (h/2 − h²/12 [ω₁]×) ∂ω₀ + (h/2 + h²/12 [ω₀]×) ∂ω₁.
    """
    M = _through_jacobian(_matrix(behind).transpose(1, 0, 2), phi)
    half, twelfth = 0.5 * h * M, h**2 / 12 * M.transpose(1, 0, 2)
    before, after = _crossed(twelfth, w1), _crossed(twelfth, w0)
    return half - before.transpose(1, 0, 2), half + after.transpose(1, 0, 2)


def _products(steps: Pair, ends: Array, *, sloped: bool) -> tuple[Pair, Pair | None]:
    """Product of each span's rotations (K,), and what is turned after each step (N,) if `sloped`.

    `ends` (K,): where each span ends among the steps. First within pieces, all side by side, then
    from piece to piece.
    """
    starts = np.concatenate([[0], ends[:-1]])
    counts = -(-(ends - starts) // PIECE)
    owner = np.repeat(np.arange(len(ends)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    place = starts[owner] + number * PIECE + np.arange(PIECE)[:, None]
    there = place < ends[owner]
    place = np.where(there, place, 0)
    a, b = (np.where(there, part[place], none) for part, none in zip(steps, (1, 0), strict=True))
    piece, within = _from_the_end((a, b))
    size = int(counts.max(initial=0)), len(ends)
    table = np.ones(size, complex), np.zeros(size, complex)
    for part, own in zip(table, piece, strict=True):
        part[number, owner] = own
    whole, pieces = _from_the_end(table)
    if not sloped:
        return whole, None
    behind = _after(within, (pieces[0][number, owner], pieces[1][number, owner]))
    return whole, (behind[0].T[there.T], behind[1].T[there.T])


def _from_the_end(steps: Pair) -> tuple[Pair, Pair]:
    """Product of each column of rotations (L, K), (K,), and that of what is behind each (L, K)."""
    a, b = np.empty_like(steps[0]), np.empty_like(steps[1])
    product = np.ones(a.shape[1], complex), np.zeros(a.shape[1], complex)
    for k in range(len(a) - 1, -1, -1):
        a[k], b[k] = product
        product = _after((steps[0][k], steps[1][k]), product)
    return product, (a, b)


def _after(first: Pair, second: Pair) -> Pair:
    """One rotation and then, in its frame, another."""
    (a, b), (c, d) = first, second
    return a * c - b * d.conj(), a * d + b * c.conj()


def _pair(phi: Array) -> Pair:
    """Rotations of rotation vectors (3, N): cos(φ/2) − i·sin(φ/2)·(σ·axis), its first row."""
    square, safe, small = _squares(phi)
    half = 0.5 * np.sqrt(safe)
    series = 0.5 * _series(0.25 * square, 1.0, 6.0, 20.0, 42.0)
    x, y, z = np.where(small, series, 0.5 * np.sin(half) / half) * phi
    cosine = np.cos(0.5 * np.sqrt(square))
    return cosine - 1j * z, -y - 1j * x


def _matrix(rotation: Pair) -> Array:
    """Rotation matrices (3, 3, N)."""
    a, b = rotation
    w, x, y, z = np.sqrt(2) * np.array([a.real, -b.imag, -b.real, -a.imag])
    xx, yy, zz = x * x, y * y, z * z
    return np.array([
        [1 - yy - zz, x * y - w * z, x * z + w * y],
        [x * y + w * z, 1 - xx - zz, y * z - w * x],
        [x * z - w * y, y * z + w * x, 1 - xx - yy],
    ])  # fmt: skip


def _crossed(a: Array, b: Array) -> Array:
    """a × b, axes first, of whatever else there is behind them."""
    return np.array([a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))])


def exponential(phi: Array) -> Array:
    """Rotations exp([φ]×), (N, 3, 3), of rotation vectors (N, 3)."""
    return np.ascontiguousarray(_matrix(_pair(phi.T)).transpose(2, 0, 1))


def right_jacobian(phi: Array) -> Array:
    """J_r (N, 3, 3): exp([φ + δ]×) = exp([φ]×)·exp([J_r δ]×) to first order in δ."""
    same = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, len(phi)))
    return np.ascontiguousarray(_through_jacobian(same, phi.T).transpose(2, 0, 1))


def _through_jacobian(M: Array, phi: Array) -> Array:
    """M·J_r, (3, 3, N), of M (3, 3, N) and φ (3, N).

    J_r = I − c·[φ]× + d·[φ]×² with [φ]×² = φφᵀ − |φ|²·I; of a row m that is m − c·m × φ + ….
    """
    square, safe, small = _squares(phi)
    angle = np.sqrt(safe)
    cosine = np.where(small, _series(square, 0.5, 12.0, 30.0, 56.0), (1 - np.cos(angle)) / safe)
    sine = np.where(
        small, _series(square, 1 / 6, 20.0, 42.0, 72.0), (1 - np.sin(angle) / angle) / safe
    )
    columns = M.transpose(1, 0, 2)
    along = columns[0] * phi[0] + columns[1] * phi[1] + columns[2] * phi[2]
    found = (1 - sine * square) * columns - _crossed(columns, cosine * phi)
    found += along * (sine * phi)[:, None]
    return np.asarray(found.transpose(1, 0, 2))


def _squares(phi: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Squared angles, the same with ones where they are small, and where that is."""
    square = np.sum(phi**2, axis=0)
    small = square < _SMALL
    return square, np.where(small, 1.0, square), small


def _series(x: Array, first: float, *over: float) -> Array:
    """first·(1 − x/a·(1 − x/b·(1 − x/c))): the even series of sine and its like."""
    value = np.ones_like(x)
    for k in reversed(over):
        value = 1 - x / k * value
    return first * value


def skew(v: Array) -> Array:
    """[v]× of vectors (N, 3), (N, 3, 3)."""
    return np.ascontiguousarray(_skew(v.T).transpose(2, 0, 1))


def _skew(v: Array) -> Array:
    """The same, (3, 3, N) of (3, N)."""
    (x, y, z), zero = v, np.zeros(v.shape[1])
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
