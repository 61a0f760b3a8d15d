"""From samples of the signals to transition matrices: fourth-order Magnus steps.

Between two samples every signal is a straight line, so that A(t) is one too for the models at hand;
Ω = h·(A₀ + A₁)/2 + h²/12·[A₁, A₀] is then right to fourth order (Magnus 1954; Blanes et al. 2009),
where holding A is right to second order only. A known input is one more, constant state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import factorial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.data.timing import GAP, UNUSED
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.inputs import at_estimates, estimates
from casest.dynamics.stepping import reach
from casest.engine import Columns, Replay
from casest.errors import DataError

#: Coefficients of the exponential's series to degree 11, three at a time; and the norms below which
#: six, nine or all twelve of them leave less than 1e-17.
_SERIES = np.array([1 / factorial(k) for k in range(12)]).reshape(4, 3)
_NORMS = np.array([0.004, 0.05, 0.2])

#: Matrices that are worked on together: they stay in the processor's cache.
_BLOCK = 256


@dataclass(frozen=True)
class Linearised:
    """ẋ = A x + c, y = C x + d along a record, at every sample.

    time (N,); A (N, n, n), c (N, n), C (N, m, n), d (N, m); y (N, m) with NaN where it is missing
    and no row in C;
    process noise intensity Ξ (n, n), or (N, n, n) where inputs have noise of their own.
    """

    time: Array
    A: Array
    c: Array
    C: Array
    d: Array
    y: Array
    process: Array

    @property
    def steps(self) -> Array:
        """Time between samples, (N − 1,), s."""
        return np.diff(self.time)

    @cached_property
    def moved(self) -> tuple[Array, Array]:
        """Φ (N − 1, n, n) and forced step u (N − 1, n) of every step."""
        return transitions(self)

    @cached_property
    def later_half(self) -> Array:
        """Φ over the second half of every step, (N − 1, n, n)."""
        return half_transitions(self, (0.5, 1.0))

    def driven(self, process: Array) -> Linearised:
        """The same motion with other process noise; what is known of its steps is kept."""
        other = replace(self, process=process)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k in _KEPT})
        return other


_KEPT = ("moved", "later_half")


def checked_time(run: Run) -> Array:
    """The run's time, increasing; DataError names the first sample where it is not."""
    if run.time is None:
        why = [note for note in run.notes if note.startswith(UNUSED)]
        if why:
            raise DataError(why[0].removeprefix(UNUSED))
        raise DataError(f"{run.file or run.name}: motion needs time: a time column, or --rate")
    time = np.asarray(run.time, float)
    step = np.diff(time)
    bad = np.flatnonzero(~(step > 0))
    if bad.size:
        k = int(bad[0])
        what = "repeats" if step[k] == 0 else "goes backwards"
        raise DataError(
            f"{run.file or run.name}, row {int(run.rows[k + 1])}: time {what} "
            f"({time[k]:.9g} s, then {time[k + 1]:.9g} s); sort the record, or drop the row"
        )
    if len(time) < 2:
        raise DataError(f"{run.file or run.name}: {len(time)} sample: motion needs at least two")
    return time


def checked_record(model: Dynamics, run: Run) -> Array:
    """The run's time; DataError where it, a signal or an input is not usable."""
    time = checked_time(run)
    for s in model.signals:
        if s.name not in run.signals:
            raise DataError(f"{run.file or run.name}: no data for signal {s.name!r}; add --columns")
    _refuse_missing_inputs(model, run)
    return time


def linearised(model: Dynamics, run: Run, along: Array | None = None) -> Linearised:
    """The model along a record; a nonlinear one along states `along` (N, n).

    Signals that only outputs use may be missing (NaN); inputs may not. Of inputs with noise A and C
    are taken at the estimate (`inputs`), also of a linear model then along states.
    """
    time, t = checked_record(model, run), model.traced
    if along is None:
        along = np.broadcast_to(model.start, (len(time), model.size))
    calm = estimates(model, run)
    (A, C), as_was = at_estimates(model, [t.A, t.C])
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in model.signals], *as_was)
    c, d = t.f - A @ t.x, t.h - C @ t.x
    added = model.input_noise
    expressions = [A, c, C, d, t.reading] + ([] if added is None else [added])
    outputs = [ca.densify(e) for e in expressions]
    none = ca.SX.sym("none", 0)
    function = ca.Function(
        "along", [none, sample], outputs, ["parameters", "sample"], list("AcCdyQ")[: len(outputs)]
    )
    signals = [*(run.signals[s.name] for s in model.signals), *calm.values()]
    columns = Columns([np.ascontiguousarray(along), *signals])
    A, c_, C, d_, y, *more = Replay(function)(np.zeros(0), columns)
    process = model.process + more[0] if more else model.process
    readings = t.nearest(y[:, :, 0], C, d_[:, :, 0], along)
    if not np.isfinite(readings).all():
        C = np.where(np.isfinite(readings)[:, :, None], C, 0.0)
    return Linearised(time, A, c_[:, :, 0], C, d_[:, :, 0], readings, process)


def process_along(model: Dynamics, run: Run, along: Array) -> Array:
    """Process noise Ξ alone, (n, n), or along states (N, n) where inputs have noise: (N, n, n)."""
    added = model.input_noise
    if added is None:
        return model.process
    t = model.traced
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in model.signals])
    function = ca.Function("noise", [ca.SX.sym("none", 0), sample], [ca.densify(added)],
                           ["parameters", "sample"], ["Q"])  # fmt: skip
    columns = Columns([np.ascontiguousarray(along), *(run.signals[s.name] for s in model.signals)])
    return np.asarray(model.process + Replay(function)(np.zeros(0), columns)[0])


def _refuse_missing_inputs(model: Dynamics, run: Run) -> None:
    for s in model.signals:
        used = s.name not in model.may_be_missing
        bad = np.flatnonzero(~np.isfinite(run.signals[s.name]).all(axis=1))
        if used and bad.size:
            raise DataError(
                f"{run.file or run.name}: the input {s.name} is missing in {bad.size} of "
                f"{len(run)} rows, first in row {int(run.rows[bad[0]])}; a motion cannot be "
                "followed without it: cut the record there, or fill the gap"
            )


def transitions(system: Linearised, part: tuple[float, float] = (0.0, 1.0)) -> tuple[Array, Array]:
    """Φ (N − 1, n, n) and forced step u (N − 1, n): x(t₁) = Φ x(t₀) + u.

    `part`: from which share of every step to which (for rules that need the middle).
    """
    n = system.A.shape[1]
    both = magnus_steps(lambda where: _augmented(system.A[where], system.c[where]), system, part)
    return both[:, :n, :n], both[:, :n, n]


def half_transitions(system: Linearised, part: tuple[float, float]) -> Array:
    """Φ alone over a part of every step, for rules that need the middle."""
    return magnus_steps(lambda where: system.A[where], system, part)


def magnus_steps(
    coefficients: Callable[[slice], Array],
    system: Linearised,
    part: tuple[float, float] = (0.0, 1.0),
) -> Array:
    """Transition of ż = M(t) z over (a part of) every step, by fourth-order Magnus steps.

    `coefficients(where)` gives M at those samples; between samples it is a straight line.
    """
    return np.concatenate(list(magnus_blocks(coefficients, system, part)))


def magnus_blocks(
    coefficients: Callable[[slice], Array],
    system: Linearised,
    part: tuple[float, float] = (0.0, 1.0),
) -> Iterator[Array]:
    """The same, some steps at a time: they stay in the processor's cache."""
    steps, (begin, end) = system.steps, part
    for k in range(0, len(steps), _BLOCK):
        M = coefficients(slice(k, k + _BLOCK + 1))
        slope = M[1:] - M[:-1]
        first, last = (M[:-1] + share * slope if share else M[:-1] for share in part)
        h = (end - begin) * steps[k : k + _BLOCK, None, None]
        bend = last @ first - first @ last
        yield exponential(0.5 * h * (first + last) + h**2 / 12 * bend)


def _augmented(A: Array, c: Array) -> Array:
    count, n = c.shape
    both = np.zeros((count, n + 1, n + 1))
    both[:, :n, :n], both[:, :n, n] = A, c
    return both


def exponential(matrices: Array) -> Array:
    """exp of every matrix, (N, n, n): scaling, Taylor series, squaring.

    Degree 5 takes three products, 8 four, 11 five (Paterson & Stockmeyer 1973): as many as needed.
    """
    norm = float(np.max(np.sum(np.abs(matrices), axis=2), initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(max(norm / _NORMS[-1], 1e-300)))))
    rows = 2 + int(np.searchsorted(_NORMS, norm / 2.0**squarings))
    powers = np.empty((3, *matrices.shape))
    X, square, cube = powers
    np.multiply(matrices, 0.5**squarings, out=X)
    np.matmul(X, X, out=square)
    np.matmul(square, X, out=cube)
    series = _SERIES[:rows]
    # In three terms each: (1, X, X²) times powers of X³.
    sums = (series[:, 1:] @ powers[:2].reshape(2, -1)).reshape(rows, *matrices.shape)
    diagonal = np.arange(matrices.shape[1])
    sums[:, :, diagonal, diagonal] += series[:, :1, None]
    result = sums[-1]
    for k in range(rows - 2, -1, -1):
        result = sums[k] + cube @ result
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result)


def process_noise(system: Linearised, intensity: Array) -> Array:
    """∫Φ(t₁, s)ΞΦ(t₁, s)ᵀ ds of every step, (N − 1, n, n): Simpson's rule.

    Ξ constant and diagonal (n, n), or any at every sample (N, n, n).
    """
    h = system.steps[:, None, None]
    Phi, middle = system.moved[0], system.later_half
    if intensity.ndim == 3:
        last = intensity[1:]
        between = 0.5 * (intensity[:-1] + last)
        ends = Phi @ intensity[:-1] @ Phi.transpose(0, 2, 1) + last
        inner = middle @ between @ middle.transpose(0, 2, 1)
    else:
        # A diagonal one: a product with its roots, half the work.
        root = np.sqrt(np.diag(intensity))
        first, middle = Phi * root, middle * root
        ends = first @ first.transpose(0, 2, 1) + intensity
        inner = middle @ middle.transpose(0, 2, 1)
    return np.asarray(h / 6 * (ends + 4 * inner))


def lost(model: Dynamics, steps: Array) -> Array:
    """Variances (N − 1, n) that are added before and after each step: nothing but in gaps.

    What inputs did in a gap is unknown: states that they drive, through others too, are known in it
    and afterwards no better than at the beginning.
    """
    t, n = model.traced, model.size
    found = np.zeros((len(steps), n))
    gaps = steps > GAP * np.median(steps)
    if gaps.any():
        u = [flat(t.symbols[s.name]) for s in model.signals if s.name not in t.measured]
        driven = np.zeros(n, dtype=bool)
        if u:
            driven[list(set(ca.jacobian(t.f, ca.vertcat(*u)).sparsity().get_triplet()[0]))] = True
        moved = np.zeros((n, n), dtype=bool)
        moved[tuple(np.array(reach(t.A)).T)] = True
        found[gaps] = np.where(moved @ driven, np.diag(model.start_covariance), 0.0)
    return found


def with_lost(model: Dynamics, steps: Array, Phi: Array, Q: Array) -> Array:
    """The noise Q (N − 1, n, n) of steps, gaps included."""
    added, i = lost(model, steps), np.arange(model.size)
    gaps = np.flatnonzero(added.any(axis=1))
    own = np.zeros((len(gaps), model.size, model.size))
    own[:, i, i] = added[gaps]
    Q[gaps] += Phi[gaps] @ own @ Phi[gaps].transpose(0, 2, 1) + own
    return Q


def counted(steps: Array) -> Array:
    """Steps (N − 1,) as far as readings stand for them: in a gap nothing was read."""
    usual = float(np.median(steps))
    return np.where(steps > GAP * usual, usual, steps)


def steps_to(steps: Array | Linearised) -> NDArray[np.float64]:
    """Time that each sample stands for, (N,): half of the steps (N − 1,) on both sides of it."""
    step = counted(steps.steps if isinstance(steps, Linearised) else steps)
    return np.concatenate([[step[0]], 0.5 * (step[1:] + step[:-1]), [step[-1]]])
