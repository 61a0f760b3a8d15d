"""Figures of residuals over frequency and lag."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from casest.report.html.figures import BAND, Figures, axis, panel
from casest.report.html.page import paragraph, tag
from casest.report.html.spectra import autocorrelation, spectrum, step_of, white_band
from casest.results.residuals import Residuals


def over_frequency(residuals: Residuals, figures: Figures) -> Iterator[str]:
    """Spectrum and autocorrelation, or why there is none."""
    yield tag("h3", "Spectrum and autocorrelation")
    if not residuals.series:
        yield paragraph(
            f"The {sum(map(len, residuals.runs))} {residuals.kind}s are no record in time: "
            "neighbours and frequencies mean nothing here.",
            "soft",
        )
        return
    step = step_of(residuals.runs)
    timed = step is not None and not residuals.runs[0].spread
    yield _spectrum(residuals, step if timed and step is not None else 1.0, timed, figures)
    yield _autocorrelation(residuals, figures)


def _spectrum(residuals: Residuals, step: float, timed: bool, figures: Figures) -> str:
    found = [spectrum(residuals.runs, side.residuals, step) for side in residuals.sides]
    spectra = [f for f in found if f is not None]
    if len(spectra) < len(found):
        return paragraph("The record is too short for a spectrum.", "soft")
    unit = "Hz" if timed else "1"
    density = f"({residuals.unit})^2/Hz" if timed else f"({residuals.unit})^2"
    if residuals.unit == "1":
        density = "1/Hz" if timed else "1"
    frequency = spectra[0].frequency
    low, high = white_band(spectra[0].freedom)
    panels = []
    for (a, side, title), k in zip(
        residuals.panels(), list(range(len(spectra))) * len(residuals.axes), strict=True
    ):
        level = 2 * step * residuals.sigma[a] ** 2
        every = np.concatenate([s.power[:, a] for s in spectra])
        every = every[every > 0]
        least = min(float(every.min(initial=np.inf)), low * level)
        most = max(float(every.max(initial=0.0)), high * level)
        power = np.maximum(spectra[k].power[:, a], max(least, 1e-300))
        line = figures.series("line", side.look, frequency, exact=True, y=power)
        across = axis(
            "frequency" if timed else "cycles per sample",
            unit, float(frequency[0]), float(frequency[-1]), log=True,
        )  # fmt: skip
        widen = max(1.0, np.sqrt(10 * least / most))  # a decade at least
        least, most = least / widen, most * widen
        upright = axis(residuals.of_axis("density", a), density, least, most, log=True, room=0.04)
        white = [{"low": low * level, "high": high * level}] if np.isfinite(level) else []
        panels.append(panel(title, across, upright, [line], bands=white, height=185))
    caption = (
        "Power spectral density of the residual.",
        "Shaded: where white noise of the same size lies at 95 of 100 frequencies; so one in "
        "twenty lies outside by chance."
        + ("" if timed else " There is no even time step: frequency counts per sample."),
    )
    return figures.add("spectrum", caption, panels, two=len(residuals.sides) > 1)


def _autocorrelation(residuals: Residuals, figures: Figures) -> str:
    found = [autocorrelation(residuals.runs, side.residuals) for side in residuals.sides]
    lags, count = len(found[0][0]), found[0][1]
    half = BAND / float(np.sqrt(count))
    panels = []
    for (a, side, title), k in zip(
        residuals.panels(), list(range(len(found))) * len(residuals.axes), strict=True
    ):
        rho = found[k][0][:, a]
        every = np.concatenate([f[0][:, a] for f in found])
        low, high = min(float(every.min()), -2 * half), max(float(every.max()), 2 * half)
        stems = figures.series("stems", side.look, np.arange(1.0, lags + 1), y=rho)
        across = axis("lag, in samples", "1", 0.0, lags + 1.0)
        upright = axis(residuals.of_axis("autocorrelation", a), "1", low, high, room=0.06)
        panels.append(
            panel(title, across, upright, [stems], bands=[{"low": -half, "high": half}], height=155)
        )
    step = step_of(residuals.runs)
    spacing = "" if step is None else f" One sample is {step:.4g} s."
    caption = (
        "Autocorrelation of the residual.",
        f"Shaded: where white noise lies at 95 of 100 lags.{spacing}",
    )
    return figures.add("autocorrelation", caption, panels, two=len(residuals.sides) > 1)
