"""What is believed and what is not: the certificate judges the point, not the way to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casest import (
    DataError,
    NotTrusted,
    Residual,
    Run,
    UsageError,
    calibrate,
    exp,
    inf,
    log,
    model,
    param,
    rotation_matrix,
    signal,
    sin,
    unit_vector,
    vertcat,
)
from casest.estimate import attempt
from casest.identify import identify
from casest.solve.certificate import certify
from casest.solve.outcome import Outcome
from casest.solve.trust_region import trust_region
from casest.stack import Problem


def as_run(**signals):
    columns = {n: np.asarray(s, float).reshape(len(s), -1) for n, s in signals.items()}
    return Run.raw("r", columns, units={}, file="r.csv")


def judged(problem, values, others=()):
    """Certificate of a point that some solver is supposed to have returned."""
    point = problem.point(values)
    factor = problem.factor(point)
    best = Outcome("claimed", point, problem.cost(point), 1, 1, True, "Solve_Succeeded", 0.0)
    dof = max(problem.residual_count - problem.unknowns, 1)
    sigma = float(np.sqrt(2 * best.cost / dof))
    return certify(problem, best, others, identify(problem, point), factor, sigma)


@model
def well(x=signal(), y=signal(2), *, a=param(start=1.0)):
    """Residual (a² − 1, 0.1): minima at ±1, a maximum of the cost at 0."""
    return Residual(measured=y, predicted=vertcat(a**2, 0 * a))


@model
def saddle(x=signal(), y=signal(2), *, a=param(start=1.0), b=param(start=0.0)):
    """Residual (b + 0.1ab, a² − 1): at a = 0, b = 0 the cost falls along a and rises along b."""
    return Residual(measured=y, predicted=vertcat(b + 0.1 * a * b, a**2 + 0.5 * a))


@model
def peak(
    x=signal("1"),
    y=signal("1"),
    *,
    level=param(start=0.0),
    height=param(start=5.0),
    place=param("1", start=7.0),
    width=param("1", start=1.0, bounds=(0.1, 10.0)),
):
    return Residual(measured=y, predicted=level + height * exp(-(((x - place) / width) ** 2)))


def test_one_of_several_valleys_that_leaves_a_course_is_refused_until_a_start_says_which():
    """Two peaks where the model has one: either is a minimum."""
    x = np.arange(200) * 0.1
    y = 10 * np.exp(-((x - 5) ** 2)) + 8 * np.exp(-((x - 13) ** 2))
    y = y + 0.1 * np.random.default_rng(0).standard_normal(200)
    run = Run.raw("peak", {"x": x[:, None], "y": y[:, None]}, units={})
    refused = attempt(peak, [run]).certificate
    assert not refused.trusted
    assert "there may be a better one, or the model lacks something" in refused.reasons[0]
    stated = attempt(peak, [run], start={"place": 5.2})
    assert stated.certificate.trusted
    assert abs(float(stated.values["place"]) - 5) < 0.2
