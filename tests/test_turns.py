"""Rates integrated between rests, against SciPy's integrator and rotations."""

from __future__ import annotations

import numpy as np
import pytest
from imus import about, product
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from casest.leastsquares.turns import exponential, right_jacobian, rotations, skew


def rate(t):
    return np.array([2 * np.sin(3 * t), 1.5 * np.cos(2 * t) + 0.5, 1 - t])


def turned(n, spans, seconds=2.0):
    t = np.linspace(0, seconds, n)
    w = rate(t).T
    return rotations(w, np.zeros((n, 3, 0)), t, np.array(spans))[0]


def attitude(end):
    def slope(t, c):
        return (c.reshape(3, 3) @ skew(rate(t)[None])[0]).ravel()

    found = solve_ivp(slope, (0, end), np.eye(3).ravel(), rtol=1e-12, atol=1e-12)
    return found.y[:, -1].reshape(3, 3)


def test_the_turn_is_that_of_an_integrator_with_steps_of_its_own():
    errors = [np.abs(turned(n, [(0, n - 1)])[0] - attitude(2.0)).max() for n in (201, 401)]
    assert errors[1] < 4e-6
    # What is left is that a rate is a straight line between two readings: of second order.
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)


def test_a_straight_rate_is_integrated_to_fourth_order():
    def error(n):
        t = np.linspace(0, 1, n)
        w = np.array([1.0, 2, -1]) + t[:, None] * np.array([3.0, -1, 2])

        def slope(s, c):
            now = np.array([1.0, 2, -1]) + s * np.array([3.0, -1, 2])
            return (c.reshape(3, 3) @ skew(now[None])[0]).ravel()

        exact = solve_ivp(slope, (0, 1), np.eye(3).ravel(), rtol=1e-13, atol=1e-13)
        own = rotations(w, np.zeros((n, 3, 0)), t, np.array([(0, n - 1)]))[0][0]
        return np.abs(own - exact.y[:, -1].reshape(3, 3)).max()

    assert error(6) / error(11) == pytest.approx(16, rel=0.15)


def test_a_turn_about_a_fixed_axis_is_exact_however_large_the_steps():
    axis = np.array([1.0, 2, 2]) / 3
    t = np.array([0.0, 0.9, 2.0])
    w = np.repeat(axis[None] * 2.5, 3, axis=0)
    own = rotations(w, np.zeros((3, 3, 0)), t, np.array([(0, 2)]))[0][0]
    assert np.abs(own - Rotation.from_rotvec(5.0 * axis).as_matrix()).max() < 1e-14


def test_turns_follow_each_other_whatever_their_length():
    a, b = turned(301, [(0, 71), (71, 300)])
    assert np.abs(a @ b - turned(301, [(0, 300)])[0]).max() < 1e-13


def test_slopes_are_those_of_finite_differences():
    rng = np.random.default_rng(0)
    t, spans = np.linspace(0, 2, 120), np.array([(0, 50), (50, 119)])
    w, slopes = rate(t).T, rng.normal(size=(120, 3, 4))
    S = rotations(w, slopes, t, spans)[1]
    for j in range(4):
        ahead, behind = (
            rotations(w + e * slopes[:, :, j], slopes[:, :, :0], t, spans)[0] for e in (1e-6, -1e-6)
        )
        moved = Rotation.from_matrix(behind.transpose(0, 2, 1) @ ahead).as_rotvec() / 2e-6
        assert np.abs(moved - S[:, :, j]).max() < 1e-8


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0099, 0.0101, 1.0, 3.1, 6.0])
def test_the_exponential_is_that_of_quaternions(angle):
    axis = np.array([2.0, -1, 2]) / 3
    q = about(axis, np.array([angle]))[0]
    own = exponential(angle * axis[None])[0]
    assert np.abs(own - Rotation.from_quat(np.roll(q, -1)).as_matrix()).max() < 1e-15


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.0099, 0.0101, 1.0, 3.0])
def test_the_right_jacobian_moves_the_rotation_as_it_says(angle):
    axis, d = np.array([2.0, -1, 2]) / 3, 1e-6 * np.array([0.3, -1, 0.7])
    ahead, behind = exponential(np.array([angle * axis + d, angle * axis - d]))
    moved = Rotation.from_matrix(behind.T @ ahead).as_rotvec() / 2
    assert np.abs(moved - right_jacobian(angle * axis[None])[0] @ d).max() < 1e-13


def test_the_simulated_rate_is_that_of_the_simulated_attitude():
    from imus import waved

    motion = waved(np.random.default_rng(1), rests=3, rate=1000.0)
    q = motion.attitude
    step = product(q[:-2] * [1, -1, -1, -1], q[2:])
    seen = 2 * step[:, 1:] / (2e-3 * step[:, :1])
    moving = ~motion.still[1:-1] & ~motion.still[:-2] & ~motion.still[2:]
    assert np.abs(seen - motion.rate[1:-1])[moving].max() < 2e-4
