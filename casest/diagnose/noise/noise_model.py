"""The noise as it is: size, colour, wander, tails, steps, and how it differs from place to place.

None of this is an effect, and none of it an excuse: a misfit is looked for beside all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.tails import even_scale, outlier_share, scales, tails
from casest.estimate.correlation import is_series

#: Batches of a record that its slow wander is judged by, and the fewest.
SLICES, FEWEST = 64, 24
#: Slow shapes, half a period to two and a half over the record, that a misfit might have too;
#: and the next ones, where only a wander reaches.
SLOW, MIDDLE = 4, 12


@dataclass(frozen=True)
class NoiseModel:
    """What is known of the noise, from residuals.

    sigma: robust standard deviation of each axis, residual unit. lag1: correlation of neighbours
    (None: the samples are no series), with its p-value under white noise. colour: "white", "AR(1)"
    (it decays as lag1 to the k-th) or "coloured".
    wander: random walk in residual units per root second (per root sample without time), 0 where
    none shows at `wander_p`. freedom: ν of Student's t, inf where tails are normal. outliers: share
    of samples. step: quantisation of the reading, 0 without. unequal: largest over smallest σ
    among batches, 1 where they do not differ at `unequal_p`.
    """

    sigma: tuple[float, ...]
    lag1: float | None
    colour: str
    colour_p: float
    wander: float
    wander_p: float
    freedom: float
    outliers: float
    step: float
    unequal: float
    unequal_p: float

    @property
    def content(self) -> dict[str, Any]:
        """As in `result.json`; what is not finite becomes null there."""
        freedom = float(self.freedom)
        return {
            "sigma_by_axis": list(self.sigma),
            "colour": self.colour,
            "lag1_correlation": self.lag1,
            "colour_p_value": self.colour_p,
            "wander": self.wander,
            "wander_p_value": self.wander_p,
            "tail_degrees_of_freedom": freedom if np.isfinite(freedom) else None,
            "outlier_share": self.outliers,
            "quantisation_step": self.step,
            "largest_over_smallest": self.unequal,
            "unequal_p_value": self.unequal_p,
        }


def noise_model(
    runs: Sequence[Run],
    residuals: Sequence[Array],
    batches: Sequence[NDArray[np.int_]],
    *,
    measured: str | None = None,
    correlated_over: float = 1.0,
    levels: Sequence[Array] | None = None,
) -> NoiseModel:
    """The noise of residuals (N, m) per run; `measured` names the signal that was read."""
    sigma = scales(residuals)
    clipped = [np.clip(r / sigma, -LEVELS.clip, LEVELS.clip) for r in residuals]
    unequal_p = equal_noise(clipped, batches)
    unequal = unequal_p < LEVELS.misfit
    even = even_scale(residuals, batches, unequal)
    lag1, colour_p = lag_one(runs, clipped)
    wander, wander_p = _wander(runs, clipped, sigma)
    found = tails(np.concatenate([z.ravel() for z in even]))
    outliers = outlier_share(residuals, batches, levels)
    return NoiseModel(
        sigma=tuple(float(s) for s in sigma),
        lag1=lag1,
        colour=_colour(lag1, colour_p, correlated_over),
        colour_p=colour_p,
        wander=wander if wander_p < LEVELS.misfit else 0.0,
        wander_p=wander_p,
        freedom=np.inf if outliers else found.freedom,
        outliers=outliers,
        step=step_of(runs, measured),
        unequal=_ratio(clipped, batches) if unequal else 1.0,
        unequal_p=unequal_p,
    )


# -- colour ------------------------------------------------------------------------------------


def lag_one(runs: Sequence[Run], residuals: Sequence[Array]) -> tuple[float | None, float]:
    """Correlation of neighbours within blocks, and the chance of one as large in white noise.

    Normed by the products themselves, so that unequal noise and tails do not matter.
    """
    top, squares, all_squares, pairs, count = 0.0, 0.0, 0.0, 0, 0
    for run, r in zip(runs, residuals, strict=True):
        if not is_series(run):
            continue
        products = (r[1:] * r[:-1])[run.block[1:] == run.block[:-1] if _raw(run) else slice(None)]
        top, squares = top + float(products.sum()), squares + float(np.sum(products**2))
        all_squares, count = all_squares + float(np.sum(r**2)), count + r.size
        pairs += products.size
    if not pairs or not squares > 0:
        return None, 1.0
    return top / pairs / (all_squares / count), _two_sided(top / np.sqrt(squares))


def _raw(run: Run) -> bool:
    """Single readings: blocks are stretches. Rest intervals are a block each."""
    return not run.spread


def _two_sided(z: float) -> float:
    from scipy.special import ndtr

    return float(2 * ndtr(-abs(z)))


def _colour(lag1: float | None, p: float, correlated_over: float) -> str:
    if lag1 is None or p >= LEVELS.misfit:
        return "white"
    expected = (1 + lag1) / (1 - lag1) if abs(lag1) < 1 else np.inf
    return "AR(1)" if 2 / 3 < correlated_over / max(expected, 1.0) < 1.5 else "coloured"


# -- wander ------------------------------------------------------------------------------------


def _wander(runs: Sequence[Run], clipped: Sequence[Array], sigma: Array) -> tuple[float, float]:
    """Random walk of the runs together and the chance of that much slow variation without one."""
    found = [(run, slow_power(run, r)) for run, r in zip(runs, clipped, strict=True)]
    known = [(run, power) for run, power in found if power is not None]
    if not known:
        return 0.0, 1.0
    walks = [_walk(power, run) for run, power in known]
    size = float(np.sqrt(np.mean(walks) * np.mean(sigma**2)))
    return size, wander_p_value([power for _, power in known])


def slow_power(run: Run, r: Array) -> Array | None:
    """Power (slices, m) of batch means over cosines of 0, ½, 1, … periods; None if too short.

    What is slow enough for a misfit is taken out first: lines and parabolas reach far.
    """
    means = slice_means(run, r)
    if means is None:
        return None
    smooth = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, len(means)), SLOW))[0]
    return power(means - smooth @ (smooth.T @ means))


def slice_means(run: Run, r: Array) -> Array | None:
    """Means of consecutive slices of a run, (slices, m); None if too short."""
    slices = min(SLICES, len(r) if run.spread else len(r) // 8)
    if not is_series(run) or slices < FEWEST:
        return None
    edges = np.arange(slices) * len(r) // slices
    sizes = np.diff(np.append(edges, len(r)))
    return np.asarray(np.add.reduceat(r, edges, axis=0) / sizes[:, None])


def power(means: Array) -> Array:
    """Squares (n, m) of the components along cosines of 0, ½, 1, … periods."""
    n = len(means)
    cosines = np.cos(np.pi * np.outer(np.arange(n), np.arange(n) + 0.5) / n)
    return np.asarray((np.sqrt(2 / n) * cosines @ means) ** 2)


def wander_p_value(powers: Sequence[Array]) -> float:
    """Is there more power at the slow end than at the fast one? F test."""
    from scipy.special import fdtrc

    slow = np.concatenate([p[SLOW + 1 : MIDDLE + 1].ravel() for p in powers])
    fast = np.concatenate([p[len(p) // 2 :].ravel() for p in powers])
    if not fast.mean() > 0:
        return 1.0
    return float(fdtrc(len(slow), len(fast), slow.mean() / fast.mean()))


def _walk(power: Array, run: Run) -> float:
    """Variance of a random walk's step per second: its power falls as (slices/πk)²."""
    slices = len(power)
    k = np.arange(SLOW + 1, MIDDLE + 1)
    excess = power[k].mean(axis=1) - power[slices // 2 :].mean()
    per_slice = max(float(np.mean(excess * (np.pi * k / slices) ** 2)), 0.0)
    length = len(run) / slices
    if run.time is not None and len(run) > 1:
        length = float(np.ptp(run.time)) / slices
    return per_slice / max(length, 1e-300)


# -- place to place ----------------------------------------------------------------------------


def equal_noise(clipped: Sequence[Array], batches: Sequence[NDArray[np.int_]]) -> float:
    """p-value of noise being the same in all batches (Brown & Forsythe 1974).

    Analysis of variance of |r − median of its batch|, neighbours' correlation taken off.
    """
    from scipy.special import fdtrc

    sizes, means, within, chain, top = [], [], 0.0, 0.0, 0.0
    for away in _away(clipped, batches):
        centred = away - away.mean(axis=0)
        sizes.append(away.size)
        means.append(float(away.mean()))
        within += float(np.sum((away - away.mean()) ** 2))
        top += float(np.sum(centred[1:] * centred[:-1]))
        chain += float(np.sum(centred**2)) * (1 - 1 / len(away))
    count, groups = sum(sizes), len(sizes)
    if groups < 2 or count <= groups or not within > 0:
        return 1.0
    n, mean = np.array(sizes, float), np.array(means)
    between = float(n @ (mean - n @ mean / count) ** 2) / (groups - 1)
    rho = min(max(top / max(chain, 1e-300), 0.0), 0.95)
    inflation = (1 + rho) / (1 - rho)
    F = between / (within / (count - groups)) / inflation
    return float(fdtrc(groups - 1, (count - groups) / inflation, F))


def _away(clipped: Sequence[Array], batches: Sequence[NDArray[np.int_]]) -> list[Array]:
    """|r − median| of every batch of at least five samples."""
    found = []
    for r, first in zip(clipped, batches, strict=True):
        for start, end in zip(first, np.append(first[1:], len(r)), strict=True):
            if end - start >= 5:
                own = r[start:end]
                found.append(np.abs(own - np.median(own, axis=0)))
    return found


def _ratio(clipped: Sequence[Array], batches: Sequence[NDArray[np.int_]]) -> float:
    spreads = [float(np.median(away)) for away in _away(clipped, batches)]
    return max(spreads) / max(min(spreads), 1e-300)


def step_of(runs: Sequence[Run], measured: str | None) -> float:
    """Step of a quantised reading, 0 where nearly every reading is another value."""
    from casest.data.stillness import resolution

    steps = []
    for run in runs:
        x = run.signals.get(measured or "")
        if x is None or run.spread or len(run) < 20:
            continue
        for k in range(x.shape[1]):
            if len(np.unique(x[:, k])) <= len(x) / 2:
                steps.append(resolution(x[:, k]))
    return float(np.median(steps)) if steps else 0.0
