"""Does the residual of a calibration speak against its model? Asked without any effect in mind."""

from __future__ import annotations

import numpy as np

from casest.diagnose.misfit.lack_of_fit import Finding, State, findings, predictions, state_of
from casest.diagnose.noise.noise_model import noise_model
from casest.diagnose.noise.slow_course import LEAST, slow_course
from casest.diagnose.selection.cross_validation import folded
from casest.effects.placing import prepared
from casest.errors import DataError
from casest.estimate.calibrate import Estimate
from casest.leastsquares.problem import Problem

#: Longer records are not asked: the tests look at all residuals at once.
LONGEST = 200_000
#: Chance to call a slow course what is none.
COURSES = 0.001
#: Residual over a step of the reading below which rounding alone, 1/√12 = 0.29, may be all of it.
ROUNDED = 0.45


def doubts(estimate: Estimate) -> list[Finding] | None:
    """What of the residual is no noise, by the tests with which `close` begins.

    A residual that wanders counts too: where a temperature rises all the time, it looks like that.
    So does one with a slow course that depends on nothing recorded: it is no noise, whatever it is.
    They call a misfit where there is none in at most one of a hundred records. None where nothing
    is asked: a refused estimate, a record too short, or of more than LONGEST samples.
    """
    runs = estimate.problem.runs
    if not estimate.certificate.trusted or sum(map(len, runs)) > LONGEST:
        return None
    runs = prepared(estimate.model, runs)
    try:
        batches = folded(runs, estimate.correlated_over).batches
    except DataError:  # too short for any test
        return None
    problem, over = Problem(estimate.model, runs), estimate.correlated_over
    with np.errstate(all="ignore"):
        point = problem.point(estimate.values)
        state = state_of(problem, point, batches)
        noise = noise_model(
            runs,
            state.residuals,
            state.batches,
            measured=problem.model.traced.measured,
            correlated_over=over,
            levels=predictions(problem, point),
        )
        return findings(state, noise, over, wander=True) or _course(state, noise.step)


def _course(state: State, step: float) -> list[Finding]:
    """A slow course of unknown cause. What rounding to a `step` leaves of a slow input is known."""
    found = slow_course(state.problem.runs, state.clipped)
    if found is None or found.p_value >= COURSES or found.share < LEAST:
        return []
    if state.sigma < ROUNDED * step:
        return []
    where = (
        f"{100 * found.share:.0f} % of it is a slow course over about {found.samples} samples, of "
        "unknown cause"
    )
    return [Finding(where, found.p_value, state.sigma * float(np.sqrt(1 - found.share)))]
