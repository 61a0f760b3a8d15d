"""States over the last samples at once: bounds kept, a nonlinear model linearised where all lead.

Minimised over a window is ‖x(a) − x̄‖²/P̄ + Σ‖x(k+1) − F(x(k))‖²/Q + Σ‖y − h(x)‖²/R within bounds,
by Gauss-Newton rounds that begin where the window before ended (moving-horizon estimation: Rao,
Rawlings & Mayne 2003). The arrival cost (x̄, P̄) is what the filter, linearised along the window,
predicts of its second sample; so of a linear model without bounds every window, however short, says
what the whole record up to there says. What bounds add to it is not handed on: counted again at
every step they would make the estimate sure of what it cannot know.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.course import Course
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import Estimates, Steps, kalman, normalised, smoothed
from casest.dynamics.extended import Sampled
from casest.dynamics.filter import coefficients, discretised
from casest.dynamics.inputs import uncertain
from casest.dynamics.known import known
from casest.dynamics.quadratic import Kept, kept
from casest.dynamics.riccati import check_covariance
from casest.dynamics.transition import Pace, checked_record, shares
from casest.errors import DataError, UsageError

#: Rounds of a window at most, and the share of a standard deviation by which states may still move.
ROUNDS, SETTLED = 20, 1e-6


@dataclass(frozen=True, kw_only=True)
class Horizon(Course):
    """States (N, n) by windows: `x` at the end of each; `smoothed` as the last window that holds a
    sample says it, so by `horizon` samples more.

    `multipliers` (N, 2, n) of lower and upper bounds in that window: how much the cost would fall
    for each unit that one gave way; zero where there is room. `rounds` (N,) of each window
    and the `seconds` that they took; `unsettled`: which did not settle in as many as there may be.
    """

    horizon: int
    multipliers: Array
    rounds: Array
    seconds: Array
    unsettled: Array


def moving_horizon(model: Dynamics, run: Run, horizon: int) -> Horizon:
    """States over a record, each by the `horizon` steps before it and what was known before these.

    Bounds of states and of unknown constants hold at every sample; covariances where bounds act are
    those on them. Raises DataError where time or inputs are not usable, or no states within the
    bounds follow the equations; UsageError where the horizon is none.
    """
    if horizon < 1:
        raise UsageError(f"a horizon of {horizon} steps: give 1 or more")
    check_covariance(model.start_covariance, "the covariance at the beginning")
    source: _Linear | _Nonlinear = (_Linear if model.linear else _Nonlinear)(model, run)
    found = _empty(model, run, horizon)
    window: _Window | None = None
    for k in range(len(run)):
        began = perf_counter()
        window = _next(source, window, k, horizon)
        found.seconds[k] = perf_counter() - began
        _put(found, run, window, k, whole=k == len(run) - 1)
    return replace(found, settled=not found.unsettled.any())


@dataclass(frozen=True)
class _Window:
    """A window from sample `first` on: what was known before, states (K, n) and covariances
    (K, n, n) within bounds, `filtered` without; innovation of its last sample and what is expected
    of it."""

    first: int
    start: Array
    covariance: Array
    states: Array
    spread: Array
    filtered: Estimates
    innovation: tuple[Array, Array]
    held: Kept | None
    rounds: int
    settled: bool


class _Linear:
    """A linear model along its record: the same steps in every window."""

    def __init__(self, model: Dynamics, run: Run) -> None:
        self.model, self.run = model, run
        self.steps = discretised(model, coefficients(model, run))

    def along(self, states: Array, first: int) -> Steps:
        """Samples from `first` on."""
        last = first + len(states)
        parts = {name: getattr(self.steps, name)[first:last] for name in ("C", "d", "R", "y")}
        moved = {n: getattr(self.steps, n)[first : last - 1] for n in ("Phi", "forced", "Q")}
        return Steps(**moved, **parts, of_Phi=self.steps.of_Phi, of_C=self.steps.of_C)

    def after(self, x: Array, sample: int) -> Array:
        """The state a sample after one."""
        return np.asarray(self.steps.Phi[sample] @ x + self.steps.forced[sample])


class _Nonlinear:
    """A nonlinear model along its record, linearised along the states of each window."""

    def __init__(self, model: Dynamics, run: Run) -> None:
        if uncertain(model):
            raise UsageError(
                f"{model.name}: noise of {', '.join(uncertain(model))} acts on how fast its states "
                "change, which a horizon does not follow: leave that noise out, or --horizon"
            )
        self.model, self.run = model, run
        time, pace = checked_record(model, run), Pace.of(model, run)
        share = shares(np.diff(time), pace)
        self.sampled = Sampled.of(model, run, replace(pace, share=share))

    def along(self, states: Array, first: int) -> Steps:
        """Samples from `first` on, linearised along states (K, n)."""
        return self.sampled.along(states, first)

    def after(self, x: Array, sample: int) -> Array:
        """The state a sample after one."""
        return self.sampled.after(x, sample)


def _next(source: _Linear | _Nonlinear, before: _Window | None, k: int, horizon: int) -> _Window:
    """The window that ends at sample k, begun from the one before it."""
    model = source.model
    if before is None:
        start, covariance, first = model.start, model.start_covariance, 0
        along = start[None]
    else:
        first, start, covariance = before.first, before.start, before.covariance
        along = np.vstack([before.states, source.after(before.states[-1], k - 1)])
        if len(before.states) > horizon:  # its first sample goes, and leaves what it said
            first, along = first + 1, along[1:]
            start, covariance = before.filtered.predicted_x[1], before.filtered.predicted_P[1]
    return _solved(source, first, start, covariance, along)


def _solved(
    source: _Linear | _Nonlinear, first: int, start: Array, covariance: Array, along: Array
) -> _Window:
    """Gauss-Newton rounds over one window, each within the bounds."""
    model, innovation, settled, count = source.model, None, False, 0
    while not settled and count < ROUNDS:
        count += 1
        steps = source.along(along, first)
        found = kalman(steps, start, covariance)
        if innovation is None:
            said = steps.C[-1] @ along[-1] + steps.d[-1]
            innovation = np.where(steps.present[-1], steps.y[-1] - said, np.nan), found.S[-1]
        x, P = smoothed(steps, found) if len(along) > 1 else (found.x, found.P)
        if not np.isfinite(x).all():
            raise _diverged(source, first)
        held = kept(steps, covariance, x, model.bounds)
        if held is not None and held.states is None:
            raise _nowhere(source, first, held.worst)
        x = x if held is None or held.states is None else held.states
        std = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-300))
        settled = model.linear or bool(np.max(np.abs(x - along) / std) < SETTLED)
        along = x
    P = P if held is None else P - held.known
    assert innovation is not None
    return _Window(first, start, covariance, along, P, found, innovation, held, count, settled)


def _diverged(source: _Linear | _Nonlinear, first: int) -> DataError:
    run = source.run
    return DataError(
        f"{run.file or run.name}: the horizon of {source.model.name} that begins at row "
        f"{int(run.rows[first])} diverges: start= and std= must lie where the model holds"
    )


def _nowhere(source: _Linear | _Nonlinear, first: int, worst: tuple[int, int]) -> DataError:
    run, (sample, number) = source.run, worst
    return DataError(
        f"{run.file or run.name}: {source.model.names[number]} leaves its bounds at row "
        f"{int(run.rows[first + sample])} whatever the readings say: nothing that is uncertain "
        "moves it; give driving noise (intensity=), a larger std=, or wider bounds"
    )


def _empty(model: Dynamics, run: Run, horizon: int) -> Horizon:
    N, n, m = len(run), model.size, model.traced.h.numel()
    x, std, own, own_std, innovations, expected = (np.empty((N, s)) for s in (n, n, n, n, m, m))
    return Horizon(
        model,
        np.asarray(run.time, float),
        x,
        std,
        own,
        own_std,
        innovations,
        expected,
        np.empty(N),
        horizon=horizon,
        multipliers=np.zeros((N, 2, n)),
        rounds=np.zeros(N, dtype=int),
        seconds=np.empty(N),
        unsettled=np.zeros(N, dtype=bool),
    )


def _put(found: Horizon, run: Run, window: _Window, k: int, whole: bool) -> None:
    """What a window says of its end, and of its first sample, or of its `whole`, as the last to."""
    x, P = known(found.model, run.take(slice(k, k + 1)), window.states[-1:], window.spread[-1:])
    found.x[k], found.std[k] = x[0], _std(P)[0]
    nu, S = window.innovation
    found.innovations[k], found.expected_std[k] = nu, np.sqrt(np.diag(S))
    found.normalised_innovations[k] = normalised(nu[None], S[None])[0]
    found.rounds[k], found.unsettled[k] = window.rounds, not window.settled
    count = len(window.states) if whole else 1
    own = slice(window.first, window.first + count)
    x, P = known(found.model, run.take(own), window.states[:count], window.spread[:count])
    found.smoothed[own], found.smoothed_std[own] = x, _std(P)
    found.multipliers[own] = 0.0 if window.held is None else window.held.multipliers[:count]


def _std(covariances: Array) -> Array:
    """Standard deviations (K, n); where a bound acts there is none, but for rounding."""
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
