"""States along a record of any length: the filter and smoother in pieces, with what is to be shown.

The filter runs over the record once and keeps where it was at the beginning of every piece; from
the last piece to the first it runs again, and the smoother back over it. What readings after a
piece tell of its end is all that goes from one to the next. Numbers are those of the whole at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics import rounds
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import (
    Brief,
    Packed,
    Steps,
    normalised,
    smoothed_before,
    smoothed_brief,
    states,
    std_of,
    stopped,
)
from casest.dynamics.filter import (
    ALIKE,
    PASSES,
    ROUNDS,
    SETTLED,
    Filtered,
    discretised,
    filtered,
    refuse_divergence,
    unmoved,
)
from casest.dynamics.hindsight import Passes
from casest.dynamics.inputs import as_read, uncertain
from casest.dynamics.known import known, shown
from casest.dynamics.packing import packed
from casest.dynamics.riccati import check_covariance
from casest.dynamics.transition import (
    Pace,
    checked_record,
    linearised,
    process_along,
    shares,
)

#: Samples of a piece.
PIECE = 4096
#: Numbers of a nonlinear model's piece: all but the last are linearised twice a round.
LARGEST = 2**24


@dataclass(frozen=True)
class Course:
    """States x (N, n) with their std, by the readings so far and by all of them, and innovations
    (N, m) with the std that is expected of them, NaN where a reading is missing.

    `normalised_innovations` (N,): νᵀS⁻¹ν of every complete reading; `settled`: did the rounds of a
    nonlinear model's smoother settle? `least`: see `Filtered`.
    """

    model: Dynamics
    time: Array
    x: Array
    std: Array
    smoothed: Array
    smoothed_std: Array
    innovations: Array
    expected_std: Array
    normalised_innovations: Array
    settled: bool = True
    least: float = 1.0

    @property
    def end(self) -> tuple[Array, Array]:
        """State (n,) and its std at the end of the record, as all of it says (see `Filtered`)."""
        if self.settled:
            return self.smoothed[-1], self.smoothed_std[-1]
        return self.x[-1], self.std[-1]


def followed(model: Dynamics, run: Run, *, smooth: bool = True) -> Course:
    """Filter and smoother over a record in constant memory beyond the result, a nonlinear model's
    states once more; where inputs with noise enter the coefficients, twice what a pass goes along
    (`hindsight`), or, of a nonlinear one, all covariances.

    Raises DataError as `filtered` does.
    """
    check_covariance(model.start_covariance, "the covariance at the beginning")
    if uncertain(model) and not model.linear:
        return _of(filtered(model, run, smooth=smooth))
    pieces = Pieces.of(model, run)
    if uncertain(model):
        return _in_hindsight(pieces, smooth)
    if not model.linear:
        return _nonlinear(pieces, smooth)
    found, begun, state = _empty(pieces, smooth), list[States](), pieces.start
    if smooth:
        for where in pieces.every[:-1]:
            along, state = pieces.ahead(where, state)
            begun.append(along)
        _back(found, pieces, [*begun, state])
        return found
    for where in pieces.every:
        _, own, state = pieces.filtered(where, state)
        _put(found, slice(where.stop - len(own.x), where.stop), own)
    return found


def _in_hindsight(pieces: Pieces, smooth: bool) -> Course:
    found = _empty(pieces, smooth)
    passes = Passes.of(pieces.model, pieces.run, pieces.pace, pieces.every)
    along = passes.first()

    def put(where: slice, x: Array, std: Array) -> None:
        if smooth:
            found.smoothed[where], found.smoothed_std[where] = x, std

    for k in range(PASSES + 1):
        change, end = passes.smooth(along, lambda where, own: _put(found, where, own), put)
        if k and change < ALIKE:
            break
    return replace(found, least=passes.least(along, end))


def _nonlinear(pieces: Pieces, smooth: bool) -> Course:
    model, run, pace, every = pieces.model, pieces.run, pieces.pace, pieces.every
    each = LARGEST // (10 * model.size**2 + 4 * model.size * model.traced.h.numel())
    longer = cuts(len(run), max(PIECE, each))
    found = _empty(pieces, smooth)
    along = np.empty_like(found.x) if smooth else found.x
    for where, x, P, innovations, S in rounds.filtered(model, run, pace, every):
        refuse_divergence(model, run.take(where), x)
        along[where] = x
        found.x[where], found.std[where] = pieces.known(where, x, P)
        found.innovations[where], found.expected_std[where] = innovations, std_of(S)
        found.normalised_innovations[where] = normalised(innovations, S)
    if not smooth:
        return found
    first = _settled(found, pieces, longer, along)
    if first is None:
        return found
    again = unmoved(model, run)
    if np.isfinite(again).all() and _settled(found, pieces, longer, again) is None:
        return found
    return replace(found, smoothed=first[0], smoothed_std=first[1], settled=False)


def _settled(
    found: Course, pieces: Pieces, longer: Sequence[slice], along: Array
) -> tuple[Array, Array] | None:
    """Rounds from states `along` until they stay, into `found`; where they do not, the states and
    standard deviations of the first."""
    first: tuple[Array, Array] | None = None
    for _ in range(ROUNDS):
        change, later = 0.0, np.empty_like(along)
        for where, x, P in rounds.smoothed(pieces.model, pieces.run, pieces.pace, longer, along):
            std = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-300))
            # What is known exactly is put in here, too: from afar its slope leads astray.
            later[where], found.smoothed_std[where] = pieces.known(where, x, P)
            own = np.max(np.abs(later[where] - along[where]) / std)
            change = float(np.maximum(change, own))  # what is no number stays so
        found.smoothed[:] = later
        along, first = later, first or (found.smoothed.copy(), found.smoothed_std.copy())
        if change < SETTLED:
            return None
        if not np.isfinite(change):
            break
    return first


#: Where the filter has come to, as factored: with noise along the start, and along its own states.
States = tuple[Array | None, Array | None]


def cuts(count: int, length: int) -> tuple[slice, ...]:
    """Pieces of so many samples of a record, which share their ends."""
    last = count - 1
    return tuple(slice(k, min(k + length, last) + 1) for k in range(0, last, length))


@dataclass(frozen=True)
class Pieces:
    """A record and the model along it, in pieces that share their ends."""

    model: Dynamics
    run: Run
    pace: Pace
    time: Array
    every: tuple[slice, ...]
    start: States = (None, None)

    @staticmethod
    def of(model: Dynamics, run: Run) -> Pieces:
        """A whole record."""
        time = checked_record(model, run)
        pace = Pace.of(model, run)
        pace = replace(pace, share=shares(np.diff(time), pace))
        return Pieces(model, run, pace, time, cuts(len(time), PIECE))

    def filtered(self, where: slice, begun: States) -> tuple[Steps | Packed, Brief, States]:
        """The steps of a piece, the filter at every sample after its first, and where it came to.

        At the beginning of the record: at its first sample too.
        """
        steps, first = self._steps(where, begun)
        found = shown(self.model, self.run, where, steps, begun[1])
        # Copied: a view would keep the whole piece.
        return steps, found, (first, found.factored[-1].copy())

    def ahead(self, where: slice, begun: States) -> tuple[States, States]:
        """Where the filter comes to alone, along the piece and at its end: half of the work."""
        (steps, first), model = self._steps(where, begun), self.model
        along, end = stopped(steps, begun[1], model.start, model.start_covariance)
        return (begun[0], along), (first, end)

    def smoothed(
        self, where: slice, steps: Steps | Packed, factored: Array, told: Array
    ) -> tuple[Array, Array, Array]:
        """States and std of all samples but the last, and what is told of the first."""
        if not self.model.traced.g.numel():
            return smoothed_brief(steps, factored, told)
        x, P, told = smoothed_before(steps, factored, told)
        return *self.known(slice(where.start, where.stop - 1), x, P), told

    def _steps(self, where: slice, begun: States) -> tuple[Steps | Packed, Array | None]:
        model, own = self.model, self.run.take(where)
        pace = self.pace.part(where)
        if begun[1] is not None and (found := packed(model, own, pace)) is not None:
            return found, None
        system, first = linearised(model, own, pace=pace, calm=as_read(model, own)), None
        if model.input_noise is not None:
            early = states(discretised(model, system), begun[0], model.start,
                           model.start_covariance)  # fmt: skip
            whole = early if begun[0] is None else np.vstack([begun[0], early])
            system = system.driven(process_along(model, own, whole[:, : model.size], pace))
            first = early[-1].copy()
        return discretised(model, system), first

    def known(self, where: slice, x: Array, P: Array) -> tuple[Array, Array]:
        """With what is known exactly put in: states and their standard deviations."""
        x, P = known(self.model, self.run.take(where), x, P)
        # What is known exactly has a variance of zero, but for rounding.
        return x, np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))


def _back(found: Course, pieces: Pieces, begun: list[States]) -> None:
    n = pieces.model.size
    told = np.zeros(n * n + 2 * n)
    for where, state in zip(pieces.every[::-1], begun[::-1], strict=True):
        steps, own, _ = pieces.filtered(where, state)
        _put(found, slice(where.stop - len(own.x), where.stop), own)
        factored = own.factored
        if state[1] is not None:
            factored = np.vstack([np.atleast_2d(state[1])[0], factored])
        x, std, told = pieces.smoothed(where, steps, factored[:-1], told)
        before = slice(where.start, where.stop - 1)
        found.smoothed[before], found.smoothed_std[before] = x, std
    found.smoothed[-1], found.smoothed_std[-1] = found.x[-1], found.std[-1]


def _put(found: Course, where: slice, own: Brief) -> None:
    for name in ("x", "std", "innovations", "expected_std", "normalised_innovations"):
        getattr(found, name)[where] = getattr(own, name)


def _empty(pieces: Pieces, smooth: bool) -> Course:
    N, n, m = len(pieces.time), pieces.model.size, pieces.model.traced.h.numel()
    sizes = (n, n, n, n, m, m)
    x, std, own, own_std, innovations, expected = (np.empty((N, size)) for size in sizes)
    both = (own, own_std) if smooth else (x, std)
    readings = innovations, expected, np.empty(N)
    return Course(pieces.model, pieces.time, x, std, *both, *readings)


def _of(found: Filtered) -> Course:
    return Course(
        found.model,
        found.time,
        found.x,
        found.std,
        found.smoothed,
        found.smoothed_std,
        found.innovations,
        std_of(found.S),
        found.normalised_innovations,
        found.settled,
        found.least,
    )
