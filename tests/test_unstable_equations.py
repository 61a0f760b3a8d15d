"""Equations that cannot be followed from one beginning: chaos, and what feedback alone holds up.

Truth: SciPy's DOP853 at a tolerance of 1e-12, and the parameters put in.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casest
from casest import Run, UsageError, param, signal, sin, vertcat
from casest.dynamics import Motion, dynamics, measured, state
from casest.leastsquares.problem import Problem
from casest.solve.trust_region import trust_region


@dynamics
def lorenz(
    y=signal(),
    *,
    x=state(3, start=[-5, -5, 20]),
    sigma=param(start=8, bounds=(0, None)),
    rho=param(start=25, bounds=(0, None)),
    beta=param(start=2, bounds=(0, None)),
):
    rates = vertcat(sigma * (x[1] - x[0]), x[0] * (rho - x[2]) - x[1], x[0] * x[1] - beta * x[2])
    return Motion(rates={"x": rates}, outputs=(measured(y, x[0]),))


@pytest.mark.long
def test_lorenz_from_one_coordinate_by_multiple_shooting_where_single_shooting_ends_elsewhere():
    t = np.arange(0, 5, 0.05)
    found = solve_ivp(
        lambda s, x: [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]],
        (0, 5), [-8, 8, 27], "DOP853", t, rtol=1e-12, atol=1e-12,
    )  # fmt: skip
    y = found.y[0] + 0.2 * np.random.default_rng(0).standard_normal(len(t))
    run = Run.raw("lorenz", {"y": y[:, None]}, units={}, time=t)
    problem = Problem(lorenz.calibration, (run,))
    single = trust_region(problem, problem.start(), max_iterations=100)
    estimate = casest.attempt(
        lorenz.calibration, [run], solver="multiple-shooting", intervals=False
    )
    several = next(o for o in estimate.outcomes if o.solver == "multiple shooting")
    least = min(o.cost for o in estimate.outcomes)
    assert several.cost == pytest.approx(least, rel=1e-6)
    assert single.cost > 500 * least
    assert estimate.certificate.trusted
    for name, truth in (("sigma", 10), ("rho", 28), ("beta", 8 / 3)):
        assert abs(estimate.values[name] - truth) < 2 * estimate.std[name] < 0.1 * truth


def test_a_pendulum_held_upright_by_feedback_is_followed_from_many_beginnings():
    """Torque recorded, held between samples; two trajectories part as exp(4.5 t)."""

    @dynamics
    def upright(
        torque=signal(held=True),
        y=signal(),
        *,
        angle=state(start=0.0),
        rate=state(start=0.0),
        w2=param(start=8, bounds=(0, None)),
        gain=param(start=0.6),
    ):
        rates = {"angle": rate, "rate": w2 * sin(angle) + gain * torque}
        return Motion(rates=rates, outputs=(measured(y, angle),))

    rng, x = np.random.default_rng(0), np.array([0.1, -0.2])
    t, torque, angles = np.arange(0, 2.4, 0.04), [], []
    for _ in t:
        angles.append(x[0])
        torque.append(-40 * x[0] - 9 * x[1] + 3 * rng.standard_normal())
        push = torque[-1]
        x = solve_ivp(
            lambda s, x, push=push: [x[1], 20 * np.sin(x[0]) + push],
            (0, 0.04), x, "DOP853", rtol=1e-12, atol=1e-12,
        ).y[:, -1]  # fmt: skip
    y = np.array(angles) + 0.002 * rng.standard_normal(len(t))
    signals = {"torque": np.array(torque)[:, None], "y": y[:, None]}
    run = Run.raw("upright", signals, units={}, time=t)
    estimate = casest.attempt(upright.calibration, [run], intervals=False)
    assert "multiple shooting" in {o.solver for o in estimate.outcomes}
    assert estimate.certificate.trusted
    assert abs(estimate.values["w2"] - 20) < 3 * estimate.std["w2"] < 3
    assert abs(estimate.values["gain"] - 1) < 3 * estimate.std["gain"] < 0.15


def test_multiple_shooting_of_what_is_no_differential_equation_is_refused():
    @casest.model
    def line(x=signal(), y=signal(), *, a=param()):
        return casest.Residual(measured=y, predicted=a * x)

    x = np.arange(5.0)[:, None]
    run = Run.raw("line", {"x": x, "y": 2 * x}, units={})
    with pytest.raises(UsageError, match="line has none"):
        casest.attempt(line, [run], solver="multiple-shooting")
