"""From samples of the signals to transition matrices and process noise.

Between two samples every signal is a straight line, so that A(t) is one too for the models at hand.
Where only a part of a step or another equation's is asked for: fourth-order Magnus steps with
Ω = h·(A₀ + A₁)/2 + h²/12·[A₁, A₀] (Magnus 1954; Blanes et al. 2009).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import factorial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.data.timing import UNUSED, longest
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.between import Motions, with_noises
from casest.dynamics.declare import Dynamics
from casest.dynamics.inputs import at_estimates, estimates, on_errors
from casest.dynamics.stepping import reach
from casest.engine import Columns, Replay, evaluated
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
    process noise intensity Ξ (n, n), or (N, n, n) where inputs have noise of their own;
    `pace` of the whole record where this is a part of it;
    `held`: A (N − 1, n, n) and c (N − 1, n) at the end of each step, where inputs that are held
    have not changed yet.
    """

    time: Array
    A: Array
    c: Array
    C: Array
    d: Array
    y: Array
    process: Array
    pace: Pace | None = None
    held: tuple[Array, Array] | None = None

    @property
    def steps(self) -> Array:
        """Time between samples, (N − 1,), s."""
        return np.diff(self.time)

    @cached_property
    def moved(self) -> tuple[Array, Array]:
        """Φ (N − 1, n, n) and forced step u (N − 1, n) of every step."""
        return transitions(self)

    @cached_property
    def sampled(self) -> Motions:
        """Φ, forced step and covariance of the noise of every step."""
        found = stepped(self, self.process)
        self.__dict__.setdefault("moved", (found.Phi, found.forced))
        return found

    @cached_property
    def later_half(self) -> Array:
        """Φ over the second half of every step, (N − 1, n, n)."""
        return half_transitions(self, (0.5, 1.0))

    def part(self, where: slice, pace: Pace) -> Linearised:
        """Some samples of it, which are read at the pace of the whole."""
        process = self.process[where] if self.process.ndim == 3 else self.process
        time, A, c, C, d, y = (
            x[where] for x in (self.time, self.A, self.c, self.C, self.d, self.y)
        )
        inner = slice(where.start, where.stop - 1)
        held = None if self.held is None else (self.held[0][inner], self.held[1][inner])
        return Linearised(time, A, c, C, d, y, process, pace, held)

    def driven(self, process: Array, Q: Array | None = None) -> Linearised:
        """The same motion with other process noise; what is known of its steps is kept.

        `Q`: what that noise makes of every step, (N − 1, n, n), where it is known."""
        other = replace(self, process=process)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k in _KEPT})
        if Q is not None:
            other.__dict__["sampled"] = Motions(*self.moved, Q)
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


def linearised(
    model: Dynamics,
    run: Run,
    along: Array | None = None,
    pace: Pace | None = None,
    calm: Mapping[str, Array] | None = None,
) -> Linearised:
    """The model along a record; a nonlinear one along states `along` (N, n).

    Signals that only outputs use may be missing (NaN); inputs may not. Of inputs with noise A and C
    are taken at the estimate (`inputs`), also of a linear model then along states; `calm`: these
    estimates (N, k) by name, where they are known already.
    """
    time = checked_record(model, run)
    if along is None:
        along = np.broadcast_to(model.start, (len(time), model.size))
    calm = estimates(model, run) if calm is None else calm
    pace = pace or Pace.of(model, run)
    signals = [*(run.signals[s.name] for s in model.signals), *calm.values()]
    columns = Columns([np.ascontiguousarray(along), *signals])
    A, c_, C, d_, y, *more = evaluated(_along(model), np.zeros(0), columns)
    process = model.process + _stood_for(time, pace) * more[0] if more else model.process
    readings = model.traced.nearest(y[:, :, 0], C, d_[:, :, 0], along)
    if not np.isfinite(readings).all():
        C = np.where(np.isfinite(readings)[:, :, None], C, 0.0)
    held = _held(model, run, along, calm)
    return Linearised(time, A, c_[:, :, 0], C, d_[:, :, 0], readings, process, pace, held)


def _held(
    model: Dynamics, run: Run, along: Array, calm: Mapping[str, Array]
) -> tuple[Array, Array] | None:
    """A and c at the end of each step, held inputs as they were at its beginning; None of none."""
    if not any(s.held for s in model.signals):
        return None
    held = {s.name for s in model.signals if s.held}
    parts = [(s.name, run.signals[s.name]) for s in model.signals] + list(calm.items())
    signals = [own[:-1] if name in held else own[1:] for name, own in parts]
    found = _along(model)(np.zeros(0), Columns([np.ascontiguousarray(along[1:]), *signals]))
    return found[0], found[1][:, :, 0]


@lru_cache(maxsize=8)
def _along(model: Dynamics) -> Replay:
    """A, c, C, d and readings at a sample; what noise of inputs adds to Ξ, where they have any."""
    t, added = model.traced, model.input_noise
    (A, C), as_was = at_estimates(model, [t.A, t.C])
    c, d = t.f - A @ t.x, t.h - C @ t.x
    expressions = [A, c, C, d, t.reading] + ([] if added is None else [added])
    return _replay(model, expressions, as_was)


@lru_cache(maxsize=8)
def _noise_along(model: Dynamics, names: tuple[str, ...]) -> Replay:
    """G·Gᵀ of each of these inputs."""
    slopes = [model.slopes_in_signals[name] for name in names]
    return _replay(model, [G @ G.T for G in slopes])


def _replay(model: Dynamics, expressions: list[Any], as_was: Sequence[Any] = ()) -> Replay:
    t = model.traced
    sample = ca.vertcat(t.x, *[flat(t.symbols[s.name]) for s in model.signals], *as_was)
    outputs = [ca.densify(e) for e in expressions]
    names = ["parameters", "sample"], [f"o{k}" for k in range(len(outputs))]
    return Replay(ca.Function("along", [ca.SX.sym("none", 0), sample], outputs, *names))


def process_along(model: Dynamics, run: Run, along: Array, pace: Pace | None = None) -> Array:
    """Process noise Ξ alone, (n, n), or along states (N, n) where inputs have noise: (N, n, n)."""
    names = model.noisy_inputs
    if not names:
        return model.process
    found = noises_along(model, names, run, along, pace)
    return np.asarray(model.process + sum(model.sensors[name] * Xi for name, Xi in found.items()))


def noises_along(
    model: Dynamics, names: Sequence[str], run: Run, along: Array, pace: Pace | None = None
) -> dict[str, Array]:
    """What noise of intensity one of each of some inputs adds to Ξ along states, (N, n, n) each."""
    columns = Columns([np.ascontiguousarray(along), *(run.signals[s.name] for s in model.signals)])
    replay = _noise_along(model.without_intensities(), tuple(names))
    share = _stood_for(checked_time(run), pace or Pace.of(model, run))
    found = evaluated(replay, np.zeros(0), columns)
    return {name: share * np.asarray(own) for name, own in zip(names, found, strict=True)}


def acting(model: Dynamics, run: Run, along: Array, P: Array) -> Array:
    """What noise of uncertain inputs adds to Ξ by acting on errors of states with covariances P
    (N, n, n), as long as each reading of them is held."""
    time = checked_time(run)
    return _stood_for(time, Pace.of(model, run)) * on_errors(model, run, along, P)


def _stood_for(time: Array, pace: Pace | None) -> Array:
    return shares(np.diff(time), pace)[:, None, None]


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


def transitions(system: Linearised) -> tuple[Array, Array]:
    """Φ (N − 1, n, n) and forced step u (N − 1, n): x(t₁) = Φ x(t₀) + u."""
    found = stepped(system, np.zeros_like(system.A[0]))
    return found.Phi, found.forced


def stepped(system: Linearised, intensity: Array) -> Motions:
    """Every step between two samples; Ξ constant (n, n), or at every sample (N, n, n).

    Raises DataError where a step leads beyond what numbers hold.
    """
    return stepped_with(system, [intensity])[0]


def stepped_with(system: Linearised, intensities: Sequence[Array]) -> list[Motions]:
    """The same with each of several noises."""
    found = with_noises(system.A, system.c, intensities, system.steps, system.held)
    if all(_finite(part) for own in found for part in (own.Phi, own.forced, own.Q)):
        return found
    whole = np.isfinite(found[0].forced).all(axis=1) & np.isfinite(found[0].Phi).all(axis=(1, 2))
    for own in found:
        whole &= np.isfinite(own.Q).all(axis=(1, 2))
    bad = np.flatnonzero(~whole)
    if bad.size:
        k = int(bad[0])
        raise DataError(
            f"from t = {system.time[k]:.9g} s to {system.time[k + 1]:.9g} s the motion grows "
            f"beyond what numbers hold: its fastest rate is {np.abs(system.A[k]).max():.3g}/s; "
            "sample faster, or leave the fast state out"
        )
    return found


def _finite(numbers: Array) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        total = np.sum(numbers)  # cheaper, and of finite numbers rarely anything else
    return bool(np.isfinite(total) or np.isfinite(numbers).all())


def half_transitions(system: Linearised, part: tuple[float, float]) -> Array:
    """Φ alone over a part of every step, for rules that need the middle."""
    found = np.empty((len(system.time) - 1, *system.A.shape[1:]))
    for k in range(0, len(found), _BLOCK):
        where = slice(k, k + _BLOCK)
        M = system.A[k : k + _BLOCK + 1]
        found[where] = exponential(magnus(M, system.steps[where], part))
    return found


def magnus(M: Array, steps: Array, part: tuple[float, float] = (0.0, 1.0)) -> Array:
    """Ω of ż = M(t) z over (a part of) every step, M (K + 1, n, n) being straight lines between
    samples: exp Ω is the transition, to fourth order."""
    begin, end = part
    slope = M[1:] - M[:-1]
    first, last = (M[:-1] + share * slope if share else M[:-1] for share in part)
    h = (end - begin) * steps[:, None, None]
    bend = last @ first - first @ last
    return np.asarray(0.5 * h * (first + last) + h**2 / 12 * bend)


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
    """∫Φ(t₁, s)ΞΦ(t₁, s)ᵀ ds of every step, (N − 1, n, n); Ξ (n, n), or at every sample."""
    return stepped(system, intensity).Q


def lost(model: Dynamics, steps: Array, pace: Pace | None = None) -> Array:
    """Variances (N − 1, n) that are added before and after each step: nothing but in gaps.

    What inputs did in a gap is unknown: states that they drive, through others too, are known in it
    and afterwards no better than at the beginning.
    """
    t, n = model.traced, model.size
    found = np.zeros((len(steps), n))
    pace = pace or pace_of(steps)
    wide = steps > pace.gap if pace.wide is None else pace.wide
    if wide.any():
        u = [flat(t.symbols[s.name]) for s in model.signals if s.name not in t.measured]
        driven = np.zeros(n, dtype=bool)
        if u:
            driven[list(set(ca.jacobian(t.f, ca.vertcat(*u)).sparsity().get_triplet()[0]))] = True
        moved = np.zeros((n, n), dtype=bool)
        moved[tuple(np.array(reach(t.A)).T)] = True
        found[wide] = np.where(moved @ driven, np.diag(model.start_covariance), 0.0)
    return found


def with_lost(
    model: Dynamics, steps: Array, Phi: Array, Q: Array, pace: Pace | None = None
) -> Array:
    """The noise Q (N − 1, n, n) of steps, gaps included."""
    added, i = lost(model, steps, pace), np.arange(model.size)
    wide = np.flatnonzero(added.any(axis=1))
    if not wide.size:
        return Q
    Q = Q.copy()
    own = np.zeros((len(wide), model.size, model.size))
    own[:, i, i] = added[wide]
    Q[wide] += Phi[wide] @ own @ Phi[wide].transpose(0, 2, 1) + own
    return Q


@dataclass(frozen=True)
class Pace:
    """How a record is read: the usual time between two readings, and what is a gap, s.

    `share`: what part of the usual step each reading stands for (see `shares`), where it is known;
    `holed`: are readings missing somewhere in the record?
    Where signals have clocks of their own, `periods`: the time between two samples of each, s;
    `wide` (N − 1,): which steps lie in a gap of the inputs.
    """

    usual: float
    gap: float
    share: Array | None = None
    holed: bool = False
    periods: Mapping[str, float] = field(default_factory=dict)
    wide: NDArray[np.bool_] | None = None

    @staticmethod
    def of(model: Dynamics, run: Run) -> Pace:
        """How a record is read, signal by signal where they have clocks of their own."""
        time = np.asarray(run.time, float)
        pace = pace_of(np.diff(time))
        if not run.read:
            return pace
        clocks = {name: run.clock(name) for name in run.read}
        periods = {n: usual(np.diff(t)) if len(t) > 1 else float(np.ptp(time))
                   for n, t in clocks.items()}  # fmt: skip
        inputs = [clocks[name] for name in model.input_signals if name in clocks]
        wide = np.zeros(len(time) - 1, dtype=bool)
        share = np.ones(len(time))
        for t in inputs:
            wide |= _within_gaps(time, t)
        if inputs:
            share = np.mean([np.interp(time, t, shares(np.diff(t))) for t in inputs], axis=0)
        return replace(pace, share=share, periods=periods, wide=wide)

    def part(self, where: slice) -> Pace:
        """The same of some samples of the record."""
        share = None if self.share is None else self.share[where]
        wide = None if self.wide is None else self.wide[where.start : where.stop - 1]
        return replace(self, share=share, wide=wide)


def _within_gaps(time: Array, own: Array) -> NDArray[np.bool_]:
    """Which steps (N − 1,) of a record lie in a gap of a clock of samples at `own` (M,)."""
    steps = np.diff(own)
    gap = steps > longest(steps)
    before = np.searchsorted(own, time[:-1], side="right") - 1
    return np.asarray(gap[np.clip(before, 0, len(gap) - 1)])


def pace_of(steps: Array) -> Pace:
    """Of steps (N − 1,): the usual one is the mean of those that are no gaps."""
    gap = longest(steps)
    return Pace(float(np.mean(steps[steps <= gap])), gap)


def usual(steps: Array) -> float:
    """Time between two readings, s: the mean of the steps (N − 1,) that are no gaps."""
    return pace_of(steps).usual


def counted(steps: Array) -> Array:
    """Steps (N − 1,) as far as readings stand for them: each for the usual one.

    A sensor's noise knows nothing of when it was read before, and in a gap nothing was read.
    """
    return np.full(len(steps), usual(steps))


def variances(model: Dynamics, steps: Array, pace: Pace | None = None) -> Array:
    """Variance of every reading, (N, m): the noise's intensity over the time between two."""
    pace = pace or pace_of(steps)
    own = np.diag(model.noise_at(pace.usual, pace.periods)) / pace.usual
    return np.repeat(own[None], len(steps) + 1, 0)


def shares(steps: Array, pace: Pace | None = None) -> Array:
    """What part of the usual step each reading of an input stands for, (N,): what lies between it
    and its neighbours follows it, noise included. In a gap nothing does."""
    pace = pace or pace_of(steps)
    if pace.share is not None:
        return pace.share
    step = np.where(steps > pace.gap, pace.usual, steps) / pace.usual
    return np.concatenate([step[:1], 0.5 * (step[1:] + step[:-1]), step[-1:]])
