"""Published answers that are not what they are said to be: one digit of GUM H.2, one minimum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

import casest as c
from casest.estimate.certificate import certify
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Problem
from casest.leastsquares.stated import at_true_values, stated_noise
from casest.solve.outcome import Outcome

#: Table H.2 of JCGM 100:2008: voltage (V), current (A), phase (rad) of five sets.
SETS = np.array([
    [5.007, 4.994, 5.005, 4.990, 4.999],
    [0.019663, 0.019639, 0.019640, 0.019685, 0.019678],
    [1.0456, 1.0438, 1.0468, 1.0428, 1.0433],
])  # fmt: skip


@c.model
def reactance(
    V=c.signal("V"), current=c.signal("A"), phase=c.signal("rad"), *, X=c.param("ohm", start=100.0)
):
    """X = V sin(phase) / current."""
    return c.Residual(implicit=V * c.sin(phase) - X * current, unit="V")


def test_the_printed_digit_is_that_of_the_second_way_and_casest_goes_the_first():
    each = SETS[0] * np.sin(SETS[2]) / SETS[1]
    second = np.std(each, ddof=1) / np.sqrt(5)  # H.2.4: the scatter of five values of X
    V, current, phase = SETS.mean(axis=1)
    slope = np.array([np.sin(phase), -V * np.sin(phase) / current, V * np.cos(phase)]) / current
    covariance = np.cov(SETS) / 5
    first = np.sqrt(slope @ covariance @ slope)  # H.2.3: from the means
    assert (f"{first:.5f}", f"{second:.5f}") == ("0.29558", "0.29549")
    data = {
        n: np.array([[m]]) for n, m in zip(("V", "current", "phase"), SETS.mean(1), strict=True)
    }
    run = c.Run.raw("H.2", data, units={"V": "V", "current": "A", "phase": "rad"})
    found = c.attempt(*stated_noise(reactance, [run], {"V,current,phase": [covariance[None]]}))
    assert float(found.std["X"]) == pytest.approx(first, rel=1e-6)


@c.model
def bounded(
    x=c.signal("1"),
    y=c.signal("1"),
    *,
    b1=c.param("1", start=2.0, bounds=(0, 10)),
    b2=c.param("1", start=0.5, bounds=(0, 0.9)),
):
    """ODRPACK95's simple example."""
    return c.Residual(measured=y, predicted=b1 * c.exp(b2 * x))


#: ODRPACK95 1.00, simple_example.f90; its printed answer is 1.63337057, 0.9 with 0.267368608.
X, Y = np.array([0.982, 1.998, 4.978, 6.01]), np.array([2.7, 7.4, 148.0, 403.0])


def judged(problem, values):
    """The certificate of a point as it is, with the true values that are likeliest there."""
    point = problem.point(values)
    problem = at_true_values(problem, point)
    claimed = Outcome("claimed", point, problem.cost(point), 1, 1, True, "", 0.0)
    sigma = float(np.sqrt(2 * claimed.cost / 2))
    known = identify(problem, point)
    return certify(problem, claimed, (), known, problem.factor(point), sigma), 2 * claimed.cost


def test_an_answer_that_odrpack_publishes_is_no_minimum_and_the_certificate_says_so():
    def residuals(z):  # of y and of x; b2 is held on its bound
        return np.r_[z[0] * np.exp(0.9 * (X + z[1:])) - Y, z[1:]]

    least = least_squares(residuals, [1.6, 0, 0, 0, 0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    held = bounded.having(b2=0.9)
    run = c.Run.raw("r", {"x": X[:, None], "y": Y[:, None]}, units={"x": "1", "y": "1"})
    problem = Problem(*stated_noise(held, [run], {"x": [np.ones(1)], "y": [np.ones(1)]}))
    published, cost = judged(problem, {"b1": 1.63337057})
    assert cost == pytest.approx(0.2673686, rel=3e-4)
    assert not published.trusted
    assert "not a stationary point" in published.reasons[0]
    found, least_cost = judged(problem, {"b1": least.x[0]})
    assert least_cost == pytest.approx(2 * least.cost, rel=1e-8)
    assert least_cost < 0.72 * cost
    assert found.step < 1e-4
    fitted = c.attempt(held, [run], sensor_noise={"x": 1.0, "y": 1.0})
    assert float(fitted.values["b1"]) == pytest.approx(least.x[0], rel=1e-6)
    assert fitted.certificate.trusted
