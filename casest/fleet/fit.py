"""Levenberg-Marquardt for many sensors side by side, each with its own damping and its own end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.fleet.linear import backward, cholesky, dot, forward, times, whole
from casest.fleet.sums import NARROWEST, Normals, Sensors, Squares
from casest.solve.trust_region import LITTLE

#: Iterations after which a sensor is given up.
LIMIT = 100
#: Squared last step, and squared step expected after it, in variances of the estimate; and the
#: squared step that is small enough without looking at the one before.
LAST, NEXT, SMALL = 1e-6, 2.5e-13, 1e-14
#: The same below which a step is rounding, as a share of the unknowns themselves.
ROUNDING = 1e-29
#: Squared step, in variances of the estimate, after which JᵀJ may stay what it was: in triads of 24
#: poses the standard deviations then differ by up to 3.5e-4 of themselves, half of them by 6e-6.
NEARBY = 0.01
#: Share of the sensors from which on all are looked at: to pick them out takes longer.
MOST = 0.9

Places = NDArray[np.int_]
Flags = NDArray[np.bool_]


class Bounds(NamedTuple):
    """Lower and upper bound of every unknown of every sensor, (n, W)."""

    lower: Array
    upper: Array

    def inside(self, x: Array) -> Array:
        """The unknowns, moved strictly inside where they are not (as in `stack.Problem`)."""
        if ((x > self.lower) & (x < self.upper)).all():
            return x
        both = np.isfinite(self.lower) & np.isfinite(self.upper)
        width = np.where(both, self.upper - self.lower, np.inf)
        margin = np.minimum(1e-8 * np.maximum(1.0, np.abs(x)), 0.1 * width)
        x = np.where(x <= self.lower, self.lower + margin, x)
        return np.where(x >= self.upper, self.upper - margin, x)

    def some(self, chosen: Places) -> Bounds:
        """Those of the sensors at these places."""
        return Bounds(self.lower[:, chosen], self.upper[:, chosen])


class Fits(NamedTuple):
    """Where W sensors ended: unknowns (n, W), cost (W,), JᵀJ (n, n, W; lower triangle).

    `left` (W,): squared length of the last step, in residuals: gᵀ(JᵀJ)⁻¹g. `shrink` (W,): its
    ratio to the step before, not squared.
    """

    x: Array
    cost: Array
    matrix: Array
    left: Array
    shrink: Array

    def some(self, chosen: Places) -> Fits:
        """Those of the sensors at these places."""
        return Fits(*(part[..., chosen] for part in self))


@dataclass
class _State:
    """Sensors that still move; arrays with the sensor axis last."""

    place: Places
    sensors: Sensors
    bounds: Bounds
    freedom: Array
    x: Array
    here: Normals
    damping: Array
    growth: Array
    before: Array

    def some(self, chosen: Places) -> _State:
        return _State(
            self.place[chosen],
            self.sensors.some(chosen),
            self.bounds.some(chosen),
            self.freedom[chosen],
            self.x[:, chosen],
            Normals(*(part[..., chosen] for part in self.here)),
            self.damping[chosen],
            self.growth[chosen],
            self.before[chosen],
        )


def padded(chosen: Places) -> Places:
    """The places, the last repeated up to a multiple of NARROWEST."""
    missing = -len(chosen) % NARROWEST
    return np.concatenate([chosen, np.full(missing, chosen[-1])]) if missing else chosen


def minimise(
    squares: Squares, sensors: Sensors, start: Array, bounds: Bounds, *, near: bool
) -> Fits:
    """Minimise every sensor's cost from its start (n, W). `near`: starts are near the solutions."""
    n, width = start.shape
    state = _State(
        np.arange(width),
        sensors,
        bounds,
        np.maximum(residual_counts(squares, sensors) - n, 1.0),
        start,
        squares.normals(start, sensors),
        np.full(width, LITTLE if near else 1e-3),
        np.full(width, 2.0),
        np.full(width, np.inf),
    )
    found: Fits | None = None
    for _ in range(LIMIT):
        step, left, factor = _steps(state)
        settled = _settled(state, left)
        ended = settled | ~np.isfinite(left) | (state.damping > 1e12)
        if ended.any():
            found = _kept(found, state, step, left, settled, ended)
        nearby = _nearby(state, step, left) & ~ended
        if nearby.any():
            found, done = _finished(squares, found, state, step, left, factor, nearby)
            ended |= done
        going = np.flatnonzero(~ended)
        if not going.size and found is not None:
            return found
        if going.size < len(ended):
            going = padded(going)
            state, step, left = state.some(going), step[:, going], left[going]
        _move(squares, state, step, left)
    return _kept(found, state, step, left, np.zeros(len(left), bool), np.ones(len(left), bool))


def _nearby(state: _State, step: Array, left: Array) -> Flags:
    """Is the next step so short that it changes next to nothing of JᵀJ?"""
    there = state.x + step
    inside = ((there > state.bounds.lower) & (there < state.bounds.upper)).all(axis=0)
    short = left <= NEARBY * 2 * state.here.cost / state.freedom
    return np.asarray(inside & short & (state.damping <= LITTLE))


def _finished(
    squares: Squares,
    found: Fits | None,
    state: _State,
    step: Array,
    left: Array,
    factor: Array,
    nearby: Flags,
) -> tuple[Fits, Flags]:
    """With the sensors for which the step after this one, by the JᵀJ that there is, is the last.

    Its gradient is a sixth of the work of new normal equations. The others go on as if nothing had
    been asked.
    """
    k = np.flatnonzero(nearby)
    if k.size >= MOST * len(nearby):
        k = np.arange(len(nearby))
    else:
        if found is None:  # room for all
            found = _kept(None, state, step, left, nearby, nearby)
        k = padded(k)
        state, step, left, factor = state.some(k), step[:, k], left[k], factor[:, :, k]
    x = state.x + step
    cost, slope = squares.slope(x, state.sensors)
    fall = state.here.cost - cost
    better = (fall > 0) | _alike(state, fall, left)
    there = replace(state, x=x, here=Normals(cost, state.here.rows), before=left)
    half = forward(factor, slope)
    step, left = -backward(factor, half), dot(half, half)
    x = x + step
    inside = ((x > state.bounds.lower) & (x < state.bounds.upper)).all(axis=0)
    done = nearby[k] & better & inside & _settled(there, left)
    flags = np.zeros(len(nearby), bool)
    flags[k[done]] = True
    if found is None or done.any():
        found = _kept(found, there, step, left, done, done)
    return found, flags


def residual_counts(squares: Squares, sensors: Sensors) -> Array:
    """Number of residuals of every sensor, (W,)."""
    _, samples, width = sensors.samples.shape
    if sensors.mask is None:
        return np.full(width, float(samples * squares.residual_count))
    return np.asarray(sensors.mask.sum(axis=0) * squares.residual_count)


def _settled(state: _State, left: Array) -> Flags:
    """Is the next step, were it taken, nothing that the data could tell?"""
    variance = 2 * state.here.cost / state.freedom
    # Steps shrink by a factor; the first one says nothing about it.
    expected = left * np.minimum(left / state.before, 1.0)
    # Steps that shrink slowly soon shrink by the slowest direction alone: they must be small.
    quick = (left <= LAST * variance) & (left <= 1e-4 * state.before) & np.isfinite(state.before)
    fine = (quick & (expected <= NEXT * variance)) | (left <= SMALL * variance)
    fine &= state.damping <= 1e-3
    reach = np.einsum("iis,is->s", state.here.matrix, state.x**2)
    return np.asarray(fine | (left <= ROUNDING * reach))


def _kept(
    found: Fits | None, state: _State, step: Array, left: Array, settled: Flags, ended: Flags
) -> Fits:
    """What was found, with the sensors that ended, after their last step if they settled.

    The first to end come with all others, whose places are written over when they end.
    """
    ratio = np.where(np.isfinite(state.before), np.sqrt(left / state.before), 1.0)
    now = Fits(
        np.where(settled, state.x + step, state.x),
        np.where(settled, state.here.cost - 0.5 * left, state.here.cost),
        state.here.matrix,
        left,
        ratio,
    )
    if found is None:
        return now
    k = np.flatnonzero(ended)
    for part, own in zip(found, now.some(k), strict=True):
        part[..., state.place[k]] = own
    return found


def _steps(state: _State) -> tuple[Array, Array, Array]:
    """Damped step (n, W) within the bounds, its squared length in residuals (W,), and the
    Cholesky factor (n, n, W) that it was made with."""
    n = len(state.x)
    diagonal = np.einsum("iis->is", state.here.matrix)
    ridge = state.damping * np.where(diagonal > 0, diagonal, 1.0)  # a nil column stays out
    factor = cholesky(state.here.rows, ridge)
    half = factor[n]
    step = -backward(factor[:n], half)
    left = dot(half, half)
    target = state.x + step
    out = (target < state.bounds.lower) | (target > state.bounds.upper)
    over = np.flatnonzero(out.any(axis=0))
    if over.size:
        k = padded(over)
        part = _held_back(
            state.here.rows[:, :, k], ridge[:, k], state.x[:, k], state.bounds.some(k)
        )
        step[:, over], left[over] = (p[..., : over.size] for p in part)
    return step, left, factor[:n]


def _held_back(rows: Array, ridge: Array, x: Array, bounds: Bounds) -> tuple[Array, Array]:
    """The same where unknowns that would leave their bounds stop there."""
    n = len(x)
    matrix, slope = whole(rows[:n]), rows[n]
    matrix[range(n), range(n)] += ridge
    fixed, held = np.zeros(x.shape, bool), np.zeros(x.shape)
    for _ in range(n):
        free = ~fixed
        own = matrix * (free[:, None] & free[None])
        for i in range(n):
            own[i, i] += fixed[i]
        factor = cholesky(own)
        half = forward(factor, np.where(free, -slope - times(matrix, held), held))
        step = backward(factor, half)
        out = free & ((x + step < bounds.lower) | (x + step > bounds.upper))
        if not out.any():
            break
        held = np.where(out, np.clip(x + step, bounds.lower, bounds.upper) - x, held)
        fixed |= out
    left = dot(np.where(fixed, 0.0, half), np.where(fixed, 0.0, half))
    return np.clip(x + step, bounds.lower, bounds.upper) - x, left


def _alike(state: _State, fall: Array, left: Array) -> Flags:
    """Does the fall of the cost drown in rounding, as it does near the end?"""
    small = np.abs(fall) <= 1e-13 * state.here.cost
    return np.asarray((left <= 1e-6 * state.here.cost) & small)


def _move(squares: Squares, state: _State, step: Array, left: Array) -> None:
    """Take the steps that lower the cost; damp the others more."""
    trial = state.x + step
    there = squares.normals(trial, state.sensors)
    fall = state.here.cost - there.cost
    alike = _alike(state, fall, left)
    better = (fall > 0) | alike
    # With damping λ the model promises left/2 and λ‖z‖²/2 more, which is the smaller part.
    ratio = fall / np.maximum(0.5 * left, 1e-300)
    good = (np.abs(ratio - 1) < 0.01) | alike
    eased = state.damping * np.maximum(0.2, 1 - (2 * np.minimum(ratio, 2.0) - 1) ** 3)
    eased = np.where(good, state.damping * 1e-2, eased)
    state.damping = np.where(
        better, np.maximum(eased, LITTLE), np.maximum(state.damping * state.growth, 1e-3)
    )
    state.growth = np.where(better, 2.0, 2 * state.growth)
    state.before = np.where(better, left, state.before)
    if better.all():
        state.x, state.here = trial, there
        return
    state.x = np.where(better, trial, state.x)
    state.here = Normals(
        *(np.where(better, new, old) for new, old in zip(there, state.here, strict=True))
    )
