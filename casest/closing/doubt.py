"""Does the residual of a calibration speak against its model? Asked without any effect in mind."""

from __future__ import annotations

from typing import Any

import numpy as np

from casest.closing.adequacy import Finding, findings, predictions, state_of
from casest.closing.candidates import prepared
from casest.closing.crossfit import folded
from casest.closing.noise_model import noise_model
from casest.errors import DataError
from casest.estimate import Estimate
from casest.result import plain
from casest.stack import Problem

#: Longer records are not asked: the tests look at all residuals at once.
LONGEST = 200_000


def doubts(estimate: Estimate) -> list[Finding] | None:
    """What of the residual is no noise, by the tests with which `close` begins.

    A residual that wanders counts too: where a temperature rises all the time, it looks like that.
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
        return findings(state, noise, over, wander=True)


def asked(estimate: Estimate) -> list[dict[str, Any]] | None:
    """The doubts for `result.json`."""
    found = doubts(estimate)
    if found is None:
        return None
    return [{"where": f.where, "p_value": plain(f.p_value)} for f in found]


def sentence(misfit: list[dict[str, Any]]) -> str:
    """What a reader must know before using the values."""
    where = "; ".join(f"{f['where']} (p = {f['p_value']:.1g})" for f in misfit)
    return (
        f"the residual is not noise: {where}. The model lacks something, which may have moved the "
        "values by many of their standard deviations, however small the residual: `casest close` "
        "looks for it"
    )
