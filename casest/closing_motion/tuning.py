"""Noise intensities that a record itself asks for: maximum likelihood of the innovations.

Noise of inputs drives the states that they reach; other driven states keep an intensity of their
own. With published intensities that do not match the sensors every innovation would look wrong,
and nothing could be traced.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.stepping import CHUNK, reach
from casest.dynamics.transition import linearised, process_noise, steps_to, transitions
from casest.modelling.tracing import flat

Mask = NDArray[np.bool_]

#: Sum of the squared coefficients of a fourth difference.
_FOURTH = 70.0
#: An intensity is looked for within so many powers of e around where it begins.
RANGE = 14.0
#: Scoring: rounds, difference and largest step of a logarithm, gain in log-likelihood that ends it.
ROUNDS, STEP, LARGEST, ENOUGH = 30, 1e-3, 5.0, 0.1


@dataclass(frozen=True)
class Prepared:
    """A record made ready for many likelihoods: all that does not depend on the intensities.

    `units`: per intensity of a state or an input, what 1 of it adds before each sample, (N, n²);
    `readings`: per output signal, its rows; `numbers` (padded N, …): what each step is given, in
    which Q and R are filled in by every likelihood.
    """

    model: Dynamics
    present: Mask
    period: Array
    units: Mapping[str, Array]
    readings: Mapping[str, slice]
    numbers: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intensities: inputs and states, then outputs."""
        return (*self.units, *self.readings)

    def steps(self, intensities: Mapping[str, float]) -> Array:
        """What each step is given, with these intensities."""
        count, n, m = len(self.present), self.model.size, self.present.shape[1]
        Q = self.numbers[:count, n * n + n : n * n + n + n * n]
        Q[:] = 0.0
        for name, unit in self.units.items():
            Q += intensities[name] * unit
        last = self.numbers.shape[1] - 2 * m
        for name, rows in self.readings.items():
            R = self.numbers[:count, last + rows.start : last + rows.stop]
            R[:] = (intensities[name] / self.period)[:, None]
        self.numbers[count:] = self.numbers[count - 1]
        return self.numbers


def reached(model: Dynamics) -> tuple[list[str], list[str]]:
    """Inputs whose noise drives states, and driven states that no such noise reaches."""
    t = model.traced
    inputs, touched = [], np.zeros(model.size, dtype=bool)
    for s in model.signals:
        slope = ca.jacobian(t.f, flat(t.symbols[s.name]))
        if slope.nnz() and s.name not in t.measured:
            inputs.append(s.name)
            touched[list(set(slope.sparsity().get_triplet()[0]))] = True
    where = model.slices()
    own = [s.name for s in model.states if s.intensity > 0 and not touched[where[s.name]].any()]
    return inputs, own


def prepared(model: Dynamics, run: Run, along: Array) -> Prepared:
    """Along states (N, n), where the model or its noise depends on them."""
    inputs, own = reached(model)
    silent = model.driven(**{s.name: 0.0 for s in model.states})
    system = linearised(silent, run, along)
    Phi, forced = transitions(system)
    units = {}
    for name in (*inputs, *own):
        alone = silent.sensing(**{name: 1.0}) if name in inputs else silent.driven(**{name: 1.0})
        Q = process_noise(system, linearised(alone, run, along).process, Phi)
        units[name] = np.concatenate([0 * Q[:1], Q]).reshape(len(Q) + 1, -1)
    present = np.isfinite(system.y)
    C = np.where(present[:, :, None], system.C, 0.0)
    y = np.where(present, system.y - system.d, 0.0)
    readings, place = {}, 0
    for name, o in zip(model.traced.measured, model.traced.outputs, strict=True):
        readings[name] = slice(place, place + o.predicted.numel())
        place += o.predicted.numel()
    numbers = _assembled(Phi, forced, C, y)
    return Prepared(model, present, steps_to(system), units, readings, numbers)


def _assembled(Phi: Array, forced: Array, C: Array, y: Array) -> Array:
    """Φ, u, room for Q, C, room for R, y of every sample in a row, column by column; padded."""
    count, (m, n) = len(y), C.shape[1:]
    numbers = np.zeros((-(-count // CHUNK) * CHUNK, 2 * n * n + n + m * n + 2 * m))
    first = np.concatenate([np.eye(n)[None], Phi])
    numbers[:count, : n * n] = first.transpose(0, 2, 1).reshape(count, -1)
    numbers[1:count, n * n : n * n + n] = forced
    place = 2 * n * n + n
    numbers[:count, place : place + m * n] = C.transpose(0, 2, 1).reshape(count, -1)
    numbers[:count, -m:] = y
    return numbers


def whitened(ready: Prepared, intensities: Mapping[str, float]) -> tuple[Array, Array]:
    """Innovations component by component (N, m), each given those before it, and variances."""
    count, m = ready.present.shape
    model = ready.model
    step = _likelihood_step(model.size, m, reach(model.traced.A))
    found = _run(step, model.start, model.start_covariance, ready.steps(intensities), 2 * m)
    return found[:count, :m], found[:count, m:]


def likelihood(ready: Prepared, intensities: Mapping[str, float]) -> float:
    """Log-likelihood of the readings."""
    return _log_density(ready, *whitened(ready, intensities))


def _log_density(ready: Prepared, e: Array, s: Array) -> float:
    return float(-0.5 * np.sum((np.log(2 * np.pi * s) + e**2 / s)[ready.present]))


def matched(
    ready: Prepared, run: Run, start: Mapping[str, float] | None = None
) -> tuple[dict[str, float], float]:
    """The most likely intensities, and their log-likelihood: Fisher scoring of their logarithms."""
    names, guess = ready.names, first_guess(ready, run)
    middle = np.log([guess[name] for name in names])
    starts = [middle] + ([np.log([{**guess, **start}[n] for n in names])] if start else [])

    def at(where: Array) -> tuple[Array, Array, float]:
        e, s = whitened(ready, dict(zip(names, np.exp(where).tolist(), strict=True)))
        return e, s, _log_density(ready, e, s)

    logs, found = max(((x, at(x)) for x in starts), key=lambda pair: pair[1][2])
    damping = 1e-3
    for _ in range(ROUNDS):
        moved = [at(logs + STEP * unit) for unit in np.eye(len(names))]
        gradient, information = _scoring(ready.present, found, moved)
        while damping < 1e9:
            curved = information + damping * np.diag(np.diag(information) + 1.0)
            step = np.clip(np.linalg.solve(curved, gradient), -LARGEST, LARGEST)
            tried = np.clip(logs + step, middle - RANGE, middle + RANGE)
            promised = gradient @ (tried - logs)
            better = at(tried) if promised > ENOUGH else found
            if better[2] > found[2] or promised <= ENOUGH:
                break
            damping = max(10 * damping, 0.1)
        gained, damping = better[2] - found[2], damping / 10
        if gained > 0:
            logs, found = tried, better
        if gained < ENOUGH:
            break
    return dict(zip(names, np.exp(logs).tolist(), strict=True)), found[2]


def _scoring(
    present: Mask, found: tuple[Array, Array, float], moved: list[tuple[Array, Array, float]]
) -> tuple[Array, Array]:
    """Gradient and information, by differences of innovations e and their variances s.

    Of two logarithms: Σ(∂e·∂e/s + ½·∂s·∂s/s²).
    """
    e, s = found[0][present], found[1][present]
    of_e = np.array([(m[0][present] - e) / STEP / np.sqrt(s) for m in moved])
    of_s = np.array([(m[1][present] - s) / STEP / s for m in moved])
    gradient = of_s @ (e**2 / s - 1) / 2 - of_e @ (e / np.sqrt(s))
    return gradient, of_e @ of_e.T + 0.5 * of_s @ of_s.T


def first_guess(ready: Prepared, run: Run) -> dict[str, float]:
    """Of a signal: its fourth differences, where little but noise is left. Of a state: little."""
    model, guess = ready.model, {}
    stds = {s.name: s.std for s in model.states}
    intensities = {s.name: s.intensity for s in model.states}
    duration = float(np.sum(ready.period))
    for name in ready.names:
        if name in run.signals:
            values = run.signals[name]
            fourth = np.diff(values[np.isfinite(values).all(axis=1)], 4, axis=0)
            variance = float(np.median(fourth**2)) / 0.4549 / _FOURTH if len(fourth) else 0.0
            scale = 1e-12 * float(np.nanmean(values**2)) or 1e-12
            guess[name] = max(variance, scale) * float(np.median(ready.period))
        elif name.endswith("_colour"):
            guess[name] = intensities[name]
        else:
            guess[name] = 1e-6 * stds[name] ** 2 / duration
    return guess


def applied(model: Dynamics, intensities: Mapping[str, float]) -> Dynamics:
    """The model with these intensities, its states driven by nothing else."""
    states = {s.name: intensities.get(s.name, 0.0) for s in model.states}
    signals = {s.name: intensities[s.name] for s in model.signals if s.name in intensities}
    return model.driven(**states).sensing(**signals)


@lru_cache(maxsize=16)
def _likelihood_step(n: int, m: int, pattern: tuple[tuple[int, int], ...]) -> Any:
    """(state, numbers of one sample) -> (state, innovations and variances), CHUNK at a time."""
    x, P = ca.SX.sym("x", n), ca.SX.sym("P", n, n)
    full, u, Q = ca.SX.sym("Phi", n, n), ca.SX.sym("u", n), ca.SX.sym("Q", n, n)
    Phi = ca.SX(n, n)
    for i, j in pattern:
        Phi[i, j] = full[i, j]
    C, R, y = ca.SX.sym("C", m, n), ca.SX.sym("R", m), ca.SX.sym("y", m)
    later_x, later_P = Phi @ x + u, _symmetric(Phi @ P @ Phi.T + Q)
    e, s = [], []
    for i in range(m):
        c = C[i, :].T
        PC = later_P @ c
        e.append(y[i] - ca.dot(c, later_x))
        s.append(ca.dot(c, PC) + R[i])
        later_x = later_x + PC * (e[-1] / s[-1])
        later_P = _symmetric(later_P - PC @ (PC / s[-1]).T)
    numbers = ca.vertcat(*[ca.vec(part) for part in (full, u, Q, C, R, y)])
    state, after = ca.vertcat(x, ca.vec(P)), ca.vertcat(later_x, ca.vec(later_P))
    step = ca.Function("step", [state, numbers], [after, ca.vertcat(*e, *s)], {"cse": True})
    return step.mapaccum("steps", CHUNK)


def _symmetric(matrix: Any) -> Any:
    return ca.densify(ca.triu(matrix) + ca.triu(matrix, False).T)


def _run(steps: Any, x: Array, P: Array, numbers: Array, wide: int) -> Array:
    """Over a record, CHUNK steps at a time: (padded N, wide)."""
    state = np.concatenate([x, P.T.ravel()])
    after, found = np.empty((CHUNK, len(state))), np.empty((len(numbers), wide))
    buffer, run = steps.buffer()
    for k in range(0, len(numbers), CHUNK):
        span = slice(k, k + CHUNK)
        arrays: Any = (state, numbers[span]), (after, found[span])
        for i in range(2):
            buffer.set_arg(i, memoryview(arrays[0][i]))
            buffer.set_res(i, memoryview(arrays[1][i]))
        run()
        state = after[-1].copy()
    return found
