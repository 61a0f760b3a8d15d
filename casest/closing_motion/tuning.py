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

    `units`: per intensity of a state or an input, what 1 of it adds to each step, (N − 1, n, n);
    `readings`: per output signal, its rows.
    """

    model: Dynamics
    Phi: Array
    forced: Array
    C: Array
    y: Array
    present: Mask
    period: Array
    units: Mapping[str, Array]
    readings: Mapping[str, slice]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intensities: inputs and states, then outputs."""
        return (*self.units, *self.readings)


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
        units[name] = process_noise(system, linearised(alone, run, along).process, Phi)
    present = np.isfinite(system.y)
    C = np.where(present[:, :, None], system.C, 0.0)
    y = np.where(present, system.y - system.d, 0.0)
    readings, place = {}, 0
    for name, o in zip(model.traced.measured, model.traced.outputs, strict=True):
        readings[name] = slice(place, place + o.predicted.numel())
        place += o.predicted.numel()
    return Prepared(model, Phi, forced, C, y, present, steps_to(system), units, readings)


def whitened(ready: Prepared, intensities: Mapping[str, float]) -> tuple[Array, Array]:
    """Innovations component by component (N, m), each given those before it, and variances."""
    n, m = ready.model.size, ready.C.shape[1]
    Q = sum(intensities[name] * unit for name, unit in ready.units.items())
    R = np.empty((len(ready.y), m))
    for name, rows in ready.readings.items():
        R[:, rows] = (intensities[name] / ready.period)[:, None]
    first = np.eye(n)[None]
    columns = [np.concatenate([first, ready.Phi]), np.concatenate([np.zeros((1, n)), ready.forced]),
               np.concatenate([0 * first, Q]), ready.C, R, ready.y]  # fmt: skip
    step = _likelihood_step(n, m, reach(ready.model.traced.A))
    return _run(step, ready.model.start, ready.model.start_covariance, columns)


def likelihood(
    ready: Prepared, intensities: Mapping[str, float], used: Mask | None = None
) -> float:
    """Log-likelihood of the readings (those of instants `used`, (N,))."""
    return _log_density(ready, *whitened(ready, intensities), used)


def _log_density(ready: Prepared, e: Array, s: Array, used: Mask | None) -> float:
    counted = _counted(ready, used)
    return float(-0.5 * np.sum((np.log(2 * np.pi * s) + e**2 / s)[counted]))


def _counted(ready: Prepared, used: Mask | None) -> Mask:
    return ready.present if used is None else ready.present & used[:, None]


def matched(
    ready: Prepared,
    run: Run,
    start: Mapping[str, float] | None = None,
    used: Mask | None = None,
) -> tuple[dict[str, float], float]:
    """The most likely intensities, and their log-likelihood: Fisher scoring of their logarithms.

    Information of two of them is Σ(∂e·∂e/s + ½·∂s·∂s/s²) over innovations e of variance s.
    """
    names, counted, damping = ready.names, _counted(ready, used), 1e-3
    guess = first_guess(ready, run)
    middle = np.log([guess[name] for name in names])
    starts = [middle] + ([np.log([{**guess, **start}[n] for n in names])] if start else [])

    def at(where: Array) -> tuple[Array, Array, float]:
        e, s = whitened(ready, dict(zip(names, np.exp(where).tolist(), strict=True)))
        return e, s, _log_density(ready, e, s, used)

    logs, (e, s, best) = max(((x, at(x)) for x in starts), key=lambda pair: pair[1][2])
    for _ in range(ROUNDS):
        slopes = [_slope(at(logs + STEP * unit), e, s, counted) for unit in np.eye(len(names))]
        of_e, of_s = (np.array([pair[k] for pair in slopes]) for k in range(2))
        e0, s0 = e[counted], s[counted]
        gradient = of_s @ (e0**2 / s0 - 1) / 2 - of_e @ (e0 / np.sqrt(s0))
        information = of_e @ of_e.T + 0.5 * of_s @ of_s.T
        while damping < 1e9:
            curved = information + damping * np.diag(np.diag(information) + 1.0)
            step = np.clip(np.linalg.solve(curved, gradient), -LARGEST, LARGEST)
            tried = np.clip(logs + step, middle - RANGE, middle + RANGE)
            e_new, s_new, value = at(tried)
            if value > best:
                break
            damping = max(10 * damping, 0.1)
        gained, damping = value - best, damping / 10
        if not gained > 0:
            break
        logs, e, s, best = tried, e_new, s_new, value
        if gained < ENOUGH:
            break
    return dict(zip(names, np.exp(logs).tolist(), strict=True)), best


def _slope(
    moved: tuple[Array, Array, float], e: Array, s: Array, counted: Mask
) -> tuple[Array, Array]:
    """∂e/√s and ∂s/s by a difference."""
    e0, s0 = e[counted], s[counted]
    return (moved[0][counted] - e0) / STEP / np.sqrt(s0), (moved[1][counted] - s0) / STEP / s0


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


def _run(steps: Any, x: Array, P: Array, parts: list[Array]) -> tuple[Array, Array]:
    """Over a record, CHUNK steps at a time."""
    N, m = len(parts[0]), parts[-1].shape[1]
    flats = [p.transpose(0, 2, 1).reshape(N, -1) if p.ndim == 3 else p for p in parts]
    padded = -(-N // CHUNK) * CHUNK
    numbers = np.zeros((padded, sum(f.shape[1] for f in flats)))
    np.concatenate(flats, axis=1, out=numbers[:N])
    numbers[N:] = numbers[N - 1]
    state = np.concatenate([x, P.T.ravel()])
    after, found = np.empty((CHUNK, len(state))), np.empty((padded, 2 * m))
    buffer, run = steps.buffer()
    for k in range(0, padded, CHUNK):
        span = slice(k, k + CHUNK)
        arrays: Any = (state, numbers[span]), (after, found[span])
        for i in range(2):
            buffer.set_arg(i, memoryview(arrays[0][i]))
            buffer.set_res(i, memoryview(arrays[1][i]))
        run()
        state = after[-1].copy()
    return found[:N, :m], found[:N, m:]
