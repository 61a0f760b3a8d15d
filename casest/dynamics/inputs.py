"""Measured inputs as they most likely were: noise of a gyro at rest is no rotation.

Where an input enters A(t) or C(t), its noise would be counted as motion, and motion is what tells
states apart: an errors-in-variables problem, in which the input is an unknown with a reading of its
own. Its Gauss-Newton step linearises at an estimate of the input, not at its reading,
f(x, u) ≈ f(x̄, u) + A(x̄, û)(x − x̄) − G(x̄)·noise, and is consistent with any x̄ that does not know
the noise to come. The estimate û keeps what stands out of the noise: in the directions in which the
input moves at all, octave by octave of its frequencies, shrunk by what noise adds to it (James &
Stein 1961; Cai 1999, blockwise). What does not stand out is zero.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics

#: Chance that noise alone stands out, for each octave of each direction.
FALSE_ALARM = 1e-4
#: Median of χ² with one degree of freedom: noise is told by a median, which no line moves.
_MEDIAN = 0.4549


def coefficients_of(model: Dynamics) -> tuple[str, ...]:
    """Inputs that A or C depend on, rotations apart: those whose noise could be taken for motion."""
    t = model.traced
    slopes = ca.vertcat(ca.vec(t.A), ca.vec(t.C))
    return tuple(
        s.name
        for s in model.signals
        if s.kind != "rotation"
        and s.name not in t.measured
        and ca.depends_on(slopes, flat(t.symbols[s.name]))
    )


def uncertain(model: Dynamics) -> tuple[str, ...]:
    """Those of them whose noise is known."""
    return tuple(n for n in coefficients_of(model) if model.sensors.get(n))


def estimates(model: Dynamics, run: Run) -> Mapping[str, Array]:
    """Every uncertain input as it most likely was, (N, k), by name."""
    step = float(np.median(np.diff(np.asarray(run.time, float))))
    return {n: estimate(run.signals[n], model.sensors[n] / step) for n in uncertain(model)}


def estimate(values: Array, variance: float = 0.0) -> Array:
    """Readings (N, k) without their white noise of that `variance`, or more where they show more."""
    from scipy.fft import dct, idct

    c = np.asarray(dct(values, axis=0, norm="ortho"), float)
    size = max(variance, scatter(values) ** 2)
    if not size > 0:
        return values
    kept = np.zeros(len(c), dtype=bool)
    for where in _octaves(len(c)):
        kept[where] = bool(_shares(c[where].reshape(-1, 1), size)[0] > 0)
    _, axes = np.linalg.eigh(c[kept].T @ c[kept])
    turned = c @ axes
    for where in _octaves(len(c)):
        turned[where] *= _shares(turned[where], size)
    return np.asarray(idct(turned @ axes.T, axis=0, norm="ortho"), float)


def scatter(values: Array) -> float:
    """Standard deviation of white noise in readings (N, k), from the upper half of their spectrum."""
    from scipy.fft import dct

    upper = dct(values, axis=0, norm="ortho")[len(values) // 2 :]
    return float(np.sqrt(np.median(upper**2) / _MEDIAN)) if upper.size else 0.0


def _octaves(count: int) -> list[slice]:
    """The mean, then twice as many frequencies each."""
    edges = [0, *(2**k for k in range(count.bit_length()) if 2**k < count), count]
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def _shares(c: Array, variance: float) -> Array:
    """What share of each column (L, k) is kept: none where noise may explain it all."""
    from scipy.special import chdtri

    squares = np.sum(c**2, axis=0) / variance
    left = 1 - len(c) / np.maximum(squares, 1e-300)
    return np.where(squares > chdtri(len(c), FALSE_ALARM), left, 0.0)
