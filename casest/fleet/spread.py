"""Effects of which each sensor has a size of its own: too small to see in one, a spread over many.

With Q the orthonormal columns that an effect adds to the declared ones, and r the residual of a
sensor, ‖Qᵀr‖² is Σaσ² on average where the effect is absent, with a the squares of Q's rows and σ²
the variances of the noise, row by row. Those are estimated without bias, whatever they are, from
what the extended fit leaves: ê = Mr has E[ê²] = (M∘M)σ² (Hartley, Rao & Kiefer, JASA 64 (1969)
841). So the excess ‖Qᵀr‖² − Σaσ² is zero on average over sensors, whatever the distribution of
their noise and however it differs from reading to reading; an effect with a spread makes it
positive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.special import ndtr

from casest.declaration.shapes import Array
from casest.engine.threads import one_thread
from casest.fleet.common import Trial
from casest.fleet.sums import Squares, side_by_side, widest
from casest.leastsquares.per_sample import residual_and_jacobian

#: Residuals of a sensor beyond its unknowns from which on its own noise is told; and most of them:
#: a system of so many equations is solved for each sensor.
SPARE, MOST = 3, 400
#: Numbers of such systems that are held at once.
HELD = 4_000_000
#: Condition of M∘M up to which variances of single residuals are told, and of the columns.
TOLD, SURVIVES = 1e8, 1e-6


@dataclass(frozen=True)
class Excess:
    """Of S sensors: excess (S,); estimates of the squares of the effect's q unknowns, and what they
    weigh (S, q); mean squares of the residual before and after, over degrees of freedom (S,). NaN
    where a sensor says nothing."""

    over: Array
    square: Array
    weight: Array
    before: Array
    after: Array

    @classmethod
    def joined(cls, parts: Sequence[Excess]) -> Excess:
        """Of all of them."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    @property
    def told(self) -> int:
        """How many sensors say something."""
        return int(np.isfinite(self.over).sum())

    def chance(self) -> tuple[float, float]:
        """Mean excess in its standard errors, and how probable one as large is without a spread."""
        t = in_errors(self.over)
        return t, float(ndtr(-t))

    @property
    def size(self) -> tuple[Array, Array]:
        """Root mean square of each of the effect's unknowns over sensors (q,), and its error.

        Zero where the estimate is negative, as that of nothing is in one fleet of two.
        """
        own = self.weight / np.nansum(self.weight, axis=0)
        square = np.nansum(own * self.square, axis=0)
        error = np.sqrt(np.nansum((own * (self.square - square)) ** 2, axis=0))
        size = np.sqrt(np.maximum(square, 0))
        return size, error / np.maximum(2 * size, np.sqrt(error))

    @property
    def sigma(self) -> tuple[float, float]:
        """Of the fleet's residuals, before and after."""
        return float(np.sqrt(np.nanmean(self.before))), float(np.sqrt(np.nanmean(self.after)))


def in_errors(values: Array) -> float:
    """Mean in its own standard errors; zero of nothing."""
    values = values[np.isfinite(values)]
    if len(values) < 2 or not np.ptp(values) > 0:
        return 0.0
    return float(np.mean(values) / np.std(values, ddof=1) * np.sqrt(len(values)))


def excess(trial: Trial, values: Array, signals: Sequence[Array]) -> Excess:
    """Of sensors with fitted unknowns (S, n) of the declared model; signals (S, N, size)."""
    squares = Squares(residual_and_jacobian(trial.extended))
    size, n, q = len(values), values.shape[1], len(trial.null)
    found = Excess(*(np.full(shape, np.nan) for shape in (size, (size, q), (size, q), size, size)))
    count = signals[0].shape[1] * squares.residual_count
    if not n + q + SPARE <= count <= MOST:
        return found
    width = min(widest(signals[0].shape[1]), max(1, HELD // count**2))
    with np.errstate(all="ignore"), one_thread():
        for first in range(0, size, width):
            s = slice(first, min(first + width, size))
            sensors = side_by_side([v[s] for v in signals])
            places = np.minimum(np.arange(sensors.samples.shape[2]), s.stop - first - 1)
            nothing = np.repeat(trial.null[:, None], len(places), axis=1)
            rows = squares.each(np.concatenate([values[s][places].T, nothing]), sensors)
            own = _of_rows(rows[: s.stop - first].reshape(s.stop - first, -1, n + q + 1), n)
            for f in fields(Excess):
                getattr(found, f.name)[s] = getattr(own, f.name)
    return found


def _of_rows(rows: Array, n: int) -> Excess:
    """The same from [J r] (S, rows, n + q + 1) of each sensor."""
    count, q = rows.shape[1], rows.shape[2] - n - 1
    scale = np.linalg.norm(rows[:, :, :-1], axis=1)
    J, r = rows[:, :, :-1] / np.where(scale > 0, scale, np.nan)[:, None, :], rows[:, :, -1]
    told = np.asarray(np.isfinite(J).all(axis=(1, 2)) & np.isfinite(r).all(axis=1))
    Q, R = np.linalg.qr(np.where(told[:, None, None], J, np.eye(*J.shape[1:])))
    M = np.eye(count) - Q @ Q.transpose(0, 2, 1)
    system = M**2
    values = np.linalg.eigvalsh(system)
    told &= (values[:, 0] * TOLD > values[:, -1]) & (
        np.abs(np.einsum("skk->sk", R)).min(axis=1) > SURVIVES
    )
    system[~told], R[~told] = np.eye(count), np.eye(n + q)
    left, own = np.einsum("sij,sj->si", M, r), Q[:, :, n:]
    variance = np.linalg.solve(system, (left**2)[:, :, None])[:, :, 0]
    pull = np.einsum("snk,sn->sk", own, r)
    gain, rest = np.sum(pull**2, axis=1), np.sum(left**2, axis=1)
    # The effect's unknowns are T·pull; what each residual's noise makes of them.
    T = np.linalg.inv(R[:, n:, n:]) / scale[:, n:, None]
    each = np.einsum("skl,snl->skn", T, own) ** 2
    found = Excess(
        gain - np.einsum("snk,sn->s", own**2, variance),
        np.einsum("skl,sl->sk", T, pull) ** 2 - np.einsum("skn,sn->sk", each, variance),
        # Not by the noise that is found: where that is small by chance, what it is taken from is
        # not.
        np.sum(each, axis=2) ** -2.0,
        (gain + rest) / (count - n),
        rest / (count - n - q),
    )
    for f in fields(Excess):
        getattr(found, f.name)[~told] = np.nan
    return found
