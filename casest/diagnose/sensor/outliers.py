"""Outliers: an effect on the noise that may look like what is missing, and the other way round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.declaration.effect import TAILS
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.cross_validation import Folds
from casest.diagnose.evidence.linear import robust_sd
from casest.diagnose.found import Found
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.left import predictions
from casest.diagnose.noise.tails import outliers_p_value
from casest.diagnose.protocol import State
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.sensor import NOT_FINITE, Sensor

#: Why outliers that somebody asked for are none.
AS_NOISE = (
    "no more are far out than noise with heavy tails has, or they come together, as events do"
)


def spoilt(residuals: Sequence[Array]) -> bool:
    """Are most of the squares those of single samples, each far out between two that are not?"""
    total = alone = 0.0
    for r in residuals:
        far = np.abs(r - np.median(r, axis=0)) > LEVELS.clip * robust_sd(r)
        beside = np.zeros_like(far)
        beside[1:] |= far[:-1]
        beside[:-1] |= far[1:]
        total += float(np.sum(r**2))
        alone += float(np.sum(r[far & ~beside] ** 2))
    return alone > 0.5 * total


def without_outliers(
    sensor: Sensor, state: State[Fit], folds: Folds
) -> tuple[State[Fit], Found | None]:
    """With the effect `outliers` where there are some: they would pull what follows."""
    fit, effect = state.fit, next((e for e in sensor.catalogue if e.seen_in == TAILS), None)
    if effect is None or any(a.label == effect.name for a in fit.model.effects):
        return state, None
    problem, point = problem_of(fit, sensor.runs)
    levels = predictions(problem, point)
    p_value = outliers_p_value(fit.residuals, folds.batches, levels)
    candidate = Candidate(effect)
    if p_value is None:
        asked = sensor.asked(candidate)
        return state.refusing(candidate, AS_NOISE) if asked else state, None
    better = sensor.fitted(fit.model.with_effect(effect), fit.values)
    if better is None:
        return state.refusing(candidate, NOT_FINITE), None
    certificate = sensor.proved(better).certificate
    if not certificate.trusted:
        return state.refusing(candidate, f"its fit is refused: {certificate.reasons[0]}"), None
    return replace(state, fit=better), Found(candidate, p_value, 0.0)
