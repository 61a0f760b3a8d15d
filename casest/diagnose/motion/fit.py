"""A moving estimator with effects, fitted to a record: noise by likelihood, numbers by scoring."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.diagnose.motion.delays import by_reading, shifted, shifts_of
from casest.diagnose.motion.sensitivity import Sensitivity, sensitivity
from casest.dynamics.declare import Dynamics
from casest.dynamics.filter import Filtered, filtered
from casest.dynamics.likelihood import (
    Prepared,
    applied,
    first_guess,
    matched,
    noiseless,
    prepared,
    reached,
    whitened,
)
from casest.dynamics.transition import process_along
from casest.effects.moving import Candidate, Colour, extended

#: Rounds of scoring of an effect's numbers, and the step in standard deviations that ends it.
ROUNDS, ENOUGH = 4, 0.1
#: Correlation times of noise that are tried, logarithms of samples: the shortest, where the search
#: begins, the longest, and the steps.
FIRST, MIDDLE, LAST, WIDE = np.log([2.5, 9.0, 350.0, 3.2]).tolist()
#: A start is forgotten where a reading's variance is below so many times its usual one.
FORGOTTEN = 2.0


@dataclass(frozen=True)
class Fit:
    """An estimator with effects at their most likely numbers, and its filter over the record.

    `run`: the record, readings that come late moved by `shifts` samples; `ready`: it made ready
    for its likelihoods; `answers`: how the innovations answer to the numbers of `added`; None where
    there are none.
    `last_step`: of the scoring, in standard deviations; `bounded`: are the intensities plausible
    ones, or whatever the record asks for?
    """

    base: Dynamics
    model: Dynamics
    added: tuple[tuple[Candidate, Array], ...]
    colour: Colour | None
    intensities: Mapping[str, float]
    likelihood: float
    run: Run
    shifts: Mapping[str, int]
    ready: Prepared
    found: Filtered
    answers: Sensitivity | None
    last_step: float = 0.0
    bounded: bool = True

    @property
    def trusted(self) -> bool:
        """Is it the most likely one, as far as its scoring says?"""
        return bool(np.isfinite(self.likelihood)) and self.last_step < 1.0

    def by_reading(self, values: Array) -> Array:
        """Values of readings (N, m) in the rows that these have in the file."""
        return by_reading(self.base, self.shifts, values)

    def lighter(self) -> Fit:
        """The same without the transitions and the noise along the record: to be looked at, and
        judged, but no longer filtered."""
        ready = replace(self.ready, system=replace(self.ready.system))
        system = replace(self.found.system, process=self.model.process)
        found = replace(self.found, system=system)
        return replace(self, ready=ready, found=found)

    def with_spread(self) -> Fit:
        """The same with the covariances of the smoothed states, which the loop has no use for."""
        if not self.model.linear:  # by its own steps, which straight lines of A(t) only follow
            found = filtered(self.model, self.run)
            x, P, settled = found.smoothed, found.smoothed_P, found.settled
            own = replace(self.found, smoothed=x, smoothed_P=P, settled=settled)
            return replace(self, found=own)
        process = process_along(self.model, self.run, self.found.smoothed)
        found = filtered(self.model, self.run, system=self.ready.system.driven(process))
        return replace(self, found=replace(self.found, smoothed_P=found.smoothed_P))

    @property
    def std(self) -> Array:
        """Standard deviation of all numbers of the effects, in order."""
        if self.answers is None:
            return np.zeros(0)
        H = self.answers.H
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(np.einsum("kij,kil->jl", H, H)))))


def rise(fit: Fit, other: Fit) -> float:
    """By how much the log-likelihood of a fit is above another's, on the readings of both.

    Where readings were moved in time the first ones are lost: then only those count that come once
    both filters have forgotten the start.
    """
    if fit.shifts == other.shifts:
        return fit.likelihood - other.likelihood
    (one, first), (two, second) = (_log_densities(f) for f in (fit, other))
    return float(np.sum((one - two)[np.isfinite(one - two) & first & second]))


def _log_densities(fit: Fit) -> tuple[Array, NDArray[np.bool_]]:
    """Of every reading given those before it (N, m), and whether the start is forgotten there."""
    e, s = whitened(fit.ready, fit.intensities)
    density = np.where(fit.ready.present, -0.5 * (np.log(2 * np.pi * s) + e**2 / s), np.nan)
    return fit.by_reading(density), forgotten(fit)[:, None]


def forgotten(fit: Fit) -> NDArray[np.bool_]:
    """Which readings count, (N,): what the filter expects there is not the start's doing."""
    expected = fit.by_reading(np.diagonal(fit.found.S, axis1=1, axis2=2))
    usual = np.nanmedian(expected, axis=0)
    return np.asarray(~(expected > FORGOTTEN * usual).any(axis=1))


def fitted(
    base: Dynamics,
    run: Run,
    along: Array,
    *,
    added: Sequence[tuple[Candidate, Array]] = (),
    colour: Colour | None = None,
    start: Mapping[str, float] | None = None,
    bounded: bool = True,
) -> Fit:
    """Numbers and intensities in turn, from given ones. `along`: states (N, n) to begin with."""
    added = tuple(added)
    last = 0.0
    for k in range(ROUNDS if added else 1):
        fit = _tuned(base, run, along, added, colour, start, bounded)
        if not added:  # a nonlinear model: once more, along what these intensities lead to
            again = (base, run, fit.found.smoothed, added, colour, fit.intensities, bounded)
            return fit if base.linear else _tuned(*again)
        assert fit.answers is not None
        H, z = fit.answers.H, fit.answers.z
        information = np.einsum("kij,kil->jl", H, H)
        step = np.linalg.solve(information, np.einsum("kij,ki->j", H, z))
        last = float(np.max(np.abs(step) * np.sqrt(np.diag(information))))
        fit = replace(fit, last_step=last)
        if last < ENOUGH or k == ROUNDS - 1:
            return fit
        added, start, along = _moved(fit, step), fit.intensities, fit.found.smoothed
        del fit, H, z  # the next one needs the room
    raise AssertionError


def _moved(fit: Fit, step: Array) -> tuple[tuple[Candidate, Array], ...]:
    assert fit.answers is not None
    pairs = zip(fit.added, fit.answers.columns, strict=True)
    return tuple((c, v + step[where]) for (c, v), where in pairs)


def _tuned(
    base: Dynamics,
    run: Run,
    along: Array,
    added: tuple[tuple[Candidate, Array], ...],
    colour: Colour | None,
    start: Mapping[str, float] | None,
    bounded: bool,
) -> Fit:
    shifts = shifts_of(base, run, added)
    run = shifted(base, run, shifts)
    grown = extended(base, added, colour)
    along = np.pad(along[:, : grown.size], ((0, 0), (0, max(0, grown.size - along.shape[1]))))
    ready = prepared(grown, run, along)
    known = {name: value for name, value in (start or {}).items() if name in ready.names}
    most = plausible(base, ready, run) if bounded else None
    intensities, likelihood = matched(ready, run, known, most=most)
    model = applied(grown, intensities)
    found = filtered(model, run, system=ready.driven(intensities), spread=False)
    tried = [c for c, _ in added]
    answers = sensitivity(base, added, tried, run, found) if added else None
    fit = Fit(
        base, model, added, colour, intensities, likelihood, run, shifts, ready, found, answers
    )
    return replace(fit, bounded=bounded)


def plausible(base: Dynamics, ready: Prepared, run: Run) -> dict[str, float]:
    """The largest intensities that are noise: beyond them something is missing.

    Of inputs, and of readings of which it was stated, by what was stated or the signal shows from
    sample to sample; of a state's own by what was declared.
    """
    guess = first_guess(ready, run)
    states = {s.name: s.intensity for s in base.states if s.intensity}
    signals = {n: q for n, q in guess.items() if n in run.signals and n not in ready.readings}
    stated = {n: q for n, q in base.sensors.items() if n in ready.names}
    known = {**states, **signals, **stated}
    return {n: LEVELS.loud * q for n, q in known.items() if n in ready.names}


def unbounded(fit: Fit, run: Run) -> tuple[dict[str, float], float]:
    """The intensities that the record asks for where none is too large, and their likelihood."""
    return matched(fit.ready, run, fit.intensities)


def coloured(fit: Fit, run: Run) -> Fit:
    """The same with correlated noise on the signal that it helps most, over the best time."""
    inputs, _ = reached(fit.base, noiseless(fit.base, fit.run))
    trials = [_best_colour(fit, run, name) for name in (*fit.base.measured_signals, *inputs)]
    return max(trials, key=lambda f: f.likelihood)


def _best_colour(fit: Fit, run: Run, name: str) -> Fit:
    """From the middle of the correlation times towards where the likelihood rises; between those
    that enclose the best by a parabola over their logarithms."""
    step = float(np.median(np.diff(fit.found.time)))
    signal = next(s for s in fit.base.signals if s.name == name)
    done: dict[float, Fit] = {}

    def at(logarithm: float) -> float:
        if not FIRST <= logarithm <= LAST:
            return -np.inf
        if logarithm not in done:
            tau = float(np.exp(logarithm)) * step
            std = _size_of_colour(fit, name, tau)
            colour = Colour(name, signal.size, signal.unit or "1", tau, std)
            found = fitted(fit.base, run, fit.found.smoothed, added=fit.added, colour=colour,
                           start=fit.intensities)  # fmt: skip
            done[logarithm] = found.lighter()
        return done[logarithm].likelihood

    best = MIDDLE if at(MIDDLE) > at(MIDDLE + WIDE) else MIDDLE + WIDE
    way = -WIDE if best == MIDDLE else WIDE
    while at(best + way) > at(best):
        best += way
    low, middle, high = at(best - WIDE), at(best), at(best + WIDE)
    bend = low - 2 * middle + high
    if np.isfinite(bend) and bend < 0:
        at(best + 0.5 * WIDE * (low - high) / bend)
    return max(done.values(), key=lambda f: f.likelihood)


def _size_of_colour(fit: Fit, name: str, tau: float) -> float:
    """About how large it is: half of an output's innovations, or as intense as an input's noise."""
    if name not in fit.ready.readings:
        return float(np.sqrt(fit.intensities[name] / (2 * tau)))
    return float(np.nanmedian(np.abs(fit.found.innovations[:, fit.ready.readings[name]]))) / 2
