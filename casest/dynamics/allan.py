"""Allan deviation of a record at rest: what a sensor's noise is made of.

Overlapping Allan deviation by allantools (an extra: `pip install 'casest[allan]'`), and the three
noises of IEEE Std 952 fitted to it: σ²(τ) = N²/τ + B²·2·ln2/π + K²·τ/3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import DataError, UsageError

#: Averages of one length that a deviation must rest on.
AVERAGES = 9


@dataclass(frozen=True)
class Allan:
    """Per axis of a signal in unit u: taus (K,) in s and deviations (K, size) in u.

    `white` N (size,) in u·√s (its square is an intensity, u²·s), `instability` B in u, `walk` K in
    u/√s (its square is the intensity of a drifting bias, u²/s). Zero: not seen in this record.
    """

    taus: Array
    deviations: Array
    white: Array
    instability: Array
    walk: Array


def allan(readings: Array, rate: float) -> Allan:
    """Allan deviation of readings (N, size) at rest, `rate` per second, and the noises in it.

    Raises UsageError where allantools is not installed, DataError where the record is too short or
    has readings missing.
    """
    try:
        import allantools
    except ImportError:
        raise UsageError(
            "an Allan deviation needs allantools: pip install 'casest[allan]'"
        ) from None
    readings = np.asarray(readings, float)
    if not np.isfinite(readings).all():
        raise DataError(
            "an Allan deviation needs every reading: cut the record where one is missing"
        )
    longest = len(readings) / rate / AVERAGES
    taus = np.array([2.0**k / rate for k in range(64) if 2.0**k / rate <= longest])
    if len(taus) < 4:
        raise DataError(
            f"{len(readings)} readings at {rate:g} Hz are too few for an Allan deviation: record "
            f"{8 * AVERAGES} of them at rest at least, better an hour"
        )
    found = [_one(allantools, column, rate, taus) for column in readings.T]
    fits = [_noises(taus, deviation, len(readings) / rate) for deviation in found]
    return Allan(taus, np.stack(found, axis=1), *np.array(fits).T)


def _one(library: Any, column: Array, rate: float, taus: Array) -> Array:
    _, deviation, _, _ = library.oadev(column - column.mean(), rate, data_type="freq", taus=taus)
    return np.asarray(deviation, float)


def _noises(taus: Array, deviation: Array, duration: float) -> Array:
    """N, B and K, none of them negative, each deviation weighted by how sure it is."""
    from scipy.optimize import nnls

    variance = np.maximum(deviation**2, 1e-300)
    weight = np.sqrt(duration / taus) / variance
    basis = np.stack([1 / taus, np.full_like(taus, 2 * np.log(2) / np.pi), taus / 3], axis=1)
    scale = np.linalg.norm(basis * weight[:, None], axis=0)
    squares, _ = nnls(basis * weight[:, None] / scale, variance * weight)
    return np.asarray(np.sqrt(squares / scale))
