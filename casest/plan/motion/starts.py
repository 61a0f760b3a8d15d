"""Where the search for a motion begins: random inputs within their limits."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.plan.motion.limits import Limit
from casest.plan.motion.program import Task

#: Sines of a random input, and periods of the slowest and the fastest in the whole motion.
SINES, PERIODS = 3, (1.0, 8.0)
#: Share of a limit that a random curve takes; steps in which a state is led to its own.
TAKEN, BACK = 0.9, 4.0


def random_inputs(task: Task, rng: np.random.Generator) -> Array:
    """Inputs (P, k) at knots: smooth random ones, those that can hold limited states hold them."""
    u = np.zeros((len(task.grid.knots), task.wide))
    for limit in (limit for limit in task.limits if limit.of in task.columns and not limit.rate):
        own = task.columns[limit.of]
        rates = [r for r in task.limits if r.rate and r.of == limit.of]
        u[:, own] = _random(limit, rates, task, own.stop - own.start, rng)
    return _holding(task, u, rng)


def _random(
    limit: Limit, rates: list[Limit], task: Task, size: int, rng: np.random.Generator
) -> Array:
    """A smooth random curve (P, size) within its limits."""
    t, duration = task.grid.knots, task.grid.time[-1]
    frequency = 2 * np.pi / duration * rng.uniform(*PERIODS, (size, SINES))
    phase = rng.uniform(0, 2 * np.pi, (size, SINES))
    curve = np.sin(t[:, None, None] * frequency + phase).sum(axis=2)
    if limit.length is None:
        middle, half = 0.5 * (limit.low + limit.high), 0.5 * (limit.high - limit.low)
        curve = middle + TAKEN * half * curve / np.abs(curve).max()
    else:
        curve *= TAKEN * limit.length / np.linalg.norm(curve, axis=1).max()
    for rate in rates if len(t) > 1 else []:
        share = rate.share(np.diff(curve, axis=0) / (t[1] - t[0]))
        middle = curve.mean(axis=0)
        curve = middle + (curve - middle) * min(1.0, TAKEN / share)
    return np.asarray(curve)


def _holding(task: Task, u: Array, rng: np.random.Generator) -> Array:
    """The same inputs with the least change that leads limited states along random curves."""
    held = _held(task)
    if held is None or task.grid.held:
        return u
    rows, slope, steering = held
    u, every = u.copy(), len(task.grid.time) // max(len(u) - 1, 1)
    x, h = task.model.start, task.grid.step
    where = task.model.slices()
    led = [limit for limit in task.limits if not limit.rate and limit.of in where]
    ways = [_random(limit, [], task, task.model[limit.of].size, rng) for limit in led]
    way = np.hstack(ways)
    for k in range(len(u)):
        if k:
            u[k, steering] = u[k - 1, steering]
            guess = _after(task, x, u[k - 1], u[k], every)
        else:
            guess = x
        f, J = (np.array(part) for part in slope(guess, u[k]))
        wanted = (way[k] - guess[rows]) / (BACK * h) - f.ravel()
        u[k, steering] += np.linalg.lstsq(J[:, steering], wanted, rcond=None)[0]
        x = _after(task, x, u[k - 1], u[k], every) if k else x
    return u


def _after(task: Task, x: Array, first: Array, last: Array, every: int) -> Array:
    """The state after so many intervals with inputs on a straight line."""
    for i in range(every):
        a, b = (first + (last - first) * (i + e) / every for e in (0, 1))
        x = np.asarray(task.move(x, a, b)).ravel()
    return x


def _held(task: Task) -> tuple[list[int], ca.Function, list[int]] | None:
    """Rows of the limited states whose rates inputs can set at will, their rates and slopes, and
    the inputs that do."""
    where = task.model.slices()
    rows = [
        i
        for limit in task.limits
        if not limit.rate and limit.of in where
        for i in range(where[limit.of].start, where[limit.of].stop)
    ]
    if not rows or not task.wide:
        return None
    x, u = ca.SX.sym("x", task.model.size), ca.SX.sym("u", task.wide)
    rate = task.rate(x, u)[0][rows]
    slope = ca.Function("slope", [x, u], [rate, ca.densify(ca.jacobian(rate, u))])
    J = np.array(slope(task.model.start, np.zeros(task.wide))[1])
    steering = [int(i) for i in np.flatnonzero(np.abs(J).sum(axis=0))]
    return (rows, slope, steering) if np.linalg.matrix_rank(J) == len(rows) else None
