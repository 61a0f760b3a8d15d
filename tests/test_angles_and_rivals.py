"""Other solutions: whole turns of an angle are none, near ones are the same, far ones are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casest import Residual, Run, calibrate, cos, model, param, signal, sin
from casest.estimate.calibrate import attempt
from casest.estimate.certificate import certify
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Problem
from casest.solve.outcome import Outcome


@model
def compass(heading=signal("rad"), y=signal("uT"), *,
            field=param("uT", start=20.0), turned=param("rad", start=0.4)):  # fmt: skip
    """One axis of a magnetometer on a turntable; its mounting angle has no bounds."""
    return Residual(measured=y, predicted=field * cos(heading + turned))


def turned_by(angle, n=40, seed=0):
    rng = np.random.default_rng(seed)
    heading = rng.uniform(0, 2 * np.pi, (n, 1))
    y = 22.0 * np.cos(heading + angle) + 0.2 * rng.standard_normal((n, 1))
    return Run.raw("r", {"heading": heading, "y": y}, units={})


def judged(problem, best, others):
    """The certificate of a point beside other outcomes, all given as values."""

    def outcome(values):
        point = problem.point(values)
        return Outcome("given", point, problem.cost(point), 1, 1, True, "", 0.0)

    best = outcome(best)
    factor = problem.factor(best.point)
    sigma = np.sqrt(2 * best.cost / (problem.residual_count - problem.unknowns))
    return certify(
        problem, best, [best, *map(outcome, others)], identify(problem, best.point), factor, sigma
    )


@pytest.mark.parametrize("turns", [-2, -1, 1, 3])
def test_whole_turns_of_an_angle_are_one_solution(turns):
    run = turned_by(0.5)
    problem = Problem(compass, (run,))
    found = attempt(compass, [run])
    values = {n: float(v) for n, v in found.values.items()}
    other = {**values, "turned": values["turned"] + 2 * np.pi * turns}
    assert problem.cost(problem.point(other)) == pytest.approx(
        problem.cost(problem.point(values)), rel=1e-9
    )
    said = judged(problem, values, [other])
    assert said.trusted
    assert said.agreeing == said.starts
    # Half a turn with the field turned round fits as well, and is another solution.
    half = {"field": -values["field"], "turned": values["turned"] + np.pi * (2 * turns + 1)}
    said = judged(problem, values, [half])
    assert not said.trusted
    assert "two solutions fit alike" in said.reasons[0]


def test_half_a_turn_is_another_solution_where_the_readings_repeat_after_it():
    @model
    def twice(heading=signal("rad"), y=signal("uT"), *,
              field=param("uT", start=20.0), turned=param("rad", start=0.4)):  # fmt: skip
        return Residual(measured=y, predicted=field * cos(2 * (heading + turned)))

    run = turned_by(0.5)
    run = replace(run, signals={**run.signals, "heading": run.signals["heading"] / 2})
    values = {n: float(v) for n, v in attempt(twice, [run]).values.items()}
    problem = Problem(twice, (run,))
    assert judged(problem, values, [{**values, "turned": values["turned"] + 2 * np.pi}]).trusted
    said = judged(problem, values, [{**values, "turned": values["turned"] + np.pi}])
    assert "two solutions fit alike: `turned`" in said.reasons[0]


def test_from_a_start_turns_away_the_angle_is_found_and_believed():
    found = calibrate(compass, [turned_by(0.5)], start={"turned": 0.4 + 6 * np.pi})
    assert np.cos(found.values["turned"] - 0.5) == pytest.approx(1, abs=1e-4)


def test_a_turn_of_an_angle_in_degrees_is_360():
    @model
    def degrees(heading=signal("rad"), y=signal("uT"), *,
                field=param("uT", start=20.0), turned=param("deg", start=20.0)):  # fmt: skip
        return Residual(measured=y, predicted=field * cos(heading + turned * (np.pi / 180)))

    found = calibrate(degrees, [turned_by(0.5)], start={"turned": 20.0 + 3 * 360.0})
    assert np.cos(np.radians(found.values["turned"]) - 0.5) == pytest.approx(1, abs=1e-4)


@model
def squared(x=signal(), y=signal(), *, b=param(start=1.0), level=param()):
    """Two values of b, one as good as the other."""
    return Residual(measured=y, predicted=level + b**2 * x)


def a_square(b, sigma, n=50, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 1))
    return Run.raw("r", {"x": x, "y": b**2 * x + sigma * rng.standard_normal((n, 1))}, units={})


def test_a_mirrored_solution_is_named_beside_the_one_of_the_start():
    found = attempt(squared, [a_square(1.0, 0.1)], start={"b": -0.9, "level": 0.0})
    value = float(found.values["b"])
    assert value == pytest.approx(-1.0, abs=0.05)
    said = [note for note in found.notes if "other values are the same function" in note]
    assert f"`b` = {-value:.4g}"[:10] in said[0]


@pytest.mark.parametrize("away", [0.3, 1.0, 1.5])
def test_what_ended_within_the_std_of_the_best_is_no_rival(away):
    """Another way that stopped on the way to the optimum: followed, it is the same."""
    run = turned_by(0.5)
    found = attempt(compass, [run])
    problem = Problem(compass, (run,))
    values = {n: float(v) for n, v in found.values.items()}
    near = {n: values[n] + away * float(found.std[n]) for n in values}
    said = judged(problem, values, [near])
    assert said.trusted
    assert "; the others end higher" in " ".join(said.reasons)


def test_what_fits_worse_than_a_95_percent_test_allows_is_no_rival():
    """A second valley of sin(wx): 400 σ² above the first."""

    @model
    def wave(x=signal(), y=signal(), *, w=param(start=2.0)):
        return Residual(measured=y, predicted=sin(w * x))

    rng = np.random.default_rng(3)
    x = np.linspace(0, 6, 60)[:, None]
    run = Run.raw("r", {"x": x, "y": np.sin(2 * x) + 0.2 * rng.standard_normal(x.shape)}, units={})
    problem, found = Problem(wave, (run,)), attempt(wave, [run])
    values = {"w": float(found.values["w"])}
    assert judged(problem, values, [{"w": 3.3}]).trusted
