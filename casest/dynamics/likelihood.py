"""Noise intensities that a record itself asks for: maximum likelihood of the innovations.

Noise of inputs drives the states that they reach; other driven states keep an intensity of their
own. With published intensities that do not match the sensors every innovation would look wrong,
and nothing could be traced.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics import factors
from casest.dynamics.declare import Dynamics
from casest.dynamics.inputs import scatter, unstated
from casest.dynamics.stepping import Pattern, entries, reach
from casest.dynamics.transition import (
    Linearised,
    Pace,
    checked_time,
    linearised,
    lost,
    noises_along,
    stepped_with,
    usual,
)
from casest.engine import Recursion

Mask = NDArray[np.bool_]

#: Sum of the squared coefficients of a fourth difference.
_FOURTH = 70.0
#: An intensity is looked for within so many powers of e around where it begins.
RANGE = 14.0
#: Scoring: rounds, difference and largest step of a logarithm, gain in log-likelihood that ends it.
ROUNDS, STEP, LARGEST, ENOUGH = 30, 1e-3, 5.0, 0.1
#: Share of an input's size below which it shows no noise: no sensor is so good.
SILENT = 1e-5
#: The gain that ends it where the maximum itself is asked for, and rounds until then.
NOTHING, MANY = 1e-9, 200


@dataclass(frozen=True)
class Prepared:
    """A record made ready for many likelihoods: all that does not depend on the intensities.

    `system`: the model along the record, with noise of the intensities that it has; `units`: per
    intensity of a state or an input, which entries of Q it reaches; `readings`: per output signal,
    its rows; `numbers` (N, …): what each step is given.
    """

    model: Dynamics
    system: Linearised
    present: Mask
    period: Array
    units: Mapping[str, Pattern]
    readings: Mapping[str, slice]
    numbers: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intensities: inputs and states, then outputs."""
        return (*self.units, *self.readings)

    def driven(self, intensities: Mapping[str, float]) -> Linearised:
        """The system with noise of these intensities: of every step the sum of what each of them
        makes of it. Between samples it is not told again (`process` is that of `model`)."""
        n = self.model.size
        Q, place = np.zeros((len(self.numbers) - 1, n, n)), len(reach(self.model.traced.A)) + n
        for name, pattern in self.units.items():
            rows, columns = np.array(pattern, int).reshape(-1, 2).T
            Q[:, rows, columns] += intensities[name] * self.numbers[1:, place : place + len(rows)]
            place += len(rows)
        rows, columns = np.triu_indices(n, 1)
        Q[:, columns, rows] = Q[:, rows, columns]
        return self.system.driven(self.system.process, Q)


def noiseless(model: Dynamics, run: Run) -> set[str]:
    """Inputs of which nobody stated a noise, and that show none: simulated, or known exactly."""
    names = {s.name for s in model.signals} - {*model.sensors, *model.measured_signals}
    return {
        name
        for name in names
        if scatter(run.signals[name]) < SILENT * float(np.sqrt(np.nanmean(run.signals[name] ** 2)))
    }


def reached(model: Dynamics, silent: Collection[str] = ()) -> tuple[list[str], list[str]]:
    """Inputs whose noise drives states, and driven states that no such noise reaches; `silent`
    ones have none."""
    t = model.traced
    inputs, touched = [], np.zeros(model.size, dtype=bool)
    noisy = [s for s in model.signals if s.name not in (*t.measured, *model.exact, *silent)]
    for s in noisy:
        slope = model.slopes_in_signals[s.name]
        if slope.nnz():
            inputs.append(s.name)
            touched[list(set(slope.sparsity().get_triplet()[0]))] = True
    where = model.slices()
    own = [s.name for s in model.states if s.intensity > 0 and not touched[where[s.name]].any()]
    return inputs, own


def prepared(model: Dynamics, run: Run, along: Array) -> Prepared:
    """Along states (N, n), where the model or its noise depends on them."""
    inputs, own = reached(model, noiseless(model, run))
    silent = model.without_intensities()
    checked_time(run)
    pace = Pace.of(model, run)
    shown = {
        name: std**2 * pace.periods.get(name, pace.usual)
        for name, std in unstated(model, run).items()
    }
    system = linearised(model.sensing(**shown), run, along)
    present = np.isfinite(system.y)
    t, count = model.traced, len(present)
    alone = {name: silent.sensing(**{name: 1.0}) for name in inputs}
    alone |= {name: silent.driven(**{name: 1.0}) for name in own}
    units = {name: _spread(one) for name, one in alone.items()}
    first, none = np.eye(model.size)[None], np.zeros((model.size, model.size))
    noises = noises_along(model, inputs, run, along) if inputs else {}
    noises |= {name: alone[name].process for name in own}
    moved = stepped_with(system, list(noises.values()) or [none])
    Phi, forced = system.__dict__["moved"] = moved[0].Phi, moved[0].forced
    parts = [_picked(np.concatenate([first, Phi]), reach(t.A)), _after(forced, count)]
    for one, pattern in zip(moved, units.values(), strict=bool(alone)):
        parts.append(_after(_picked(one.Q, pattern), count))
    parts.append(_after(lost(model, system.steps, pace), count))
    parts.append(_picked(np.where(present[:, :, None], system.C, 0.0), entries(t.C)))
    parts.append(np.where(present, system.y - system.d, 0.0))
    readings, place = {}, 0
    for name, o in zip(t.measured, t.outputs, strict=True):
        readings[name] = slice(place, place + o.predicted.numel())
        place += o.predicted.numel()
    period = np.full(count, pace.usual)
    each = np.array([pace.periods.get(name, pace.usual) for name in readings])
    numbers = np.concatenate([*parts, np.broadcast_to(each, (count, len(each)))], axis=1)
    return Prepared(model, system, present, period, units, readings, numbers)


def _picked(matrices: Array, pattern: Pattern) -> Array:
    """Entries of every matrix, (N, k)."""
    rows, columns = np.array(pattern, int).reshape(-1, 2).T
    return matrices[:, rows, columns]


def _after(parts: Array, count: int) -> Array:
    """Of a step (N − 1, k), at the sample that it leads to; the first has none."""
    found = np.zeros((count, parts.shape[1]))
    found[1:] = parts
    return found


def _spread(model: Dynamics) -> Pattern:
    """Which entries of Q, on and above the diagonal, the noise of a model can reach in a step."""
    there = model.process != 0
    if model.input_noise is not None:
        there[tuple(np.array(entries(model.input_noise)).T)] = True
    moved = np.zeros_like(there)
    moved[tuple(np.array(reach(model.traced.A)).T)] = True
    found = np.triu(moved @ there @ moved.T)
    return tuple((int(i), int(j)) for i, j in np.argwhere(found))


def whitened(ready: Prepared, intensities: Mapping[str, float]) -> tuple[Array, Array]:
    """Innovations component by component (N, m), each given those before it, and variances."""
    return several_whitened(ready, [intensities])[0]


def several_whitened(
    ready: Prepared, several: Sequence[Mapping[str, float]]
) -> list[tuple[Array, Array]]:
    """The same with each of several intensities."""
    t = ready.model.traced
    rows = tuple((r.start, r.stop) for r in ready.readings.values())
    patterns = reach(t.A), tuple(ready.units.values()), entries(t.C)
    step = _likelihood_step(ready.model.size, rows, *patterns)
    n = ready.model.size
    first = [ready.model.start, np.diag(ready.model.start_covariance), np.zeros(n * (n - 1) // 2)]
    given = [np.array([own[name] for name in ready.names]) for own in several]
    states = np.array([np.concatenate([*first, own]) for own in given])
    return [(e, s) for _, e, s in step.beside(states, ready.numbers)]


def likelihood(ready: Prepared, intensities: Mapping[str, float]) -> float:
    """Log-likelihood of the readings."""
    return _log_density(ready, *whitened(ready, intensities))


def _log_density(ready: Prepared, e: Array, s: Array) -> float:
    return float(-0.5 * np.sum((np.log(2 * np.pi * s) + e**2 / s)[ready.present]))


def matched(
    ready: Prepared,
    run: Run,
    start: Mapping[str, float] | None = None,
    *,
    most: Mapping[str, float] | None = None,
    exactly: bool = False,
) -> tuple[dict[str, float], float]:
    """The most likely intensities, and their log-likelihood: Fisher scoring of their logarithms.

    None above the `most` that is plausible. Within a tenth of the maximum, which for a comparison
    is enough; `exactly`: the maximum.
    """
    enough, rounds = (NOTHING, MANY) if exactly else (ENOUGH, ROUNDS)
    names, guess = ready.names, first_guess(ready, run)
    middle = np.log([guess[name] for name in names])
    starts = [middle] + ([np.log([{**guess, **start}[n] for n in names])] if start else [])
    top = np.minimum(middle + RANGE, np.log([(most or {}).get(n, np.inf) for n in names]))
    bottom = np.minimum(middle, top) - RANGE

    def all_at(several: Sequence[Array]) -> list[tuple[Array, Array, float]]:
        given = [dict(zip(names, np.exp(x).tolist(), strict=True)) for x in several]
        return [(e, s, _log_density(ready, e, s)) for e, s in several_whitened(ready, given)]

    def at(where: Array) -> tuple[Array, Array, float]:
        return all_at([where])[0]

    clipped = list(np.clip(starts, bottom, top))
    tries = zip(clipped, all_at(clipped), strict=True)
    logs, found = max(tries, key=lambda pair: pair[1][2])
    damping = 1e-3
    for _ in range(rounds):
        moved = all_at([logs + STEP * unit for unit in np.eye(len(names))])
        gradient, information = _scoring(ready.present, found, moved)
        if exactly:
            back = all_at([logs - STEP * unit for unit in np.eye(len(names))])
            gradient = np.array([m[2] - b[2] for m, b in zip(moved, back, strict=True)])
            gradient /= 2 * STEP
        held = ((logs >= top) & (gradient > 0)) | ((logs <= bottom) & (gradient < 0))
        gradient = np.where(held, 0.0, gradient)
        information[held] = information[:, held] = 0.0
        while damping < 1e9:
            curved = information + damping * np.diag(np.diag(information) + 1.0)
            curved += np.diag(held.astype(float))
            step = np.clip(np.linalg.solve(curved, gradient), -LARGEST, LARGEST)
            tried = np.clip(logs + step, bottom, top)
            promised = gradient @ (tried - logs)
            better = at(tried) if promised > enough else found
            if better[2] > found[2] or promised <= enough:
                break
            damping = max(10 * damping, 0.1)
        gained, damping = better[2] - found[2], damping / 10
        if gained > 0:
            logs, found = tried, better
        if gained < enough:
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
    """Of a signal: what was stated of its noise, else its fourth differences, where little but
    noise is left. Of a state: little, or what was taken from these data before."""
    model, guess = ready.model, {}
    duration = float(np.sum(ready.period))
    for name in ready.names:
        if name in model.sensors:
            guess[name] = model.sensors[name]
        elif name in run.signals:
            values = run.recorded(name)
            fourth = np.diff(values[np.isfinite(values).all(axis=1)], 4, axis=0)
            variance = float(np.median(fourth**2)) / 0.4549 / _FOURTH if len(fourth) else 0.0
            scale = 1e-12 * float(np.nanmean(values**2)) or 1e-12
            guess[name] = max(variance, scale) * _period(run, name, float(np.median(ready.period)))
        else:
            own = model[name]
            guess[name] = own.intensity if own.of_data else 1e-6 * own.std**2 / duration
    return guess


def _period(run: Run, name: str, period: float) -> float:
    """Time between two samples of a signal with a clock of its own, else `period`, s."""
    own = run.clock(name) if name in run.read else np.zeros(0)
    return usual(np.diff(own)) if len(own) > 1 else period


def applied(model: Dynamics, intensities: Mapping[str, float]) -> Dynamics:
    """The model with these intensities, its states driven by nothing else."""
    states = {s.name: intensities.get(s.name, 0.0) for s in model.states}
    signals = {s.name: intensities[s.name] for s in model.signals if s.name in intensities}
    return model.driven(**states).sensing(**signals)


@lru_cache(maxsize=16)
def _likelihood_step(
    n: int,
    rows: tuple[tuple[int, int], ...],
    of_Phi: Pattern,
    units: tuple[Pattern, ...],
    of_C: Pattern,
) -> Recursion:
    """(x, factors of P, intensities; numbers of one sample) -> (the same later; innovations;
    variances)."""
    m = rows[-1][1]
    both, q = ca.SX.sym("both", factors.size(n)), ca.SX.sym("q", len(units) + len(rows))
    x, P = factors.unpacked(both, n)
    moved, Phi = _sparse("Phi", (n, n), of_Phi)
    u, y, period = ca.SX.sym("u", n), ca.SX.sym("y", m), ca.SX.sym("period", len(rows))
    own = [_sparse(f"Q{k}", (n, n), pattern) for k, pattern in enumerate(units)]
    seen, C = _sparse("C", (m, n), of_C)
    gap = ca.SX.sym("gap", n)
    Q = ca.diag(gap) + Phi @ ca.diag(gap) @ Phi.T
    for k, (_, unit) in enumerate(own):
        Q += q[k] * unit
    R = ca.vertcat(*[ca.repmat(q[len(units) + k] / period[k], last - first)
                     for k, (first, last) in enumerate(rows)])  # fmt: skip
    later_x, later = Phi @ x + u, factors.moved(P, Phi, factors.factored(Q))
    e, s = [], []
    for i in range(m):
        c = C[i, :].T
        e.append(y[i] - ca.dot(c, later_x))
        later, gain, expected = factors.read_with(later, c, R[i])
        s.append(expected)
        later_x = later_x + gain * e[-1]
    numbers = ca.vertcat(moved, u, *[k for k, _ in own], gap, seen, y, period)
    outputs = [ca.vertcat(factors.packed(later_x, later), q), ca.vertcat(*e), ca.vertcat(*s)]
    state = ca.vertcat(both, q)
    return Recursion(ca.Function("step", [state, numbers], outputs, {"cse": True}))


def _sparse(name: str, shape: tuple[int, int], pattern: Pattern) -> tuple[Any, Any]:
    """Symbols for the entries of a pattern, and the matrix of them."""
    symbols, matrix = ca.SX.sym(name, len(pattern)), ca.SX(*shape)
    for k, (i, j) in enumerate(pattern):
        matrix[i, j] = symbols[k]
    return symbols, matrix
