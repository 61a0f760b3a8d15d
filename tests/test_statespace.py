"""A declared model at an instant, in python-control's hands."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import scipy.linalg

from casest import Run, UsageError, constant, signal, sin
from casest.dynamics import Motion, dynamics, measured, state, to_statespace
from casest.dynamics.gramian import gramian
from casest.dynamics.riccati import riccati
from casest.dynamics.transition import linearised, transitions
from casest_problems.bias_gravity import bias_gravity


@dynamics
def cart(
    u=signal("m/s^2"),
    y=signal("m"),
    *,
    position=state("m", intensity=1e-3, std=2.0),
    velocity=state("m/s", intensity=0.02, std=1.0),
    damping=constant(0.8, "1/s"),
):
    """A damped cart on a spring: constant coefficients, stable."""
    rates = {"position": velocity, "velocity": u - damping * velocity - 1.5 * position}
    return Motion(rates=rates, outputs=(measured(y, position, intensity=0.01),))


@dynamics
def pendulum(
    torque=signal("1/s^2"),
    y=signal("rad"),
    *,
    angle=state("rad"),
    rate=state("rad/s"),
    gravity=constant(9.81, "m/s^2"),
    length=constant(0.5, "m"),
):
    """Angle from below; the torque divided by the moment of inertia."""
    rates = {"angle": rate, "rate": torque - gravity / length * sin(angle)}
    return Motion(rates=rates, outputs=(measured(y, angle, intensity=1e-3),))


def cart_at_rest(seconds, step):
    t = np.arange(0, seconds, step)
    zero = np.zeros((len(t), 1))
    return Run.raw("cart", {"u": zero, "y": zero}, units={}, time=t)


def test_constant_coefficients_need_no_instant():
    system = to_statespace(cart)
    np.testing.assert_array_equal(system.A, [[0, 1], [-1.5, -0.8]])
    np.testing.assert_array_equal(system.B, [[0], [1]])
    np.testing.assert_array_equal(system.C, [[1, 0]])
    np.testing.assert_array_equal(system.D, [[0]])
    assert system.state_labels == ["position", "velocity"]
    assert (system.input_labels, system.output_labels) == (["u"], ["y"])


def test_a_constant_of_the_model_can_be_another():
    assert to_statespace(cart.having(damping=0.1)).A[1, 1] == -0.1


def test_the_steady_filter_is_python_controls(control):
    system = to_statespace(cart)
    _, P, _ = control.lqe(system.A, np.eye(2), system.C, cart.process, cart.noise)
    found = riccati(cart, linearised(cart, cart_at_rest(40, 0.05)))[-1]
    np.testing.assert_allclose(found, P, rtol=1e-8)
    expected = scipy.linalg.solve_continuous_are(system.A.T, system.C.T, cart.process, cart.noise)
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_the_gramian_is_python_controls_and_scipys(control):
    """slycot solves python-control's."""
    system = to_statespace(cart)
    W = gramian(cart, linearised(cart, cart_at_rest(60, 0.02))) * cart.noise[0, 0]
    np.testing.assert_allclose(W, control.gram(system, "o"), rtol=1e-8, atol=1e-9)
    expected = scipy.linalg.solve_continuous_lyapunov(system.A.T, -system.C.T @ system.C)
    np.testing.assert_allclose(W, expected, rtol=1e-8, atol=1e-9)


def test_the_motion_between_samples_is_python_controls(control):
    """Forced by a sine, which straight lines between samples follow to h²."""
    t = np.arange(0, 10, 0.01)
    u = np.sin(t)
    run = Run.raw("cart", {"u": u[:, None], "y": 0 * u[:, None]}, units={}, time=t)
    Phi, forced = transitions(linearised(cart, run))
    x = np.zeros(2)
    for P, f in zip(Phi, forced, strict=True):
        x = P @ x + f
    expected = control.forced_response(to_statespace(cart), T=t, U=u).states[:, -1]
    np.testing.assert_allclose(x, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("angle", "poles"), [
    (0.0, [-1j, 1j]), (np.pi, [-1.0, 1.0]),
])  # fmt: skip
def test_a_pendulum_swings_below_and_falls_above(angle, poles, control):
    """At √(g/l) either way."""
    system = to_statespace(pendulum, state=[angle, 0.0])
    expected = np.array(poles) * np.sqrt(9.81 / 0.5)
    np.testing.assert_allclose(np.sort_complex(control.poles(system)), expected, atol=1e-7)


def test_an_instant_of_a_record_lies_between_its_samples():
    t = np.array([0.0, 1.0, 2.0])
    omega = np.c_[0.1 * t, 0 * t, 0.3 + 0 * t]
    signals = {"a": np.zeros((3, 3)), "omega": omega, "v": np.zeros((3, 3))}
    run = Run.raw("flight", signals, units={}, time=t)
    system = to_statespace(bias_gravity, run=run, time=1.5)
    given = to_statespace(bias_gravity, omega=[0.15, 0, 0.3])
    np.testing.assert_allclose(system.A, given.A, atol=1e-15)
    turn = np.array([[0, -0.3, 0], [0.3, 0, -0.15], [0, 0.15, 0]])
    np.testing.assert_allclose(system.A[3:6, 3:6], -turn, atol=1e-15)
    assert system.input_labels == ["a[0]", "a[1]", "a[2]"]
    with pytest.raises(UsageError, match="lasts from 0 to 2 s; there is no instant 3 s"):
        to_statespace(bias_gravity, run=run, time=3)


def test_a_coefficient_without_a_value_is_named():
    with pytest.raises(UsageError, match="coefficients depend on omega: give its value, omega=…"):
        to_statespace(bias_gravity)


@pytest.mark.parametrize(("given", "words"), [
    ({"wind": 1}, "has no signal 'wind'; it has u, y"),
    ({"u": [1, 2]}, "u has 1 numbers, not 2"),
    ({"state": [1]}, "state has 1 numbers, the model 2"),
])  # fmt: skip
def test_what_does_not_fit_is_named(given, words):
    with pytest.raises(UsageError, match=words):
        to_statespace(cart, **given)


def test_without_python_control_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(UsageError, match=r"pip install 'casest\[control\]'"):
        to_statespace(cart)
