"""Each threshold of the certificate, asked alone: what lies on either side of it.

The questions overlap, and a loose one hides behind the next. So `certify` is given points and other
outcomes that only one of them can tell.
"""

from __future__ import annotations

import numpy as np
import pytest
import simulators as sim

from casest import Residual, Run, cos, model, param, signal, sin, vertcat
from casest.estimate.calibrate import attempt
from casest.estimate.certificate import certify
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Problem
from casest.results.find import find_model
from casest.solve.outcome import Outcome


@model
def line(x=signal(), y=signal(), *, slope=param(start=1.0, bounds=(0.0, 4.0)), level=param()):
    return Residual(measured=y, predicted=level + slope * x)


def straight(n=50, slope=2.0, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 1))
    y = 1 + slope * x + 0.1 * rng.standard_normal((n, 1))
    return Run.raw("r", {"x": x, "y": y}, units={})


def judged(problem, best, others=()):
    """The certificate of values beside those where other ways ended."""

    def outcome(values):
        point = problem.point(values)
        return Outcome("given", point, problem.cost(point), 1, 1, True, "", 0.0)

    best = outcome(best)
    found, factor = identify(problem, best.point), problem.factor(best.point)
    sigma = np.sqrt(2 * best.cost / (problem.residual_count - problem.unknowns))
    return certify(problem, best, [outcome(o) for o in others], found, factor, sigma)


def optimum(declared, run):
    found = attempt(declared, [run])
    values = {name: np.array(v) for name, v in found.values.items()}
    return Problem(declared, (run,)), values, found.std


@pytest.mark.parametrize(("deviations", "believed"), [(1e-5, True), (0.01, False), (0.3, False)])
def test_a_hundredth_of_a_standard_deviation_from_the_optimum_is_not_stationary(
    deviations, believed
):
    problem, values, std = optimum(line, straight())
    moved = values | {"level": values["level"] + deviations * std["level"]}
    said = judged(problem, moved)
    assert said.trusted is believed
    if not believed:
        assert "not a stationary point" in said.reasons[0]
        assert said.step == pytest.approx(deviations, rel=0.05)


@pytest.mark.parametrize(("deviations", "at_bound"), [(0.0, True), (1e-4, True), (0.1, False)])
def test_on_a_bound_is_what_rounding_cannot_tell_from_it(deviations, at_bound):
    """An interior point ends a little before the bound."""
    problem, values, std = optimum(line, straight(slope=3.0))
    bound = float(values["slope"] + deviations * std["slope"])
    slope = param(start=1.0, bounds=(0.0, bound))
    capped = Problem(line.having(slope=slope), problem.runs)
    said = judged(capped, values)
    assert ("slope" in [b.name for b in said.at_bound]) is at_bound


@pytest.mark.parametrize(("deviations", "agreeing"), [(1e-3, 1), (0.1, 0), (1.0, 0)])
def test_another_way_agrees_if_it_ended_within_a_hundredth_of_a_deviation(deviations, agreeing):
    problem, values, std = optimum(line, straight())
    ended = values | {"level": values["level"] + deviations * std["level"]}
    said = judged(problem, values, [ended])
    assert said.trusted
    assert (said.agreeing, said.starts) == (agreeing, 1)


@model
def circle(y=signal(2), *, angle=param("rad")):
    return Residual(measured=y, predicted=vertcat(cos(angle), sin(angle)))


@pytest.mark.parametrize(
    ("angle", "words"), [(0.0, ""), (np.pi, "no minimum: the exact curvature")]
)
def test_the_farthest_point_of_a_circle_is_no_minimum_though_its_slope_is_zero(angle, words):
    """The readings lie at (0.5, 0): the nearest point at 0, the farthest at π, curvature −½."""
    y = np.tile([0.5, 0.0], (20, 1))
    problem = Problem(circle, (Run.raw("r", {"y": y}, units={}),))
    said = judged(problem, {"angle": angle})
    assert said.curvature == pytest.approx(-0.5 if words else 0.5, abs=1e-9)
    assert said.trusted is not bool(words)
    assert said.reasons[0].startswith(words)


@model
def tilted(x=signal(2), y=signal(2), *, b=param(start=1.0)):
    """b² from one reading, and weakly b itself from another: the valleys ±b, one a little lower."""
    return Residual(measured=y, predicted=vertcat(b**2 * x[0], b * x[1]))


def two_valleys(excess, sigma):
    """Fits at b = 1 and near −1; that at −1 has `excess` σ² more of cost."""
    rng = np.random.default_rng(1)
    n = 200
    x = np.zeros((n, 2))
    x[: n // 2, 0], x[n // 2 :, 1] = 1.0, 1.0
    weak = np.sqrt(2 * excess / 4 / (n // 2)) * sigma  # ½·(2·weak)²·n/2 = excess·σ²
    x[n // 2 :, 1] = weak
    noise = sigma * rng.standard_normal((n, 2))
    noise[n // 2 :, 1] -= noise[n // 2 :, 1].mean()
    noise[: n // 2, 1] = noise[n // 2 :, 0] = 0.0
    noise *= np.sqrt(2)  # half of the residuals have none
    y = np.c_[x[:, 0], x[:, 1]] + noise
    problem = Problem(tilted, (Run.raw("r", {"x": x, "y": y}, units={}),))
    best = attempt(tilted, [Run.raw("r", {"x": x, "y": y}, units={})])
    values = {"b": np.abs(best.values["b"])}
    mirror = {"b": -np.abs(best.values["b"])}
    return problem, values, mirror


@pytest.mark.parametrize(
    ("excess", "believed"), [(0.2, False), (1.2, False), (3.0, True), (8.0, True)]
)
def test_a_second_valley_counts_up_to_the_95_percent_of_a_test(excess, believed):
    """χ² of one degree of freedom: 3.84, of a cost half of that."""
    problem, values, mirror = two_valleys(excess, 1.0)
    low, high = (problem.cost(problem.point(v)) for v in (values, mirror))
    sigma2 = 2 * low / (problem.residual_count - 1)
    assert (high - low) / sigma2 == pytest.approx(excess, rel=0.25)
    said = judged(problem, values, [mirror])
    assert said.trusted is believed
    if not believed:
        assert "two solutions fit alike" in said.reasons[0]


def test_noise_that_bends_with_the_surface_is_refused_by_its_size():
    """Second order σ/g: at 4 % believed, at 12 % not."""
    declared = find_model("norm-triangular").having(norm=sim.GRAVITY)
    for share, believed in ((0.04, True), (0.12, False)):
        rng = np.random.default_rng(2)
        sensor = sim.accelerometer(rng)
        v = sensor.read(sim.spread_poses(200, rng), share * sim.GRAVITY, rng)
        found = attempt(declared, [Run.raw("r", {"v": v}, units={"v": "m/s^2"})])
        assert found.certificate.trusted is believed
        if not believed:
            assert "the noise is too large" in found.certificate.reasons[0]


def test_what_noise_adds_to_a_length_is_in_the_std_of_one_calibration():
    """30 sensors of 1500 poses: the shift is as large as the spread, and the intervals hold it."""
    declared = find_model("norm-triangular").having(norm=sim.GRAVITY)
    rng, pulls, away = np.random.default_rng(3), [], []
    for _ in range(30):
        sensor = sim.accelerometer(rng)
        v = sensor.read(sim.spread_poses(1500, rng), 0.4, rng)
        found = attempt(declared, [Run.raw("r", {"v": v}, units={"v": "m/s^2"})],
                        solver="trust-region")  # fmt: skip
        error = np.diag(found.values["scale"] - sensor.scale)
        pulls.append(error / np.diag(found.std["scale"]))
        away.append(error)
    assert 0.6 < np.mean(np.square(pulls)) < 1.3
    assert np.mean(np.abs(np.mean(away, axis=0)) / np.std(away, axis=0)) > 0.5
