"""Equations that run faster or slower as a whole: which powers, and that the slowest is meant."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from casest import Run, attempt, param, signal, sin, vertcat
from casest.dynamics import Motion, dynamics, measured, state
from casest.leastsquares.problem import Problem
from casest.solve.outcome import Outcome
from casest.solve.pace import pace_of, slower, turning

TRUE = 1.1**2


def swing(start, bounds=(0, None)):
    """A swing that begins at rest at 1, so that its angle is cos(√w2·t)."""

    @dynamics
    def swinging(
        x=signal(), *, z=state(2, start=[1, 0], known=True), w2=param(start=start, bounds=bounds)
    ):
        """A swing."""
        return Motion(rates={"z": vertcat(z[1], -w2 * z[0])}, outputs=(measured(x, z[0]),))

    return swinging.calibration


def readings(t, seed=0):
    noise = 0.01 * np.random.default_rng(seed).standard_normal(len(t))
    return Run.raw("swing", {"x": (np.cos(np.sqrt(TRUE) * t) + noise)[:, None]}, units={}, time=t)


EVEN = readings(np.arange(20.0))
FASTER = (2 * np.pi + np.sqrt(TRUE)) ** 2


@dynamics
def pendulum(
    x=signal("rad"),
    *,
    angle=state("rad", start=1),
    rate=state("rad/s", start=0.5),
    w2=param("1/s^2", start=4.0),
    viscous=param("1/s", start=0.1),
    drag=param("1/rad", start=0.1),
):
    """A swing with two frictions."""
    turned = -w2 * sin(angle) - viscous * rate - drag * rate * rate
    return Motion(rates={"angle": rate, "rate": turned}, outputs=(measured(x, angle),))


def test_powers_of_a_pendulum_are_those_of_its_units():
    """A square of a frequency by 2, what is per second by 1, an angle and a drag per angle by 0."""
    model = pendulum.calibration
    powers = dict(zip((p.name for p in model.parameters), pace_of(model).powers, strict=True))
    expected = {"w2": 2, "viscous": 1, "drag": 0, "angle_start": 0, "rate_start": 1}
    assert powers == pytest.approx(expected, abs=1e-9)


def test_a_course_followed_by_scipy_is_the_same_at_another_pace():
    model, t = pendulum.calibration, np.linspace(0, 5, 26)
    nothing = Run.raw("p", {"x": np.zeros((len(t), 1))}, units={}, time=t)
    problem = Problem(model, (nothing,))
    point = problem.start()
    fast = problem.values(pace_of(model).at(problem, point, -1.7))

    def rate(_, z):
        return z[1], -fast["w2"] * np.sin(z[0]) - (fast["viscous"] + fast["drag"] * z[1]) * z[1]

    begun = fast["angle_start"], fast["rate_start"]
    there = solve_ivp(rate, (0, 5), begun, "DOP853", t, rtol=1e-11, atol=1e-12).y[0]
    slow = solve_ivp(
        lambda _, z: (z[1], -4 * np.sin(z[0]) - (0.1 + 0.1 * z[1]) * z[1]),
        (0, -8.5), (1, 0.5), "DOP853", -1.7 * t, rtol=1e-11, atol=1e-12,
    ).y[0]  # fmt: skip
    np.testing.assert_allclose(there, slow, atol=1e-7)


def test_a_known_rate_has_no_pace():
    @dynamics
    def known(x=signal(), *, z=state(2, start=[1, 0], known=True), k=param(start=0.1)):
        """A swing whose frequency is known."""
        return Motion(rates={"z": vertcat(z[1], -z[0] - k * z[1])}, outputs=(measured(x, z[0]),))

    assert pace_of(known.calibration) is None


@pytest.mark.parametrize("w2", [TRUE, FASTER])
def test_half_turns_between_rows_are_those_of_the_cosine(w2):
    problem = Problem(swing(w2), (EVEN,))
    here = np.cos(np.sqrt(w2) * np.linspace(0, 19, 100_001))
    turns = np.sum(np.diff(here)[1:] * np.diff(here)[:-1] < 0) / 19
    assert turning(problem, problem.start()) == pytest.approx(turns, abs=0.06)


def test_of_courses_through_even_rows_the_slowest_is_given_and_another_is_named():
    found = attempt(swing(0.99 * FASTER), [EVEN])
    assert found.certificate.trusted, found.certificate.reasons
    assert abs(found.values["w2"] - TRUE) < 4 * found.std["w2"]
    assert any("met as well by a faster course" in remark for remark in found.notes)


def test_a_stated_start_says_which_course_is_meant():
    found = attempt(swing(1.0), [EVEN], start={"w2": FASTER})
    assert abs(found.values["w2"] - FASTER) < 4 * found.std["w2"]


def test_bounds_leave_the_slower_course_out():
    found = attempt(swing(0.99 * FASTER, bounds=(45, 70)), [EVEN])
    assert abs(found.values["w2"] - FASTER) < 4 * found.std["w2"]


def test_where_rows_are_not_even_a_fast_valley_leads_to_the_lower_slow_one():
    t = np.arange(20.0) + 0.03 * np.random.default_rng(1).standard_normal(20)
    t[0] = 0
    problem = Problem(swing(FASTER), (readings(t),))
    first = problem.start()
    begun = Outcome("", first, problem.cost(first), 0, 0, True, "", 0.0)
    end = slower(problem, begun)[-1]
    assert end.cost < 0.1 * begun.cost
    assert end.point.x[0] == pytest.approx(TRUE, rel=0.01)
