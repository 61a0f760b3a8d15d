"""The certificate of many sensors side by side: what `estimate.certificate` asks, asked of arrays.

Every sensor goes through the questions that are cheap; those whose answers are not plainly good
go through the exact ones: curvature from second derivatives, the cost along every principal
direction, a second valley, the exact second order of the noise. What decides which sensors these
are is the sensor's own data, never its neighbours.
"""

from __future__ import annotations

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.estimate.correlation import ENOUGH
from casest.estimate.covariance import MANY_RESIDUALS
from casest.estimate.profile_likelihood import HOLD
from casest.estimate.reasons import (
    ALIKE,
    APART,
    BENT,
    CURVATURE,
    PRACTICALLY_NULL,
    SAME,
    SECOND_ORDER,
    SHAPE,
    SLOPE,
    STEP,
    TIME_SERIES,
    TOO_LARGE,
    WALKED,
    Code,
)
from casest.estimate.remarks import NOTABLE_BIAS
from casest.fleet.covariance import sandwich
from casest.fleet.derivatives import bend, dense
from casest.fleet.fit import Bounds, Fits, Flags, Places, minimise, residual_counts
from casest.fleet.linear import cholesky, dot, form, times, whole
from casest.fleet.local import Local, groups, local, rounding
from casest.fleet.on_bounds import bounded
from casest.fleet.outlying import outlying
from casest.fleet.sums import Hold, Sensors, Squares
from casest.fleet.verdicts import Judged
from casest.leastsquares.per_sample import laplacian, slope_in_sample
from casest.solve.strategy import PARABOLA

#: Steps must have shrunk to this share of the ones before, else second derivatives are computed.
SHRUNK = 0.1
#: The screen of the noise's second order looks at a few samples along one direction each: it must
#: find this many times less than what would matter.
SAFETY = 3.5


class Judge:
    """Verdicts on fits of one model."""

    def __init__(
        self, model: Model, squares: Squares, noise: float | None, misfit: bool = False
    ) -> None:
        """`noise`: σ of a sound sensor's residuals; `misfit`: is each asked for an outlying one?"""
        self.model, self.squares, self.expected, self.misfit = model, squares, noise, misfit
        positive = [p.shape.positive_diagonal for p in model.parameters for _ in p.entry_names]
        # A bound is no answer for these: the residual is open towards it.
        self.never: Flags = np.array(positive, dtype=bool) | model.implicit

    def __call__(self, sensors: Sensors, fits: Fits, bounds: Bounds) -> Judged:
        """Judge W sensors."""
        count = residual_counts(self.squares, sensors)
        here, freedom = local(fits, count)
        found = Judged.of(here.fits.x.shape, here.sigma, np.sqrt(2 * fits.cost / count))
        found.equations[:] = count
        found.step[:] = np.sqrt(fits.left) * np.minimum(fits.shrink, 1.0) / here.noise
        self._readings(found, sensors)
        self._determined(found, here)
        residuals = self._residuals(here, sensors, self.misfit)
        if self.misfit and residuals is not None:
            found.misfit = outlying(self.squares, sensors, here, count, residuals)
        here, held = bounded(found, here, sensors, bounds, self.squares, self.never)
        found.add(Code.NO_REDUNDANCY, freedom <= 0)
        found.add(Code.NOT_FINITE, ~np.isfinite(fits.cost))
        slope = np.sqrt(fits.left / (2 * fits.cost))
        exact = np.sqrt(fits.left) <= 10 * rounding(fits, count) * np.sqrt(count)
        settled = (found.step <= STEP) | (slope <= SLOPE) | exact
        found.add(Code.NOT_SETTLED, np.logical_not(settled))
        if self.expected is not None:
            found.add(Code.LOUD, self._loud(here.sigma, freedom))
        self._independent(found, here, sensors, residuals)
        self._shape(found, here, sensors, bounds)
        shift = self._second_order(found, here, sensors, count, residuals)
        unit = here.sigma / here.scale
        np.multiply(here.inverse, unit[:, None], out=found.covariance)
        found.covariance *= unit
        for k in groups(count >= MANY_RESIDUALS * len(unit)):
            found.covariance[:, :, k] = sandwich(
                self.model, self.squares, here.some(k), sensors.some(k)
            )
        if shift is not None:
            found.covariance[:] += shift
        for i, k in zip(*np.nonzero(held), strict=True):
            found.covariance[i, :, k] = found.covariance[:, i, k] = np.nan
        found.std[:] = np.sqrt(np.einsum("iis->is", found.covariance))
        return found

    def rivalled(self, sensors: Sensors, fits: Fits, other: Fits) -> Flags:
        """Is the other fit of a sensor lower, or elsewhere and hardly told from the first?"""
        return _another(local(fits, residual_counts(self.squares, sensors))[0], other)

    def asked_of_many(self, sensors: Sensors, x: Array) -> Judged:
        """What only many are asked, of W sensors that were fitted otherwise, at x (n, W)."""
        normals, nothing = self.squares.normals(x, sensors), np.zeros(x.shape[1])
        fits = Fits(x, normals.cost, normals.matrix, nothing, nothing)
        count = residual_counts(self.squares, sensors)
        here, freedom = local(fits, count)
        found = Judged.of(x.shape, here.sigma, np.sqrt(2 * fits.cost / count))
        if self.expected is not None:
            found.add(Code.LOUD, self._loud(here.sigma, freedom))
        self._independent(found, here, sensors, self._residuals(here, sensors))
        return found

    # -- questions to every sensor -----------------------------------------------------------------

    def _residuals(self, here: Local, sensors: Sensors, asked: bool = False) -> Array | None:
        """Every residual (m, N, W) where it is `asked` for or records are long, else None."""
        if not asked and sensors.samples.shape[1] < ENOUGH:
            return None
        return self.squares.residuals(here.fits.x, sensors)

    def _readings(self, found: Judged, sensors: Sensors) -> None:
        total = np.add.reduce(np.add.reduce(sensors.samples, axis=0), axis=0)
        if np.isfinite(total).all():
            return
        bad = ~np.isfinite(sensors.samples).all(axis=0)
        found.where[:] = np.argmax(bad, axis=0)
        found.add(Code.READING, np.asarray(bad.any(axis=0)))

    def _determined(self, found: Judged, here: Local) -> None:
        """Rank of the scaled Jacobian, and its weakest direction, of unit length, (n, W)."""
        worst = np.argmax(np.einsum("iis->is", here.inverse), axis=0)
        direction = here.inverse[:, worst, np.arange(len(worst))]
        for _ in range(3):
            direction = direction / np.sqrt(dot(direction, direction))
            direction = times(here.inverse, direction)
        largest = np.sqrt(dot(direction, direction))
        found.weakest[:] = direction / largest
        found.smallest[:] = 1 / np.sqrt(largest)
        # The normal equations square the condition: what is close is looked at on its own.
        close = ~(found.smallest > 10 * PRACTICALLY_NULL)
        diagonal = np.einsum("iis->is", here.fits.matrix)
        usable = np.isfinite(diagonal).all(axis=0)  # the other entries are no larger
        k = np.flatnonzero(close & usable)
        if k.size:
            part = whole(here.fits.matrix[:, :, k] / (here.scale * here.scale[:, None])[:, :, k])
            values, vectors = np.linalg.eigh(part.transpose(2, 0, 1))
            found.weakest[:, k] = vectors[:, :, 0].T
            found.smallest[k] = np.sqrt(np.maximum(values[:, 0], 0.0) / values[:, -1])
        # Columns of no length are null whatever the rest is.
        nil = ~(diagonal > 0)
        for i in np.flatnonzero((nil & usable).any(axis=1)):
            found.weakest[:, nil[i] & usable] = np.eye(len(nil))[:, [i]]
        null = ~(found.smallest >= PRACTICALLY_NULL) | nil.any(axis=0)
        found.add(Code.NOT_DETERMINED, np.asarray(usable & null))

    def _loud(self, sigma: Array, freedom: Array) -> Flags:
        from scipy.stats import chi2  # imported late: SciPy's statistics load slowly

        counts, which = np.unique(np.maximum(freedom, 1), return_inverse=True)
        limit = np.sqrt(chi2.isf(TOO_LARGE, counts) / counts)[which] * self.expected
        return np.asarray(sigma > limit)

    def _independent(
        self, found: Judged, here: Local, sensors: Sensors, residuals: Array | None
    ) -> None:
        """Neighbours alike: a time series, whose samples say less than their number."""
        if residuals is None or residuals.shape[1] < ENOUGH:
            return
        along = np.einsum("mns,mns->s", residuals[:, 1:], residuals[:, :-1])
        share = along / (2 * here.fits.cost)
        exact = here.sigma < 10 * rounding(here.fits, np.ones(len(along)))
        count = residual_counts(self.squares, sensors)
        alike = (share * np.sqrt(count) > TIME_SERIES) & (count >= ENOUGH * len(residuals))
        found.add(Code.CORRELATED, np.logical_and(alike, np.logical_not(exact)))

    # -- is it a minimum, and do intervals describe the cost around it? --------------------------

    def _shape(self, found: Judged, here: Local, sensors: Sensors, bounds: Bounds) -> None:
        ratios = self._both_ways(here, sensors, bounds, found.weakest, 2.0)
        found.low[:], found.high[:] = ratios.min(axis=0), ratios.max(axis=0)
        plain = (here.fits.shrink <= SHRUNK) & _parabolic(ratios)
        for k in groups(~plain & ~found.refused):
            self._thorough(found, here.some(k), sensors.some(k), bounds.some(k), k)
        elongated = found.smallest <= 0.1
        for k in groups(elongated & ~found.refused):
            self._second_valley(found, here.some(k), sensors.some(k), bounds.some(k), k)

    def _both_ways(
        self, here: Local, sensors: Sensors, bounds: Bounds, direction: Array, deviations: float
    ) -> Array:
        """Rise of the cost along a scaled direction, both ways, over that of a parabola, (2, W)."""
        step = _walk(here, direction, deviations)
        parabola = 0.5 * deviations**2 * here.noise**2
        ratios = []
        for way in (step, -step):
            share = _inside(here.fits.x, way, bounds)
            rise = self._rise(here, sensors, bounds, share * way)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = rise / (parabola * share**2)
            ratios.append(np.where(share < WALKED, 1.0, ratio))
        return np.array(ratios)

    def _rise(self, here: Local, sensors: Sensors, bounds: Bounds, step: Array) -> Array:
        x = here.fits.x + step
        inside = ((x >= bounds.lower) & (x <= bounds.upper)).all(axis=0)
        rise = self.squares.cost(x, sensors) - here.fits.cost
        return np.where(inside & np.isfinite(rise), rise, np.inf)

    def _thorough(
        self, found: Judged, here: Local, sensors: Sensors, bounds: Bounds, k: Places
    ) -> None:
        """Second derivatives, and the cost along every principal direction."""
        matrix = whole(here.fits.matrix)
        bent = matrix + bend(self.model, here.fits.x, sensors)
        scale = here.scale * here.scale[:, None]
        # Positive definite, and so beyond rounding.
        factor = cholesky((bent - CURVATURE * matrix) / scale)
        found.add(Code.NO_MINIMUM, ~np.isfinite(np.einsum("iis->is", factor)).all(axis=0), k)
        finite = np.where(np.isfinite(matrix / scale), matrix / scale, 0.0)
        vectors = np.linalg.eigh(finite.transpose(2, 0, 1))[1].transpose(1, 2, 0)
        low = high = np.ones(len(k))
        for i in range(len(vectors)):
            ratios = self._both_ways(here, sensors, bounds, vectors[:, i], 2.0)
            for sign, ratio in zip((1, -1), ratios, strict=True):
                # The valley may only be bent: fit the other unknowns with this direction held.
                step = sign * _walk(here, vectors[:, i], 2.0)
                for j in groups((ratio > SHAPE[1]) & (ratio <= BENT)):
                    ratio[j] = self._profiled(
                        here.some(j), sensors.some(j), bounds.some(j), step[:, j]
                    )
            low, high = np.minimum(low, ratios.min(axis=0)), np.maximum(high, ratios.max(axis=0))
        found.low[k], found.high[k] = low, high
        found.add(Code.MISSHAPEN, ~((low >= SHAPE[0]) & (high <= SHAPE[1])), k)

    def _profiled(self, here: Local, sensors: Sensors, bounds: Bounds, step: Array) -> Array:
        """Rise of the cost over a parabola's where all but the combination along a step is fitted
        again."""
        row = times(whole(here.fits.matrix), step) / (2 * here.noise)
        target = here.fits.x + step
        tied = sensors._replace(hold=Hold(HOLD * row, target))
        start = np.clip(target, bounds.lower, bounds.upper)
        there = minimise(self.squares, tied, start, bounds, near=False)
        rise = self.squares.cost(there.x, sensors) - here.fits.cost
        return np.where(np.isfinite(rise), rise / (2 * here.noise**2), np.inf)

    def _second_valley(
        self, found: Judged, here: Local, sensors: Sensors, bounds: Bounds, k: Places
    ) -> None:
        """Far along the weakest direction another solution may lie: fit from there."""
        ratios = self._both_ways(here, sensors, bounds, found.weakest[:, k], 6.0)
        suspect = ~_parabolic(ratios)
        for sign in (1, -1):
            step = sign * _walk(here, found.weakest[:, k], 6.0)
            for j in groups(suspect):
                near = bounds.some(j)
                start = near.inside((here.fits.x + step)[:, j])
                other = minimise(self.squares, sensors.some(j), start, near, near=False)
                found.add(Code.AMBIGUOUS, _another(here.some(j), other), k[j])

    # -- the noise -------------------------------------------------------------------------------

    def _second_order(
        self, found: Judged, here: Local, sensors: Sensors, count: Array, residuals: Array | None
    ) -> Array | None:
        """What an implicit residual neglects of the noise; its shift's square (n, n, W), if any."""
        if not self.model.implicit:
            return None
        enough = np.minimum(SECOND_ORDER, NOTABLE_BIAS / np.sqrt(count)) / SAFETY
        found.second[:] = self._screened(here, sensors, residuals)
        suspect = ~(found.second <= enough) & ~found.refused
        shift = None
        for k in groups(suspect):
            second, bias = self._exact_second_order(here.some(k), sensors.some(k), count[k])
            found.second[k] = second
            found.add(Code.NOISE, ~(second <= SECOND_ORDER), k)
            some = here.some(k)
            std = some.sigma * np.sqrt(np.einsum("iis->is", some.inverse)) / some.scale
            notable = (np.abs(bias) / std).max(axis=0) > NOTABLE_BIAS
            shift = np.zeros_like(here.inverse) if shift is None else shift
            shift[:, :, k] = np.where(notable, bias * bias[:, None], 0.0)
        return shift

    def _screened(self, here: Local, sensors: Sensors, residuals: Array | None) -> Array:
        """Size of ½σ²·∂²r over σ along one direction of the readings' noise per sample, (W,).

        `residuals` (m, N, W) where they are known.
        """
        every = _every(sensors)
        some = _thinned(sensors, every)
        number = np.arange(some.samples.shape[1])
        total = np.zeros(len(here.sigma))
        if residuals is None:
            middle = self.squares.residuals(here.fits.x, some)
        else:
            middle = residuals[:, ::every]
        first = 0
        for s in self.model.signals:
            own = slice(first, first + s.size)
            first += s.size
            part = some.samples[own]
            size = np.sqrt(np.einsum("kps,kps->s", part, part) / (len(part) * len(number)))
            move = 1e-4 * np.where(size > 0, size, 1.0)
            signs = np.where((number >> np.arange(s.size)[:, None]) & 1, -1.0, 1.0)
            up, down = (
                self.squares.residuals(here.fits.x, _moved(some, own, way * signs, move))
                for way in (1, -1)
            )
            slopes = np.mean((up - down) ** 2, axis=1).max(axis=0) / 4
            bends = np.mean((up + down - 2 * middle) ** 2, axis=1).max(axis=0)
            total += np.where(slopes > 0, 0.5 * here.sigma * np.sqrt(bends) / slopes, 0.0)
        return total

    def _exact_second_order(
        self, here: Local, sensors: Sensors, count: Array
    ) -> tuple[Array, Array]:
        """The same from second derivatives (W,), and the shift of the unknowns (n, W)."""
        m, x = self.squares.residual_count, here.fits.x
        slopes = dense(slope_in_sample(self.model), x, sensors)
        bends = dense(laplacian(self.model), x, sensors)
        ends = np.cumsum([0, *(s.size for s in self.model.signals)])
        squares = np.add.reduceat((slopes**2).sum(axis=2), ends[:-1], axis=1).max(axis=0)
        slope2 = squares * m / count
        noise2 = here.sigma**2 / np.where(slope2 > 0, slope2, np.inf)
        shift = 0.5 * np.einsum("misw,iw->msw", bends.transpose(0, 1, 2, 3), noise2)
        second = np.sqrt((shift**2).sum(axis=(0, 1)) / count) / here.sigma
        pulled = self.squares.pulled(x, sensors, shift) / here.scale
        return second, -times(here.inverse, pulled) / here.scale


def _walk(here: Local, direction: Array, deviations: float) -> Array:
    """Step (n, W) along a scaled direction after which a parabola has risen by ½(kσ)²."""
    # In scaled unknowns JᵀJ is that of unit columns; its form in the direction gives the length.
    unit = direction / here.scale
    return np.asarray(unit * (deviations * here.noise / np.sqrt(form(here.fits.matrix, unit))))


def _inside(x: Array, step: Array, bounds: Bounds) -> Array:
    """Share (W,) of a step (n, W) that stays within the bounds."""
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(step > 0, bounds.upper - x, bounds.lower - x) / step
    return np.asarray(np.clip(np.where(step == 0, np.inf, room).min(axis=0), 0.0, 1.0))


def _parabolic(ratios: Array) -> Flags:
    return np.asarray(((ratios >= PARABOLA[0]) & (ratios <= PARABOLA[1])).all(axis=0))


def _another(here: Local, other: Fits) -> Flags:
    """Is the other fit a solution elsewhere that the data hardly tell from this one, or better?"""
    step = other.x - here.fits.x
    away = np.sqrt(form(here.fits.matrix, step)) / here.noise
    near = other.cost - here.fits.cost < ALIKE * here.noise**2
    lower = other.cost < here.fits.cost - 0.5 * (SAME * here.noise) ** 2
    return np.asarray((near & (away > APART)) | lower)


def _every(sensors: Sensors) -> int:
    """Which samples are enough for a screen: a third of them, at least eight."""
    return max(1, min(3, int(sensors.samples.shape[1]) // 8))


def _thinned(sensors: Sensors, every: int) -> Sensors:
    """One sample in so many."""
    mask = None if sensors.mask is None else sensors.mask[::every]
    return Sensors(np.ascontiguousarray(sensors.samples[:, ::every]), mask)


def _moved(sensors: Sensors, own: slice, signs: Array, move: Array) -> Sensors:
    samples = sensors.samples.copy()
    samples[own] += signs[:, :, None] * move
    return Sensors(samples, sensors.mask)
