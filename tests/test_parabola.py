"""The cost of a model that is linear in its unknowns follows from one look at the samples."""

from __future__ import annotations

import numpy as np
import pytest

from casest import Residual, calibrate, exp, model, param, signal
from casest.data import Run
from casest.leastsquares.problem import Point, Problem


@model
def straight(x=signal("1"), y=signal("1"), *, a=param("1"), b=param("1", start=1.0)):
    """A line."""
    return Residual(measured=y, predicted=a + b * x)


@model
def bent(x=signal("1"), y=signal("1"), *, a=param("1", start=1.0), b=param("1")):
    """An exponential."""
    return Residual(measured=y, predicted=a * exp(b * x))


def points(x, noise=0.1):
    """A straight line with noise."""
    rng = np.random.default_rng(3)
    y = 1 + 2 * x + noise * rng.standard_normal(len(x))
    return Run.raw("r", {"x": x[:, None], "y": y[:, None]}, units={"x": "1", "y": "1"})


def looks(monkeypatch):
    """At which points samples are looked at."""
    at, own = [], Problem._run_normal

    def seen(self, point, r):
        at.append(point)
        return own(self, point, r)

    monkeypatch.setattr(Problem, "_run_normal", seen)
    return at


def of_numpy(run, point):
    """Cost, slope and curvature of the line from its design matrix alone."""
    design = np.column_stack([np.ones(len(run)), run.signals["x"]])
    residual = design @ point.x - run.signals["y"][:, 0]
    return 0.5 * residual @ residual, design.T @ residual, design.T @ design


@pytest.fixture
def best():
    """A line's problem, and where NumPy has its optimum."""
    run = points(np.linspace(0, 3, 500))
    a, b = np.polynomial.polynomial.polyfit(run.signals["x"][:, 0], run.signals["y"][:, 0], 1)
    return Problem(straight, (run,)), Point(np.array([a, b]), np.zeros(0))


@pytest.mark.parametrize("away", [1e-9, 1e-3, 0.02])
def test_what_follows_from_one_look_is_what_the_samples_say(best, away, monkeypatch):
    problem, optimum = best
    problem.normal(optimum)
    at = looks(monkeypatch)
    point = Point(optimum.x + away * np.array([1.0, -2.0]), optimum.references)
    found, (cost, slope, curvature) = problem.normal(point), of_numpy(problem.runs[0], point)
    assert not at
    assert found.cost == pytest.approx(cost, rel=1e-13)
    assert problem.cost(point) == found.cost
    scale = np.sqrt(2 * cost * np.diag(curvature))
    assert found.gradient / scale == pytest.approx(slope / scale, abs=1e-13)
    assert found.matrix == pytest.approx(curvature, rel=1e-13)
    R, t, rest = problem.factor(point)
    assert pytest.approx(curvature, rel=1e-13) == R.T @ R
    assert R.T @ t / scale == pytest.approx(slope / scale, abs=1e-13)
    assert t @ t + rest**2 == pytest.approx(2 * cost, rel=1e-13)


def test_the_samples_are_looked_at_again_where_digits_would_be_lost(best, monkeypatch):
    problem, optimum = best
    far = Point(optimum.x + 1e6, optimum.references)
    at = looks(monkeypatch)
    problem.normal(far)
    found = problem.normal(optimum)
    assert at == [far, optimum]
    assert found.cost == pytest.approx(of_numpy(problem.runs[0], optimum)[0], rel=1e-13)


@pytest.mark.parametrize(
    ("declared", "run"),
    [
        (bent, points(np.linspace(0, 1, 50))),
        (straight, points(np.linspace(0, 3, 50), noise=1e-9)),
        (straight, points(1e6 + np.linspace(0, 1, 50))),
    ],
    ids=["no parabola", "a residual of rounding", "columns that are nearly one"],
)
def test_nothing_follows_from_one_look_where_it_tells_too_little(declared, run, monkeypatch):
    problem = Problem(declared, (run,))
    point = problem.point({"a": 1.0, "b": 2.0})
    problem.normal(point)
    at = looks(monkeypatch)
    problem.normal(Point(point.x + 1e-12, point.references))
    assert len(at) == 1


def test_an_estimate_is_judged_by_the_samples_at_its_own_place(monkeypatch):
    run = points(np.linspace(0, 3, 500))
    at = looks(monkeypatch)
    found = calibrate(straight, run)
    assert any(point is found.point for point in at)


def test_what_is_built_for_one_record_serves_the_next_of_other_noise():
    x, rng = np.linspace(0, 3, 50), np.random.default_rng(4)
    y = 1 + 2 * x + 0.1 * rng.standard_normal(50)
    quiet, loud = (
        calibrate(straight, {"x": x, "y": y}, sensor_noise={"x": 0.01, "y": std})
        for std in (0.1, 0.2)
    )
    assert quiet.model == loud.model
    assert quiet.model.traced is loud.model.traced
    for found, std in ((quiet, 0.1), (loud, 0.2)):  # of a residual: the input's noise on the slope
        steep = float(found.values["b"])
        assert found.noise.stated == pytest.approx(np.hypot(std, 0.01 * steep), rel=1e-6)


def test_values_by_entry_are_those_by_sample():
    from casest.leastsquares.per_sample import residual_and_jacobian

    problem = Problem(straight, (points(np.linspace(0, 3, 20_000)),))
    replay, parameters = residual_and_jacobian(straight), np.array([0.5, 1.5])
    by_sample = replay(parameters, problem.samples[0])
    for first, last in zip(replay.by_entry(parameters, problem.samples[0]), by_sample, strict=True):
        assert np.array_equal(np.moveaxis(first, -1, 0), last)
