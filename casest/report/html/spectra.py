"""Spectrum and autocorrelation of residuals, with the band in which white noise lies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array

#: Lags of the autocorrelation, and the longest segment of a spectrum, in samples.
LAGS, LONGEST = 60, 2048
#: Steps of time that differ by more than this share from the usual one, and how many may.
UNEVEN, OFTEN = 0.25, 0.02
#: Correlation of the periodograms of neighbouring segments: Hann's window, half overlapping.
OVERLAP = 1 / 36


@dataclass(frozen=True)
class Spectrum:
    """One-sided power density of each axis (F, m) over frequency (F,), and degrees of freedom."""

    frequency: Array
    power: Array
    freedom: float


def step_of(runs: Sequence[Run]) -> float | None:
    """The even time step of all runs in s; None where there is none."""
    steps = []
    for run in runs:
        if run.time is None:
            return None
        inside = np.diff(run.time)[np.diff(run.block) == 0]
        if not inside.size or not np.median(inside) > 0:
            return None
        usual = float(np.median(inside))
        if np.mean(np.abs(inside - usual) > UNEVEN * usual) > OFTEN:
            return None
        steps.append(float(np.mean(inside[np.abs(inside - usual) <= UNEVEN * usual])))
    return steps[0] if max(steps) < 1.01 * min(steps) else None


def spectrum(runs: Sequence[Run], residuals: Sequence[Array], step: float) -> Spectrum | None:
    """Welch's estimate (1967) over the gap-free stretches; None where they are too short."""
    pieces = list(_stretches(runs, residuals))
    longest = max(len(p) for p in pieces)
    length = min(LONGEST, 1 << int(np.log2(max(longest // 4, 1))))
    if length < 16:
        return None
    window = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
    total, count = np.zeros((length // 2 + 1, residuals[0].shape[1])), 0
    for piece in pieces:
        for start in range(0, len(piece) - length + 1, length // 2):
            part = piece[start : start + length]
            part = (part - part.mean(axis=0)) * window[:, None]
            total += np.abs(np.fft.rfft(part, axis=0)) ** 2
            count += 1
    power = total * 2 * step / (count * float(np.sum(window**2)))
    freedom = 2 * count / (1 + 2 * OVERLAP * (count - 1) / count)
    frequency = np.arange(length // 2 + 1) / (length * step)
    return Spectrum(frequency[1:-1], power[1:-1], freedom)


def white_band(freedom: float) -> tuple[float, float]:
    """Where a spectral estimate lies, over the true value, in 95 of 100 cases: χ²."""
    from scipy.special import chdtri

    return float(chdtri(freedom, 0.975)) / freedom, float(chdtri(freedom, 0.025)) / freedom


def autocorrelation(runs: Sequence[Run], residuals: Sequence[Array]) -> tuple[Array, int]:
    """Autocorrelation (L, m) from lag 1 on, over gap-free stretches, and the samples behind it."""
    pieces = list(_stretches(runs, residuals))
    count = sum(map(len, pieces))
    lags = int(min(LAGS, max(len(p) for p in pieces) // 4))
    mean = sum(p.sum(axis=0) for p in pieces) / count
    variance = sum(((p - mean) ** 2).sum(axis=0) for p in pieces)
    found = np.zeros((lags, residuals[0].shape[1]))
    for p in (p - mean for p in pieces):
        for lag in range(1, min(lags, len(p) - 1) + 1):
            found[lag - 1] += (p[lag:] * p[:-lag]).sum(axis=0)
    return found / np.maximum(variance, 1e-300), count


def _stretches(runs: Sequence[Run], residuals: Sequence[Array]) -> Iterator[Array]:
    for run, r in zip(runs, residuals, strict=True):
        cuts = np.flatnonzero(np.diff(run.block)) + 1
        pieces = [r] if run.spread else np.split(r, cuts)
        yield from (np.nan_to_num(p) for p in pieces if len(p))
