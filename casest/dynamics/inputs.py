"""Measured inputs as they most likely were: noise of a gyro at rest is no rotation.

Where an input enters A(t) or C(t), its noise would be counted as motion, and motion is what tells
states apart: an errors-in-variables problem, in which the input is an unknown with a reading of its
own. Its Gauss-Newton step linearises at an estimate û of the input, not at its reading u,
f(x) ≈ f(x̄, u) + A(x̄, û)(x − x̄) − G(x̄)·noise: exact where û is the truth, for any x̄ that does not
know the noise to come. What û is wrong by acts on the error of the state, as the noise of a
bilinear system does (Wonham 1968).

û keeps what stands out of the noise: in the directions in which the input moves at all, octave by
octave of its frequencies, shrunk by what noise adds to it (James & Stein 1961; blockwise: Cai
1999). What does not stand out is zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from itertools import pairwise

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.data.timing import longest
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.samples import by_rows
from casest.dynamics.stepping import Pattern, entries
from casest.engine import Columns, Replay, evaluated

#: Chance that noise alone stands out, for each octave of each direction.
FALSE_ALARM = 1e-5
#: Samples below which noise is not told from motion; share of an input that may be rounding.
SHORTEST, ROUNDING = 16, 1e-6
#: Sum of the squared coefficients of a fourth difference.
_FOURTH = 70.0
#: Median of χ² with one degree of freedom: noise is told by a median, which no line moves.
_MEDIAN = 0.4549


def coefficients_of(model: Dynamics) -> tuple[str, ...]:
    """Inputs that A or C depend on, but for rotations: their noise could be taken for motion."""
    t = model.traced
    slopes = ca.vertcat(ca.vec(t.A), ca.vec(t.C))
    return tuple(
        s.name
        for s in model.signals
        if s.kind != "rotation"
        and s.name not in model.exact
        and s.name not in t.measured
        and ca.depends_on(slopes, flat(t.symbols[s.name]))
    )


def uncertain(model: Dynamics) -> tuple[str, ...]:
    """Those of them whose noise is known."""
    return tuple(n for n in coefficients_of(model) if model.sensors.get(n))


def estimates(
    model: Dynamics, run: Run, noise: Mapping[str, Array] | None = None
) -> dict[str, Array]:
    """Every uncertain input as it most likely was, (N, k), by name.

    `noise`: what all readings say that each was more than it was read, (N, k); no more noise is
    then looked for in it than was stated.
    """
    noise = noise or {}
    return {name: estimated(model, run, name, noise.get(name)) for name in uncertain(model)}


def estimated(model: Dynamics, run: Run, name: str, noise: Array | None = None) -> Array:
    """An input as it most likely was, (N, k); on each side of a gap apart. See `estimates`."""
    time, values = run.clock(name), run.recorded(name)
    if noise is not None:
        every = np.asarray(run.time, float)
        values = values + np.column_stack([np.interp(time, every, part) for part in noise.T])
    step = np.diff(time)
    gap = longest(step)
    usual, gaps = float(np.mean(step[step <= gap])), np.flatnonzero(step > gap) + 1
    variance = model.sensors.get(name, 0.0) / usual
    own = np.concatenate(
        [estimate(part, variance, shown=noise is None) for part in np.split(values, gaps)]
    )
    return own if len(own) == len(run) else _between(model, name, run, time, own)


def _between(model: Dynamics, name: str, run: Run, time: Array, values: Array) -> Array:
    """What an input was at its own samples, at all of the run's: a straight line, or held."""
    every = np.asarray(run.time, float)
    if next(s.held for s in model.signals if s.name == name):
        return np.asarray(values[np.clip(np.searchsorted(time, every, "right") - 1, 0, None)])
    return np.column_stack([np.interp(every, time, part) for part in values.T])


def as_read(model: Dynamics, run: Run) -> dict[str, Array]:
    """Every uncertain input as it was read: the estimate of one who does not know the record."""
    return {name: run.signals[name] for name in uncertain(model)}


def estimate(values: Array, variance: float = 0.0, *, shown: bool = True) -> Array:
    """Readings (N, k) without their white noise: of that `variance`, or what they show if more,
    if what is `shown` is to be taken for noise."""
    from scipy.fft import dct, idct

    c = np.asarray(dct(values, axis=0, norm="ortho"), float)
    size = max(variance, scatter(values) ** 2 if shown else 0.0)
    if not size > 0:
        return values
    octaves, kept = _octaves(len(c)), np.zeros(len(c), dtype=bool)
    for where in octaves:
        kept[where] = _shares(c[where].reshape(-1, 1), size)[0] > 0
    _, axes = np.linalg.eigh(c[kept].T @ c[kept])
    turned = c @ axes
    for where in octaves:
        turned[where] *= _shares(turned[where], size)
    return np.asarray(idct(turned @ axes.T, axis=0, norm="ortho"), float)


def scatter(values: Array) -> float:
    """Standard deviation of white noise in readings (N, k).

    The smaller one of two: by the upper half of their spectrum, which the ends of a smooth curve
    reach, and by their fourth differences, which a fast line reaches.
    """
    from scipy.fft import dct

    upper = dct(values, axis=0, norm="ortho")[len(values) // 2 :]
    if len(values) < SHORTEST:
        return 0.0
    spectral = float(np.sqrt(np.median(upper**2) / _MEDIAN))
    differences = float(np.sqrt(np.median(np.diff(values, 4, axis=0) ** 2) / _MEDIAN / _FOURTH))
    return differences if differences < 0.5 * spectral else spectral


def unstated(model: Dynamics, run: Run) -> dict[str, float]:
    """Standard deviation of the noise, by the record itself, of inputs of which nobody stated it.

    Of those alone that A or C depend on; nothing where it is no more than rounding.
    """
    found = {n: scatter(run.recorded(n)) for n in coefficients_of(model) if n not in model.sensors}
    return {
        name: std
        for name, std in found.items()
        if std > ROUNDING * float(np.sqrt(np.mean(run.signals[name] ** 2)))
    }


def smallest(std: float, count: int) -> float:
    """The least constant value that stands out of `count` readings with noise `std`."""
    from scipy.special import chdtri

    return std * float(np.sqrt(chdtri(1, FALSE_ALARM) / count))


def _octaves(count: int) -> list[slice]:
    """The mean, then twice as many frequencies each."""
    edges = [0, *(2**k for k in range(count.bit_length()) if 2**k < count), count]
    return [slice(a, b) for a, b in pairwise(edges)]


def _shares(c: Array, variance: float) -> Array:
    """What share of each column (L, k) is kept: none where noise may explain it all."""
    from scipy.special import chdtri

    squares = np.sum(c**2, axis=0) / variance
    left = 1 - len(c) / np.maximum(squares, 1e-300)
    return np.where(squares > chdtri(len(c), FALSE_ALARM), left, 0.0)


def at_estimates(model: Dynamics, expressions: list[SX]) -> tuple[list[SX], list[SX]]:
    """Expressions at the estimates of the uncertain inputs, and the symbols of these."""
    read = {name: flat(model.traced.symbols[name]) for name in uncertain(model)}
    as_was = [ca.SX.sym(name, e.numel()) for name, e in read.items()]
    return ca.substitute(expressions, list(read.values()), as_was), as_was


def slopes(model: Dynamics) -> Iterator[tuple[str, SX]]:
    """∂A/∂u (n, n) of every number of every uncertain input."""
    t, n = model.traced, model.size
    for name in uncertain(model):
        u = flat(t.symbols[name])
        for k in range(u.numel()):
            yield name, ca.reshape(ca.jacobian(ca.vec(t.A), u[k]), n, n)


def on_errors(model: Dynamics, run: Run, along: Array, P: Array) -> Array:
    """What the noise of uncertain inputs adds to Ξ by acting on the errors of states, (N, n, n).

    Σq·N·P·Nᵀ with N = ∂A/∂u; `along` (N, n), P (N, n, n) of these errors.
    """
    return whole(model, on_errors_alone(model, run, along, P))


def on_errors_alone(model: Dynamics, run: Run, along: Array, P: Array) -> Array:
    """The same, what can differ from zero alone: (N, …), as `whole` takes it."""
    columns = [np.ascontiguousarray(along), *(run.signals[s.name] for s in model.signals)]
    columns.append(np.ascontiguousarray(P).reshape(len(P), P.shape[1] * P.shape[2]))
    intensities = np.array([model.sensors[name] for name, _ in slopes(model)])
    return np.asarray(evaluated(_acting(model), intensities, Columns(columns))[0])[:, :, 0]


def whole(model: Dynamics, alone: Array) -> Array:
    """Symmetric matrices (N, n, n) of what can differ from zero of them."""
    found = np.zeros((len(alone), model.size, model.size))
    rows, columns = np.array(_reached(model), int).reshape(-1, 2).T
    found[:, rows, columns] = found[:, columns, rows] = alone
    return found


@lru_cache(maxsize=8)
def _acting(model: Dynamics) -> Replay:
    """Σq·N·P·Nᵀ at a sample, what can differ from zero of its upper half; q are its parameters."""
    t, P = model.traced, ca.SX.sym("P", model.size, model.size)
    added, q = _added(model, P)
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in model.signals], by_rows(P))
    found = ca.vertcat(*[added[i, j] for i, j in _reached(model)])
    return Replay(ca.Function("acting", [q, sample], [ca.densify(found)],
                              ["parameters", "sample"], ["Xi"]))  # fmt: skip


@lru_cache(maxsize=8)
def _reached(model: Dynamics) -> Pattern:
    return entries(ca.triu(_added(model, ca.SX.sym("P", model.size, model.size))[0]))


def _added(model: Dynamics, P: SX) -> tuple[SX, SX]:
    every = [slope for _, slope in slopes(model)]
    q = ca.SX.sym("q", len(every))
    return sum((q[k] * (N @ P @ N.T) for k, N in enumerate(every)), ca.SX(*P.shape)), q
