"""A fleet's distribution, and what it says of a sensor with few readings (empirical Bayes).

Sensors are xᵢ ~ N(μ, Σ), estimates x̂ᵢ ~ N(xᵢ, Vᵢ). μ and Σ by expectation and maximisation (Laird
& Ware, 1982): spread of the sensors, not of their noise. As a prior, it is n more residuals,
Λ½(x − μ), beside readings whose σ the fleet says; at the least sum of squares the covariance is
(JᵀJ/σ² + Λ)⁻¹, Λ = Σ⁻¹.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincc

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.engine.threads import one_thread
from casest.estimate.reasons import STEP, TOO_LARGE, Code
from casest.fleet.calibrate_many import (
    Batch,
    checked,
    entry_names,
    refuse_equations,
    unpacked,
)
from casest.fleet.fit import residual_counts
from casest.fleet.linear import backward, cholesky, forward, inverse
from casest.fleet.sums import Sensors, Squares, side_by_side, widest
from casest.fleet.verdicts import Judged, Verdicts
from casest.leastsquares.per_sample import residual_and_jacobian

#: Rounds of expectation and maximisation at most, and the change at which they end.
ROUNDS, CHANGE = 500, 1e-6
#: Steps of a fit at most.
STEPS = 30


@dataclass(frozen=True)
class Population:
    """N(μ, Σ) of the unknowns `names`: `mean` (n,), `covariance` (n, n); `sigma` of one residual.

    `mean_std` and `spread_std` (n,): uncertainty of μ, and of the standard deviations √Σₖₖ; from
    `count` sensors.
    """

    names: tuple[str, ...]
    mean: Array
    covariance: Array
    sigma: float
    mean_std: Array
    spread_std: Array
    count: int

    @property
    def spread(self) -> Array:
        """Standard deviation of each unknown over the fleet, (n,)."""
        return np.sqrt(np.diag(self.covariance))


def population(names: tuple[str, ...], x: Array, V: Array, sigma: Array) -> Population:
    """Mean and spread of S sensors from estimates (S, n), covariances (S, n, n) and σ (S,)."""
    scale = x.std(axis=0) + np.sqrt(V[:, range(x.shape[1]), range(x.shape[1])].mean(axis=0))
    x, V = x / scale, V / np.outer(scale, scale)
    mean, spread = x.mean(axis=0), np.cov(x.T).reshape(x.shape[1], -1)
    with one_thread():
        for _ in range(ROUNDS):
            gain = np.linalg.solve(spread + V, spread).swapaxes(1, 2)  # Σ(Σ + V)⁻¹
            away = np.einsum("sij,sj->si", gain, x - mean)
            left = spread - gain @ spread
            mean, before = mean + away.mean(axis=0), spread
            off = away - away.mean(axis=0)
            spread = left.mean(axis=0) + off.T @ off / len(x)
            if np.abs(spread - before).max() < CHANGE * np.diag(spread).max():
                break
        weight = np.linalg.inv(spread + V)
    mean_std = np.sqrt(np.diag(np.linalg.inv(weight.sum(axis=0))))
    own = 1 / (np.diag(spread) + V[:, range(len(mean)), range(len(mean))])
    spread_std = np.sqrt(2 / (own**2).sum(axis=0)) / (2 * np.sqrt(np.diag(spread)))
    return Population(
        names,
        mean * scale,
        spread * np.outer(scale, scale),
        float(np.sqrt(np.mean(sigma**2))),
        mean_std * scale,
        spread_std * scale,
        len(x),
    )


def calibrate_with(
    model: Model, signals: Mapping[str, Any], fleet: Population, counts: Any = None
) -> Batch:
    """As `calibrate_many`, each sensor taken as one of the fleet: few readings are enough.

    A sensor is refused whose readings, with the distance to the fleet, are less probable than one
    in a million; σ is the fleet's. `misfit` is that probability. Raises what `calibrate_many` does.
    """
    refuse_equations(model, "calibrate_with: a fleet is no prior for")
    readings, lengths = checked(model, signals, counts)
    size, samples = readings[0].shape[:2]
    n = len(fleet.mean)
    x, covariance = np.empty((size, n)), np.empty((size, n, n))
    sigma, misfit = np.full(size, fleet.sigma), np.empty(size)
    rmse, verdicts = np.empty(size), Verdicts.empty(entry_names(model), size)
    squares, width = Squares(residual_and_jacobian(model)), widest(samples)
    with np.errstate(all="ignore"), one_thread():
        for first in range(0, size, width):
            s = slice(first, min(first + width, size))
            own = None if lengths is None else lengths[s]
            sensors = side_by_side([r[s] for r in readings], own)
            found = _fitted(squares, sensors, fleet)
            total = s.stop - s.start
            x[s] = found.x[:, :total].T
            covariance[s] = found.judged.covariance[..., :total].transpose(2, 0, 1)
            misfit[s], rmse[s] = found.chance[:total], found.judged.rmse[:total]
            verdicts.put(s, found.judged)
    std = np.sqrt(np.einsum("sii->si", covariance))
    trusted = verdicts.trusted
    for array in (x, std, covariance, sigma, rmse, misfit):
        array[~trusted] = np.nan
    values, stds = unpacked(model, x), unpacked(model, std)
    return Batch(
        model, entry_names(model), values, stds, covariance, sigma, rmse, trusted, verdicts, misfit
    )


@dataclass
class _Fitted:
    x: Array
    judged: Judged
    chance: Array


def _fitted(squares: Squares, sensors: Sensors, fleet: Population) -> _Fitted:
    """Gauss-Newton from the fleet's mean, every sensor on its own."""
    width, n = sensors.samples.shape[2], len(fleet.mean)
    mean, inside = fleet.mean[:, None], np.linalg.inv(fleet.covariance)[..., None]
    x, left = np.repeat(mean, width, axis=1), np.full(width, np.inf)
    for _ in range(STEPS):
        normals = squares.normals(x, sensors)
        matrix = normals.matrix / fleet.sigma**2 + inside
        away = x - mean
        slope = normals.rows[-1] / fleet.sigma**2 + np.einsum("ijk,js->is", inside, away)
        factor = cholesky(matrix)
        half = forward(factor, slope)
        left = np.einsum("is,is->s", half, half)
        x = np.where(left > 1e-20, x - backward(factor, half), x)
        if not (left > STEP**2 * 1e-4).any():
            break
    count = residual_counts(squares, sensors)
    squared = 2 * squares.cost(x, sensors)
    away = x - mean
    total = squared / fleet.sigma**2 + np.einsum("is,ijk,js->s", away, inside, away)
    chance = gammaincc(count / 2, total / 2)
    found = Judged.of((n, width), np.sqrt(squared / count), np.sqrt(squared / count))
    found.equations[:], found.step[:] = count, np.sqrt(left)
    found.low[:], found.high[:], found.smallest[:], found.weakest[:] = 1.0, 1.0, 1.0, 0.0
    bad = ~np.isfinite(sensors.samples).all(axis=0)
    found.where[:] = np.argmax(bad, axis=0)
    found.add(Code.READING, np.asarray(bad.any(axis=0)))
    found.add(Code.NOT_FINITE, ~np.isfinite(squared))
    found.add(Code.NOT_SETTLED, ~(left <= STEP**2))
    found.add(Code.LOUD, ~(chance >= TOO_LARGE))
    found.covariance[:] = inverse(factor)
    found.std[:] = np.sqrt(np.einsum("iis->is", found.covariance))
    return _Fitted(x, found, np.asarray(chance))
