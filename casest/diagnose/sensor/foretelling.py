"""What fits foretell of parts that they did not see, with what was added and without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.cross_validation import Folds, cross_fitted
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol import State
from casest.diagnose.protocol.refits import NOT_HELD_OUT
from casest.diagnose.sensor.final import certified, left_in
from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.sensor import Sensor
from casest.estimate.estimate import Estimate
from casest.leastsquares.weights import robust_scale


def foretelling(
    sensor: Sensor,
    declared: Fit,
    state: State[Fit],
    before: Estimate,
    after: Estimate,
    folds: Folds,
) -> tuple[State[Fit], Estimate, list[tuple[Array, ...]]]:
    """Without causes that came last, as long as held-out data are foretold no better with them.

    By fits that did not see their part: what columns or one refit promised may be another thing.
    What the user says is there stays. The last: held-out residuals before and after.
    """
    hidden = [held_out(sensor, fit, folds) for fit in (declared, state.fit)]
    while state.kept and not any(sensor.asked(k.what) for k in state.kept):
        less = sensor.without(state.fit, state.kept[-1].what)
        if less is None or _better(*on_the_same_samples(*hidden)):
            break
        last = state.kept[-1]
        state = replace(left_in(state, less), open=(last.evidence, *state.open))
        state = state.refusing(last.what, NOT_HELD_OUT)
        state, after = certified(sensor, state, before)
        hidden[1] = held_out(sensor, state.fit, folds)
    return state, after, hidden


def _better(before: Sequence[Array], after: Sequence[Array]) -> bool:
    """Are residuals smaller, counted as less where both are far out?"""
    there = [np.isfinite(b) for b in before]
    b, a = (
        np.abs(np.concatenate([r[k] for r, k in zip(x, there, strict=True)]))
        for x in (before, after)
    )
    nearer = np.minimum(a, b)
    beyond = nearer - np.minimum(nearer, LEVELS.far * robust_scale([b]))
    return bool(np.sum((a - beyond) ** 2) < np.sum((b - beyond) ** 2))


def held_out(sensor: Sensor, fit: Fit, folds: Folds) -> tuple[Array, ...]:
    """Residuals (N, m) of each run, each from a fit that did not see its part."""
    return cross_fitted(fit.model, sensor.runs, fit.values, folds)


def on_the_same_samples(
    before: tuple[Array, ...], after: tuple[Array, ...]
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """NaN in both where one of them foretells nothing."""
    there = [np.isfinite(b + a) for b, a in zip(before, after, strict=True)]
    one, other = (
        tuple(np.where(k, r, np.nan) for k, r in zip(there, several, strict=True))
        for several in (before, after)
    )
    return one, other
