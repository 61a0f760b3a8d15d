"""From samples of the signals to transition matrices: fourth-order Magnus steps.

Between two samples every signal is a straight line, so that A(t) is one too for the models at hand;
Ω = h·(A₀ + A₁)/2 + h²/12·[A₁, A₀] is then right to fourth order (Magnus 1954; Blanes et al. 2009),
where holding A is right to second order only. A known input is one more, constant state.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.engine import Columns, Replay
from casest.errors import DataError
from casest.modelling.tracing import flat

#: Terms of the exponential's series after scaling to a norm below a half: 1e-17.
_TERMS = 12


@dataclass(frozen=True)
class Linearised:
    """ẋ = A x + c, y = C x + d along a record, at every sample.

    time (N,); A (N, n, n), c (N, n), C (N, m, n), d (N, m); y (N, m) with NaN where it is missing.
    """

    time: Array
    A: Array
    c: Array
    C: Array
    d: Array
    y: Array

    @property
    def steps(self) -> Array:
        """Time between samples, (N − 1,), s."""
        return np.diff(self.time)


def checked_time(run: Run) -> Array:
    """The run's time, increasing; DataError names the first sample where it is not."""
    if run.time is None:
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


def linearised(model: Dynamics, run: Run, along: Array | None = None) -> Linearised:
    """The model along a record; a nonlinear one along states `along` (N, n).

    Signals that only outputs use may be missing (NaN); inputs may not.
    """
    time, t = checked_time(run), model.traced
    for s in model.signals:
        if s.name not in run.signals:
            raise DataError(f"{run.file or run.name}: no data for signal {s.name!r}; add --columns")
    _refuse_missing_inputs(model, run)
    if along is None:
        along = np.broadcast_to(model.start, (len(time), model.size))
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in model.signals])
    c, d = t.f - t.A @ t.x, t.h - t.C @ t.x
    outputs = [ca.densify(e) for e in (t.A, c, t.C, d, t.reading)]
    none = ca.SX.sym("none", 0)
    function = ca.Function(
        "along", [none, sample], outputs, ["parameters", "sample"], list("AcCdy")
    )
    columns = Columns([np.ascontiguousarray(along), *(run.signals[s.name] for s in model.signals)])
    A, c_, C, d_, y = Replay(function)(np.zeros(0), columns)
    return Linearised(time, A, c_[:, :, 0], C, d_[:, :, 0], y[:, :, 0])


def _refuse_missing_inputs(model: Dynamics, run: Run) -> None:
    t = model.traced
    for s in model.signals:
        used = ca.depends_on(t.f, flat(t.symbols[s.name]))
        bad = np.flatnonzero(~np.isfinite(run.signals[s.name]).all(axis=1))
        if used and bad.size:
            raise DataError(
                f"{run.file or run.name}: the input {s.name} is missing in {bad.size} of "
                f"{len(run)} rows, first in row {int(run.rows[bad[0]])}; a motion cannot be "
                "followed without it: cut the record there, or fill the gap"
            )


def transitions(system: Linearised, parts: int = 1) -> tuple[Array, Array]:
    """Φ (N − 1, n, n) and forced step u (N − 1, n): x(t₁) = Φ x(t₀) + u.

    `parts`: only the first 1/parts of every step (for rules that need the middle).
    """
    n = system.A.shape[1]
    h = (system.steps / parts)[:, None, None]
    first = _augmented(system.A[:-1], system.c[:-1])
    last = _augmented(system.A[1:], system.c[1:])
    last = first + (last - first) / parts
    magnus = 0.5 * h * (first + last) + h**2 / 12 * (last @ first - first @ last)
    both = exponential(magnus)
    return both[:, :n, :n], both[:, :n, n]


def _augmented(A: Array, c: Array) -> Array:
    count, n = c.shape
    both = np.zeros((count, n + 1, n + 1))
    both[:, :n, :n], both[:, :n, n] = A, c
    return both


def exponential(matrices: Array) -> Array:
    """exp of every matrix, (N, n, n): scaling, Taylor series, squaring."""
    norm = float(np.max(np.sum(np.abs(matrices), axis=2), initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300)))) + 1)
    scaled = matrices / 2.0**squarings
    result = np.broadcast_to(np.eye(matrices.shape[1]), matrices.shape).copy()
    term = result
    for k in range(1, _TERMS + 1):
        term = term @ scaled / k
        result = result + term
        if np.max(np.abs(term), initial=0.0) < 1e-18:
            break
    for _ in range(squarings):
        result = result @ result
    return result


def process_noise(system: Linearised, intensity: Array, Phi: Array) -> Array:
    """∫Φ(t₁, s)ΞΦ(t₁, s)ᵀ ds of every step, (N − 1, n, n): Simpson's rule.

    Φ(t₁, middle) = Φ·Φ(middle, t₀)⁻¹.
    """
    h = system.steps[:, None, None]
    # The process noise is diagonal: a product with its roots, half the work.
    root = np.sqrt(np.diag(intensity))
    half, _ = transitions(system, parts=2)
    first, middle = Phi * root, np.linalg.solve(half.transpose(0, 2, 1), Phi.transpose(0, 2, 1))
    middle = middle.transpose(0, 2, 1) * root
    ends = first @ first.transpose(0, 2, 1) + intensity
    return np.asarray(h / 6 * (ends + 4 * (middle @ middle.transpose(0, 2, 1))))


def steps_to(system: Linearised) -> NDArray[np.float64]:
    """Time that each sample stands for, (N,): half of the steps on both sides of it."""
    step = system.steps
    return np.concatenate([[step[0]], 0.5 * (step[1:] + step[:-1]), [step[-1]]])
