"""Kalman filter and fixed-interval smoother on a sampled record with A(t), gaps, missing readings.

Between samples the exact transition of the (straight-line) signals; a reading's variance is its
noise's intensity over the usual time between two, however they lie. A reading that is missing in
part is used in part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import (
    Steps,
    kalman,
    normalised,
    smoothed,
    smoothed_states,
    std_of,
)
from casest.dynamics.extended import Sampled, extended, shifted, with_errors
from casest.dynamics.inputs import uncertain
from casest.dynamics.known import known
from casest.dynamics.likely import Inputs
from casest.dynamics.riccati import check_covariance
from casest.dynamics.stepping import entries, reach
from casest.dynamics.transition import (
    Linearised,
    acting,
    linearised,
    process_along,
    variances,
    with_lost,
)
from casest.errors import DataError

#: Rounds of an extended smoother, linearised along its own states; a change of this share of a
#: standard deviation ends them.
ROUNDS, SETTLED = 30, 1e-5
#: Passes of a filter with noisy coefficients; a change of this share of every standard deviation
#: ends them, and rounds about noise of inputs that come no nearer.
PASSES, ALIKE = 8, 0.01


@dataclass(frozen=True)
class Filtered:
    """States over time with covariances, and what each reading said.

    time (N,); x (N, n) and P (N, n, n) after each reading; predicted_x, predicted_P before it;
    innovations y − Cx (N, m), their covariance S (N, m, m), NaN where a reading is missing.
    `smoothed` and `smoothed_P` use the whole record.
    """

    model: Dynamics
    system: Linearised
    x: Array
    P: Array
    predicted_x: Array
    predicted_P: Array  # noqa: N815
    innovations: Array
    S: Array
    smoothed: Array
    smoothed_P: Array  # noqa: N815
    #: Did the rounds of a nonlinear model's smoother settle? If not, its states are approximate.
    settled: bool = True
    #: Mean of the squared errors at the end over what P says, at the least: below one where noise
    #: of inputs acts on what the record does not tell, which is counted as if it were white.
    least: float = 1.0

    @property
    def time(self) -> Array:
        """Time of every sample, s."""
        return self.system.time

    @property
    def std(self) -> Array:
        """Standard deviation of every state after each reading, (N, n)."""
        return std_of(self.P)

    @property
    def smoothed_std(self) -> Array:
        """Standard deviation of every state by the whole record, (N, n)."""
        return std_of(self.smoothed_P)

    @property
    def expected_std(self) -> Array:
        """Standard deviation that the filter expects of its innovations, (N, m)."""
        return std_of(self.S)

    @property
    def end(self) -> tuple[Array, Array]:
        """State (n,) and covariance (n, n) at the end of the record, as all of it says.

        The smoother's, which linearises along the whole record; the filter's, which of a nonlinear
        model linearised at what it knew at the time, where that did not settle.
        """
        if self.settled:
            return self.smoothed[-1], self.smoothed_P[-1]
        return self.x[-1], self.P[-1]

    @property
    def normalised_innovations(self) -> Array:
        """νᵀS⁻¹ν of every complete reading, (N,): χ² with m degrees of freedom if all is right."""
        return normalised(self.innovations, self.S)


def filtered(
    model: Dynamics,
    run: Run,
    *,
    smooth: bool = True,
    spread: bool = True,
    system: Linearised | None = None,
) -> Filtered:
    """Kalman filter over a record, and smoother; for a nonlinear model the extended ones.

    The extended filter linearises at each prediction; its smoother is iterated: the record is
    linearised along the smoothed states until they stay (the most probable trajectory). Where the
    noise of inputs reaches a linear model through its states, it is taken along the estimates of a
    first pass; where it enters the coefficients too, along smoothed states, in passes. What
    is known exactly (`constraint`) is put into every estimate and not fed back.

    `system`: the model along the record, where it is known already; a nonlinear one is then linear
    along it, and the filter too is linearised where all readings lead. `spread` False: smoothed
    states of a linear one without their covariances (the filter's in their place): half the time.
    Raises DataError where time or inputs are not usable, or a covariance is none.
    """
    check_covariance(model.start_covariance, "the covariance at the beginning")
    if not model.linear and system is None:
        return _extended(model, run, smooth)
    if system is None and uncertain(model):
        return _in_hindsight(model, run, smooth)
    return _once(model, run, system or coefficients(model, run), smooth, spread)


def coefficients(model: Dynamics, run: Run) -> Linearised:
    """A linear model along a record; noise that depends on the states, along a first estimate.

    Where the noise of inputs acts on the errors of the states too, as large as they are with it.
    """
    system = linearised(model, run)
    if model.input_noise is None:
        return system
    first = _once(model, run, system, smooth=False)
    if not uncertain(model):
        return system.driven(process_along(model, run, first.x))
    for _ in range(PASSES):
        system = linearised(model, run, first.x)
        system = system.driven(system.process + acting(model, run, first.x, first.P))
        before, first = first, _once(model, run, system, smooth=False)
        if np.max(np.abs(first.std / before.std - 1)) < ALIKE:
            break
    return system


def _in_hindsight(model: Dynamics, run: Run, smooth: bool) -> Filtered:
    """A linear model with uncertain coefficients, filtered and smoothed along smoothed states until
    these stay.

    What an estimated input is wrong by acts on x − x̄. Along the filter's own states that is as
    large as what it did not know early in the record, the same for long, and no white noise: its
    normalised errors were 10.8 of nine where smoothed states leave 9 (studies/inputs.md).
    """
    found = _once(model, run, coefficients(model, run), smooth=True)
    for _ in range(PASSES):
        system = linearised(model, run, found.smoothed)
        noise = acting(model, run, found.smoothed, found.smoothed_P)
        before, found = found, _once(model, run, system.driven(system.process + noise), smooth=True)
        moved = np.abs(found.smoothed - before.smoothed)
        if np.max(moved / np.maximum(found.smoothed_std, 1e-300)) < ALIKE:
            break
    found = replace(found, least=_least(model, run, found))
    return found if smooth else replace(found, smoothed=found.x, smoothed_P=found.P)


def _least(model: Dynamics, run: Run, found: Filtered) -> float:
    process = process_along(model, run, found.smoothed)
    exact = _once(model, run, found.system.driven(process), smooth=False)
    return share_left(found.P[-1], exact.P[-1])


def share_left(P: Array, without: Array) -> float:
    """tr(P⁻¹P₀)/n, with P₀ `without` errors of the inputs; of what is not certain in P (n, n)."""
    std = np.sqrt(np.diag(P))
    open_ = std > 0
    scale = np.outer(std[open_], std[open_])
    P, without = (x[np.ix_(open_, open_)] / scale for x in (P, without))
    return float(np.trace(np.linalg.pinv(P, hermitian=True) @ without)) / max(len(P), 1)


def _extended(model: Dynamics, run: Run, smooth: bool) -> Filtered:
    x, P, before_x, before_P, innovations, S = extended(model, run)
    refuse_divergence(model, run, x)
    before = before_x, before_P, innovations, S
    after = known(model, run, x, P)
    if not smooth:
        return Filtered(model, linearised(model, run, x), *after, *before, *after)
    along, smooth_P, settled = trajectory(model, run, x, P)
    begun = x if settled else unmoved(model, run)
    if not settled and np.isfinite(begun).all():
        other = trajectory(model, run, begun, np.zeros_like(P))
        along, smooth_P, settled = other if other[2] else (along, smooth_P, settled)
    both = along, smooth_P
    return Filtered(model, linearised(model, run, along), *after, *before, *both, settled)


def unmoved(model: Dynamics, run: Run) -> Array:
    """States (N, n) from the declared start on, by the inputs alone: where rounds begin again that
    did not settle from states of a filter gone astray."""
    with np.errstate(all="ignore"):
        return Sampled.of(model, run).followed(model.start)


def refuse_divergence(model: Dynamics, run: Run, x: Array) -> None:
    """DataError where states (N, n) of the extended filter are not finite."""
    if np.all(np.isfinite(x)):
        return
    row = int(run.rows[np.flatnonzero(~np.isfinite(x).all(axis=1))[0]])
    raise DataError(
        f"{run.file or run.name}: the extended filter of {model.name} diverges at row {row}: "
        "start= and std= must lie where the model holds"
    )


def trajectory(
    model: Dynamics, run: Run, along: Array, errors: Array | None = None
) -> tuple[Array, Array, bool]:
    """The most probable states (N, n), their covariances, and whether they settled.

    Gauss-Newton on all states of the record, and on the noise of uncertain inputs, from states
    `along` of a filter with covariances `errors`, by smoothing again and again.
    Where the rounds do not settle, the first one's states.
    """
    first: tuple[Array, Array] | None = None
    sampled, noisy = Sampled.of(model, run), errors is not None and bool(shifted(model))
    P, change = np.empty(0) if errors is None else errors, np.inf
    inputs: Inputs | None = None
    for _ in range(ROUNDS):
        if not noisy:
            steps = sampled.along(along)
        elif first is None:
            steps = with_errors(sampled.along(along), model, run, along, P)
        else:
            kept = inputs if change < ALIKE else None
            inputs = Inputs.of(sampled, run, along, P, kept)
            steps = inputs.steps(sampled, run, along)
        before = along
        # What is known exactly is put in here, too: from afar its slope leads astray.
        along, P = known(
            model, run, *smoothed(steps, kalman(steps, model.start, model.start_covariance))
        )
        first = first or (along, P)
        std = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-300))
        earlier, change = change, float(np.max(np.abs(along - before) / std))
        # Next to a reading that is far off, rounds about its noise may come no nearer.
        if change < SETTLED or (noisy and earlier <= change < ALIKE):
            return along, P, True
        if not np.isfinite(change):
            break
    assert first is not None
    return *first, False


def discretised(model: Dynamics, system: Linearised) -> Steps:
    """The record in discrete time: exact transitions, and every reading with its variance."""
    moved = system.sampled
    Phi, forced = moved.Phi, moved.forced
    Q = with_lost(model, system.steps, Phi, moved.Q, system.pace)
    R = variances(model, system.steps, system.pace)
    t = model.traced
    return Steps(Phi, forced, Q, system.C, system.d, R, system.y, reach(t.A), entries(t.C))


def _once(
    model: Dynamics, run: Run, system: Linearised, smooth: bool, spread: bool = True
) -> Filtered:
    steps = discretised(model, system)
    found = kalman(steps, model.start, model.start_covariance)
    before = found.predicted_x, found.predicted_P, found.innovations, found.S
    after = known(model, run, found.x, found.P)
    if not smooth:
        both = after
    elif spread or model.traced.g.numel():
        both = known(model, run, *smoothed(steps, found))
    else:
        both = smoothed_states(steps, found), found.P
    return Filtered(model, system, *after, *before, *both)
