"""An estimator of the model's own (a closed form, a paper's algorithm) beside the optimum."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from casest.errors import NotTrusted
from casest.estimate import reasons as words
from casest.estimate.certificate import Certificate
from casest.estimate.estimate import Estimate
from casest.estimate.reasons import NEAR, Code
from casest.leastsquares.problem import Point


def by_estimator(optimum: Estimate, function: Callable[..., Any], name: str) -> Estimate:
    """The values of an estimator of the model's own, judged by the least-squares optimum."""
    problem, began = optimum.problem, time.perf_counter()
    known = {p.name for p in problem.model.parameters}
    try:
        values = function(problem.model, problem.runs)
        values = {name: value for name, value in values.items() if name in known}
    except NotTrusted as error:
        refused = optimum.certificate.refused(Code.MODEL, str(error))
        return replace(optimum, certificate=refused, extra={"estimator": name})
    seconds = time.perf_counter() - began
    point = problem.point(values)
    return replace(
        optimum,
        point=point,
        optimum=optimum.point,
        values=problem.values(point),
        rmse=float(np.sqrt(2 * problem.cost(point) / problem.residual_count)),
        certificate=_judged(optimum, point, values, name),
        extra={
            "estimator": name,
            "seconds": seconds,
            "least_squares_seconds": optimum.outcomes[0].seconds,
        },
    )


def _judged(optimum: Estimate, point: Point, values: Mapping[str, Any], name: str) -> Certificate:
    """Trust an estimator's values only near a trusted optimum; say how far from it they are."""
    certificate, problem = optimum.certificate, optimum.problem
    if not certificate.trusted:
        return certificate
    kept = problem.values(point)
    if not all(np.allclose(kept[name], values[name], rtol=1e-6, atol=1e-9) for name in kept):
        return certificate.refused(Code.MODEL, words.collapsed(name))
    away = problem.difference(point, optimum.point)
    distance = away / np.sqrt(np.diag(optimum.covariance))
    worst = int(np.argmax(np.abs(distance)))
    far = words.from_optimum(name, problem.names[worst], abs(distance[worst]))
    if not abs(distance[worst]) <= NEAR:
        return certificate.refused(Code.MODEL, far)
    return replace(certificate, reasons=(far, *certificate.reasons))
