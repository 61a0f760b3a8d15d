"""The noise of an old fit as a later one is judged by it: its size, and its colour by frequency."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.estimate.correlation import is_series
from casest.estimate.covariance import inverse_normal, stretches
from casest.estimate.estimate import Estimate
from casest.estimate.spectrum import Certainty, Powers, by_frequency, noise_spectrum
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import SAMPLED

#: Frequencies at which a spectrum is kept, evenly in their logarithm, ...
KEPT = 25
#: ... from so much on, over the samples of the record.
LOWEST = 0.25


@dataclass(frozen=True)
class Colour:
    """Power (m, K) of each axis over frequency (K,), up to a factor.

    Frequencies are in cycles per sample of a record with `rate` samples a second, which is NaN
    where nobody knows.
    """

    frequency: Array
    power: Array
    rate: float

    def asked(self, count: int, rate: float) -> Array:
        """Logarithms (count,) of the frequencies of the cosine transform of so many samples."""
        ratio = rate / self.rate if np.isfinite(rate) and np.isfinite(self.rate) else 1.0
        return np.asarray(np.log(ratio * (np.arange(count) + 0.5) / (2 * count)))

    @cached_property
    def certainty(self) -> Certainty:
        """How well it is known of a record as long as the one that showed it."""
        return Certainty(max(round(LOWEST / float(self.frequency[0])), 1))

    def at(self, count: int, rate: float) -> Array:
        """Power (count, m) at the frequencies of the cosine transform of so many samples."""
        asked = self.asked(count, rate)
        log = np.log(self.frequency)
        power = np.stack([np.exp(np.interp(asked, log, np.log(p))) for p in self.power], axis=1)
        return np.asarray(power / power.mean(axis=0))


def rate_of(run: Run) -> float:
    """Samples per second; NaN without a time."""
    if run.time is None or len(run) < 2:
        return float("nan")
    return 1 / float(np.median(np.diff(run.time)) or np.nan)


def autoregressive(correlated_over: float, axes: int) -> Colour | None:
    """The colour of first-order noise that is correlated over so many samples; None of one."""
    if not correlated_over > 1:
        return None
    phi = (correlated_over - 1) / (correlated_over + 1)
    frequency = np.geomspace(1e-5, 0.5, KEPT)
    power = 1 / (1 + phi**2 - 2 * phi * np.cos(2 * np.pi * frequency))
    return Colour(frequency, np.tile(power, (axes, 1)), float("nan"))


def colour_of(found: Estimate) -> Colour | None:
    """The colour of a fit's residual; None where it is white."""
    if not found.correlated_over > 1 or not found.identifiability.rank:
        return None
    at = found.optimum or found.point
    bread = inverse_normal(found.problem.factor(at)[0], found.free)
    return spectrum_of(found.problem, at, bread)


def spectrum_of(problem: Problem, point: Point, bread: Array) -> Colour | None:
    """The smooth spectrum of the residual there; `bread` (n, n) is (JᵀJ)⁻¹."""
    axes = range(len(problem.model.axes))
    parts: list[list[Powers]] = [[] for _ in axes]
    longest = max(map(len, problem.runs))
    light = problem.residual_count > SAMPLED
    for k, stretch in enumerate(stretches(problem, point)):
        if light and k * len(axes) * len(stretch.residual) > SAMPLED:
            break
        for part in by_frequency(stretch, bread):
            parts[part.axis].append(part.powers)
    frequency = np.geomspace(LOWEST / longest, 0.5, KEPT)
    each = np.array([noise_spectrum(own)(frequency) for own in parts])
    if not (np.isfinite(each).all() and (each > 0).all()):
        return None
    rates = [rate_of(run) for run in problem.runs if is_series(run)]
    rate = float(np.median(rates)) if rates else float("nan")
    return Colour(frequency, each / each.mean(axis=1, keepdims=True), rate)
