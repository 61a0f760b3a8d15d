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
    h = (time[place + 1] - time[place])[:, None]
    w0, w1 = rate[place], rate[place + 1]
    phi = 0.5 * h * (w0 + w1) + h**2 / 12 * np.cross(w0, w1)
    R, behind = _products(exponential(phi), ends)
    if not slopes.shape[2]:
        return R, np.zeros((len(spans), 3, 0))
    # S = Σ M_i ∂φ_i with ∂φ_i = (h/2 − h²/12 [ω₁]×) ∂ω₀ + (h/2 + h²/12 [ω₀]×) ∂ω₁.
    M = behind.transpose(0, 2, 1) @ right_jacobian(phi)
    half, twelfth = 0.5 * h[:, :, None] * M, h[:, :, None] ** 2 / 12 * M
    before, after = half - twelfth @ skew(w1), half + twelfth @ skew(w0)
    S = np.zeros((len(spans), 3, slopes.shape[2]))
    for k, (a, b) in enumerate(spans):
        own = slice(ends[k] - (b - a), ends[k])
        part = np.zeros((b - a + 1, 3, 3))
        part[:-1] += before[own]
        part[1:] += after[own]
        S[k] = np.tensordot(part, slopes[a : b + 1], axes=([0, 2], [0, 1]))
    return R, S


def _products(steps: Array, ends: Array) -> tuple[Array, Array]:
    """Product of each span's rotations (K, 3, 3), and what is turned after each step (N, 3, 3).

    `ends` (K,): where each span ends among the steps. First within pieces, all side by side, then
    from piece to piece.
    """
    starts = np.concatenate([[0], ends[:-1]])
    counts = -(-(ends - starts) // PIECE)
    owner = np.repeat(np.arange(len(ends)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = starts[owner] + number * PIECE
    place = first[:, None] + np.arange(PIECE)
    there = place < ends[owner][:, None]
    padded = np.where(there[:, :, None, None], steps[np.where(there, place, 0)], np.eye(3))
    whole, within = _from_the_end(padded)
    table = np.broadcast_to(np.eye(3), (len(ends), int(counts.max(initial=0)), 3, 3)).copy()
    table[owner, number] = whole
    products, pieces = _from_the_end(table)
    behind = within @ pieces[owner, number][:, None]
    return products, behind[there]


def _from_the_end(steps: Array) -> tuple[Array, Array]:
    """Product of each row of rotations (K, L, 3, 3), (K, 3, 3), and that of what is behind each."""
    product = np.broadcast_to(np.eye(3), (len(steps), 3, 3)).copy()
    behind = np.empty_like(steps)
    for k in range(steps.shape[1] - 1, -1, -1):
        behind[:, k] = product
        product = steps[:, k] @ product
    return product, behind


def exponential(phi: Array) -> Array:
    """Rotations exp([φ]×), (N, 3, 3), of rotation vectors (N, 3)."""
    square, safe, small = _squares(phi)
    angle = np.sqrt(safe)
    sine = np.where(small, _series(square, 1.0, 6.0, 20.0, 42.0), np.sin(angle) / angle)
    cosine = np.where(small, _series(square, 0.5, 12.0, 30.0, 56.0), (1 - np.cos(angle)) / safe)
    return _combined(phi, square, sine, cosine)


def right_jacobian(phi: Array) -> Array:
    """J_r (N, 3, 3): exp([φ + δ]×) = exp([φ]×)·exp([J_r δ]×) to first order in δ."""
    square, safe, small = _squares(phi)
    angle = np.sqrt(safe)
    cosine = np.where(small, _series(square, 0.5, 12.0, 30.0, 56.0), (1 - np.cos(angle)) / safe)
    sine = np.sin(angle) / angle
    cubic = np.where(small, _series(square, 1 / 6, 20.0, 42.0, 72.0), (1 - sine) / safe)
    return _combined(phi, square, -cosine, cubic)


def _squares(phi: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Squared angles, the same with ones where they are small, and where that is."""
    square = np.sum(phi**2, axis=1)
    small = square < _SMALL
    return square, np.where(small, 1.0, square), small


def _combined(phi: Array, square: Array, one: Array, two: Array) -> Array:
    """I + one·[φ]× + two·[φ]×², where [φ]×² = φφᵀ − |φ|²·I."""
    found = skew(one[:, None] * phi) + (two[:, None] * phi)[:, :, None] * phi[:, None, :]
    diagonal = 1 - two * square
    for k in range(3):
        found[:, k, k] += diagonal
    return np.asarray(found)


def _series(x: Array, first: float, *over: float) -> Array:
    """first·(1 − x/a·(1 − x/b·(1 − x/c))): the even series of sine and its like."""
    value = np.ones_like(x)
    for k in reversed(over):
        value = 1 - x / k * value
    return first * value


def skew(v: Array) -> Array:
    """[v]× of vectors (N, 3), (N, 3, 3)."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
