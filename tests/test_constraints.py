"""What holds without noise: of parameters, at every sample; least squares with multipliers.

Truth: the linear equations of Lagrange, the same fit with fewer unknowns, SciPy with DOP853.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import casest
from casest import (
    DeclarationError,
    Residual,
    Run,
    constraint,
    exp,
    model,
    param,
    signal,
    sum1,
    vertcat,
)
from casest.dynamics import Motion, dynamics, measured, state
from casest.estimate.covariance import inverse_normal

X = np.linspace(0, 4, 60)
DECAYS = np.column_stack([np.exp(-X), np.exp(-3 * X), np.exp(-0.3 * X), X])


def run_of(y, x=X) -> Run:
    return Run.raw("run", {"x": x[:, None], "y": y[:, None]}, units={}, time=x)


def multipliers(found) -> np.ndarray:
    problem = found.problem
    return problem.force.multipliers(0, problem.kept_at(found.point)[0][0])


@model
def mixture(x=signal(), y=signal(), *, f=param(3, start=0.3), g=param(start=1.0)):
    predicted = f[0] * exp(-x) + f[1] * exp(-3 * x) + f[2] * exp(-0.3 * x) + g * x
    return Residual(measured=y, predicted=predicted, constraints=(constraint(sum1(f), 1),))


def test_fractions_that_sum_to_one_are_lagranges_linear_equations():
    """Values, multiplier, noise with one degree of freedom more, covariance."""
    y = DECAYS @ [0.2, 0.5, 0.3, 0.1] + 0.01 * np.random.default_rng(0).standard_normal(60)
    found = casest.attempt(mixture, [run_of(y)])
    assert found.certificate.trusted
    assert "constraints are kept, 1 of 1 act" in found.certificate.reasons[-1]
    one = np.array([[1.0, 1, 1, 0]])
    whole = np.block([[DECAYS.T @ DECAYS, one.T], [one, np.zeros((1, 1))]])
    known = np.linalg.solve(whole, [*(DECAYS.T @ y), 1])
    assert found.point.x == pytest.approx(known[:4], abs=1e-10)
    assert np.sum(found.values["f"]) == pytest.approx(1, abs=1e-14)
    assert multipliers(found) == pytest.approx(-known[4:], rel=1e-6)
    left = y - DECAYS @ known[:4]
    assert found.noise.sigma == pytest.approx(np.sqrt(left @ left / 57), rel=1e-10)
    plain = inverse_normal(found.problem.factor(found.point)[0])
    assert plain == pytest.approx(np.linalg.inv(whole)[:4, :4], abs=1e-6 * plain.max())
    assert abs(found.covariance[:3, :3].sum()) < 1e-6 * found.covariance[0, 0]


@pytest.mark.parametrize("slow", [0.45, 0.2])
def test_a_limit_acts_where_the_data_pass_it_and_only_there(slow):
    """a ≥ b: the fit with one amplitude, or that without a limit."""

    @model
    def two(x=signal(), y=signal(), *, a=param(start=1.0), b=param(start=0.5)):
        predicted = a * exp(-x) + b * exp(-3 * x)
        kept = (constraint(a - b, at_least=0), constraint(a, at_most=9))
        return Residual(measured=y, predicted=predicted, constraints=kept)

    y = DECAYS[:, :2] @ [0.4, slow] + 0.02 * np.random.default_rng(1).standard_normal(60)
    found = casest.attempt(two, [run_of(y)])
    assert found.certificate.trusted
    columns = DECAYS[:, :2] if slow == 0.2 else DECAYS[:, :1] + DECAYS[:, 1:2]
    known = np.linalg.lstsq(columns, y)[0]
    assert found.point.x == pytest.approx(np.broadcast_to(known, 2), abs=1e-10)
    slope = DECAYS[:, :2].T @ (DECAYS[:, :2] @ found.point.x - y)
    assert slope == pytest.approx(multipliers(found) @ [[1, -1], [-1, 0]], abs=1e-9)
    plain = inverse_normal(found.problem.factor(found.point)[0])
    expected = np.linalg.inv(columns.T @ columns)
    assert plain == pytest.approx(np.broadcast_to(expected, (2, 2)), rel=1e-5)


def test_constraints_that_the_data_contradict_are_refused():
    y = DECAYS @ [0.3, 0.6, 0.3, 0.1] + 0.01 * np.random.default_rng(0).standard_normal(60)
    found = casest.attempt(mixture, [run_of(y)])
    assert not found.certificate.trusted
    assert "standard deviations away from the constraints" in found.certificate.reasons[0]


def test_what_equations_conserve_is_kept_at_every_sample():
    """x₀² + x₁² = 1 of an oscillator; SciPy with an angle in place of where it begins."""

    @dynamics
    def turning(
        y=signal(), *, x=state(2, start=[0.8, 0.3]), w=param(start=1.9), c=param(start=0.1)
    ):
        rate = w + c * x[0]
        return Motion(
            rates={"x": vertcat(-rate * x[1], rate * x[0])},
            outputs=(measured(y, x[0]),),
            constraints=constraint(x[0] ** 2 + x[1] ** 2, 1),
        )

    t = np.linspace(0, 3, 16)

    def course(w, c, angle):
        angles = solve_ivp(
            lambda s, a: w + c * np.cos(a), (0, 3), [angle], "DOP853", t, rtol=1e-12, atol=1e-12
        ).y[0]
        return np.cos(angles)

    y = course(2.0, 0.3, 0.5) + 0.03 * np.random.default_rng(2).standard_normal(16)
    run = Run.raw("turning", {"y": y[:, None]}, units={}, time=t)
    found = casest.attempt(turning.calibration, [run], intervals=False)
    assert found.certificate.trusted
    known = least_squares(
        lambda p: course(*p) - y, [2, 0.3, 0.5], "3-point", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    w, c, angle = known.x
    assert found.point.x == pytest.approx([w, c, np.cos(angle), np.sin(angle)], abs=1e-6)
    states = found.problem.given(found.point, 0)
    assert np.sum(states**2, axis=1) == pytest.approx(1, abs=1e-8)
    plain = inverse_normal(found.problem.factor(found.point)[0])
    expected = np.linalg.inv(known.jac.T @ known.jac)
    assert plain[:2, :2] == pytest.approx(expected[:2, :2], rel=1e-4)


def test_constraints_that_contradict_each_other_are_refused():
    @model
    def line(x=signal(), y=signal(), *, a=param(start=1.0), b=param()):
        kept = (constraint(a + b, 1), constraint(2 * a + 2 * b, 3))
        return Residual(measured=y, predicted=a * x + b, constraints=kept)

    found = casest.attempt(line, [run_of(X + np.sin(40 * X))], intervals=False)
    assert not found.certificate.trusted
    assert "a constraint cannot be kept" in found.certificate.reasons[0]


def test_a_bound_of_a_state_holds_along_the_record():
    """A level that the data would take below zero ends there; SciPy's trust-constr agrees."""

    @dynamics
    def draining(
        y=signal(), *, x=state(start=1.0, known=True, bounds=(0, None)), k=param(start=0.3)
    ):
        return Motion(rates={"x": -k}, outputs=(measured(y, x),))

    t = np.linspace(0, 2, 9)
    y = 1 - 0.55 * t + 0.05 * np.random.default_rng(0).standard_normal(9)
    run = Run.raw("draining", {"y": y[:, None]}, units={}, time=t)
    found = casest.attempt(draining.calibration, [run], intervals=False)
    assert found.values["k"] == pytest.approx(0.5, abs=1e-9)  # empty at the last sample
    c = found.problem.kept_at(found.point)[0][0]
    force = found.problem.force.multipliers(0, c)
    assert np.flatnonzero(force > 0).tolist() == [8]
    assert force[8] * 2 == pytest.approx(t @ (y - 1 + 0.5 * t) * -1, rel=1e-6)


def test_what_a_constraint_says_is_one_thing():
    with pytest.raises(DeclarationError, match="give one of the three"):
        constraint(1.0, 1, at_least=0)
    with pytest.raises(DeclarationError, match="give one of the three"):
        constraint(1.0)
