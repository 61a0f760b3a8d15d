"""The filters against textbook loops, the moments' own equations, and the bound they answer to."""

from __future__ import annotations

import flights
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from casest import Run, UsageError, signal, sin
from casest.dynamics import (
    Motion,
    Steps,
    dynamics,
    filtered,
    kalman,
    kalman_bucy,
    least_squares,
    measured,
    smoothed,
    state,
)
from casest.dynamics.gramian import gramian, observed
from casest.dynamics.transition import linearised, transitions
from casest_problems.bias_gravity import bias_gravity

T = np.arange(0, 20, 0.02)


def random_steps(N=60, n=4, m=2, seed=0):
    """A discrete system whose matrices change at every step, some readings missing."""
    rng = np.random.default_rng(seed)
    Phi = np.eye(n) + 0.1 * rng.standard_normal((N - 1, n, n))
    half = 0.3 * rng.standard_normal((N - 1, n, n))
    C, R = rng.standard_normal((N, m, n)), rng.uniform(0.5, 2.0, (N, m))
    y = rng.standard_normal((N, m))
    y[10:15], y[20, 1] = np.nan, np.nan
    forced, d = rng.standard_normal((N - 1, n)), rng.standard_normal((N, m))
    return Steps(Phi, forced, half @ half.transpose(0, 2, 1), C, d, R, y)


def textbook(s, x, P):
    """Kalman's filter and Rauch, Tung & Striebel's smoother, sample by sample."""
    x, P, found = np.array(x), np.array(P), []
    for k in range(len(s.C)):
        if k:
            x, P = (
                s.Phi[k - 1] @ x + s.forced[k - 1],
                s.Phi[k - 1] @ P @ s.Phi[k - 1].T + s.Q[k - 1],
            )
        before = x, P
        there = np.isfinite(s.y[k])
        if there.any():
            C, R = s.C[k][there], np.diag(s.R[k][there])
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
            x = x + K @ (s.y[k][there] - s.d[k][there] - C @ x)
            left = np.eye(len(x)) - K @ C
            P = left @ P @ left.T + K @ R @ K.T
        found.append((x, P, *before))
    smooth = [(x, P)]
    for k in range(len(s.C) - 2, -1, -1):
        G = found[k][1] @ s.Phi[k].T @ np.linalg.inv(found[k + 1][3])
        later_x, later_P = smooth[0]
        smooth.insert(0, (found[k][0] + G @ (later_x - found[k + 1][2]),
                          found[k][1] + G @ (later_P - found[k + 1][3]) @ G.T))  # fmt: skip
    return found, smooth


def test_the_discrete_filter_and_smoother_are_the_textbooks():
    steps = random_steps()
    expected, smooth = textbook(steps, np.ones(4), 4 * np.eye(4))
    found = kalman(steps, np.ones(4), 4 * np.eye(4))
    x, P = smoothed(steps, found)
    for k, (own, own_smooth) in enumerate(zip(expected, smooth, strict=True)):
        ours = (found.x[k], found.P[k], found.predicted_x[k], found.predicted_P[k], x[k], P[k])
        for mine, theirs in zip(ours, (*own, *own_smooth), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-10)


def test_between_irregular_samples_the_moments_follow_their_differential_equations():
    """Continuous-discrete filter: x' = Ax + Bu, P' = AP + PA' + Ξ by DOP853."""
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.01, 0.04, 60))
    flight = flights.in_the_air()
    run = flights.record(flight, t, rng)
    system = linearised(bias_gravity, run)
    x, P = bias_gravity.start, bias_gravity.start_covariance
    C = np.eye(3, 9)

    def rate(time, z, k):
        share = (time - t[k]) / (t[k + 1] - t[k])
        A = system.A[k] + share * (system.A[k + 1] - system.A[k])
        c = system.c[k] + share * (system.c[k + 1] - system.c[k])
        P = z[9:].reshape(9, 9)
        return np.r_[A @ z[:9] + c, (A @ P + P @ A.T + bias_gravity.process).ravel()]

    for k in range(len(t)):
        if k:
            z, span = np.r_[x, P.ravel()], (t[k - 1], t[k])
            z = solve_ivp(rate, span, z, "DOP853", rtol=1e-11, atol=1e-13, args=(k - 1,)).y[:, -1]
            x, P = z[:9], z[9:].reshape(9, 9)
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + bias_gravity.noise / np.diff(t).mean())
        x, P = x + K @ (run.signals["v"][k] - C @ x), P - K @ C @ P
    found = filtered(bias_gravity, run)
    np.testing.assert_allclose(found.x[-1], x, atol=1e-7)
    np.testing.assert_allclose(found.P[-1], P, atol=1e-7)


def test_inputs_between_samples_are_straight_lines():
    """Holding the accelerometer over a sample would put the velocity off by ½·dt·(change of a)."""
    t, flight = np.arange(0, 10.005, 0.01), flights.in_the_air()
    run = flights.record(flight, t, sensors=flights.Sensors(bias=(0.0, 0.0, 0.0)))
    Phi, forced = transitions(linearised(bias_gravity, run))
    x = np.r_[flight.velocity(t[:1])[0], flight.gravity(t[:1])[0], 0, 0, 0]
    for step, added in zip(Phi, forced, strict=True):
        x = step @ x + added
    error = np.abs(x[:3] - flight.velocity(t[-1:])[0]).max()
    change = np.abs(run.signals["a"][-1] - run.signals["a"][0]).max()
    assert error < 0.02 * 0.5 * 0.01 * change
    np.testing.assert_allclose(x[3:6], flight.gravity(t[-1:])[0], atol=1e-4)


def test_what_the_data_allow_is_what_least_squares_reaches_without_prior_knowledge():
    """Information form against the covariance of the whole record's augmented equations."""
    run = flights.record(flights.in_the_air(), T, np.random.default_rng(0))
    silent = bias_gravity.driven(velocity=0.0, gravity=0.0, bias=0.0)
    vague = silent.known_to(velocity=1e4, gravity=1e4, bias=1e4)
    std = observed(silent, gramian(silent, linearised(silent, run))).std
    reached = np.sqrt(np.diag(least_squares(vague, run).P_start))
    np.testing.assert_allclose(std, reached, rtol=0.02)  # an integral against a sum of samples


@pytest.mark.parametrize("count", [2, 3, 5, 16, 17, 501])
def test_a_smoothed_record_of_any_length_ends_where_the_filter_does(count):
    run = flights.record(flights.in_the_air(), T[:count], np.random.default_rng(1))
    found = filtered(bias_gravity, run)
    np.testing.assert_array_equal(found.smoothed[-1], found.x[-1])
    at_once = least_squares(bias_gravity, run)
    np.testing.assert_allclose(found.smoothed, at_once.x, atol=1e-8)


def test_a_tenth_of_the_readings_says_a_tenth():
    """Without driving noise information adds up: that at the end is a tenth in every direction."""
    full = flights.record(flights.in_the_air(), T, np.random.default_rng(1))
    v = full.signals["v"].copy()
    v[np.arange(len(v)) % 10 > 0] = np.nan
    thin = Run.raw("thin", {**full.signals, "v": v}, units={}, time=T)
    quiet = bias_gravity.driven(velocity=0.0, gravity=0.0, bias=0.0)
    quiet = quiet.known_to(velocity=1e3, gravity=1e4, bias=1e4)
    whole, tenth = (np.linalg.inv(filtered(quiet, run).P[-1]) for run in (full, thin))
    root = np.linalg.inv(np.linalg.cholesky(whole))
    shares = np.linalg.eigvalsh(root @ tenth @ root.T)
    assert np.all(np.abs(shares - 0.1) < 0.01)


# -- Kalman and Bucy's -----------------------------------------------------------------------------


@dynamics
def cart(
    u=signal("m/s^2"),
    y=signal("m"),
    *,
    position=state("m", intensity=1e-3, std=0.3),
    velocity=state("m/s", intensity=0.02, std=0.2),
):
    rates = {"position": velocity, "velocity": u - 0.8 * velocity - 1.5 * position}
    return Motion(rates=rates, outputs=(measured(y, position, intensity=0.01),))


def readings(seconds, step):
    t = np.arange(0, seconds, step)
    signals = {"u": np.sin(t)[:, None], "y": 0.3 * np.sin(0.9 * t)[:, None] + 0.1}
    return Run.raw("cart", signals, units={}, time=t)


def test_the_kalman_bucy_filter_follows_its_differential_equations():
    run = readings(5, 0.01)
    A, C, Xi = np.array([[0, 1], [-1.5, -0.8]]), np.array([[1.0, 0]]), np.diag([1e-3, 0.02])

    def rate(t, z):
        x, P = z[:2], z[2:].reshape(2, 2)
        K = P @ C.T / 0.01
        u, y = (np.interp(t, run.time, run.signals[n][:, 0]) for n in "uy")
        slope = A @ x + [0, u] + K[:, 0] * (y - x[0])
        return np.r_[slope, (A @ P + P @ A.T + Xi - K @ C @ P).ravel()]

    start = np.r_[0, 0, np.diag([0.09, 0.04]).ravel()]
    end = solve_ivp(rate, (0, run.time[-1]), start, max_step=0.01, rtol=1e-9, atol=1e-11).y[:, -1]
    found = kalman_bucy(cart, run)
    np.testing.assert_allclose(found.x[-1], end[:2], atol=1e-6)
    np.testing.assert_allclose(found.P[-1].ravel(), end[2:], atol=1e-8)


def test_its_gain_settles_where_python_control_says(control):
    L, _, _ = control.lqe(
        [[0, 1], [-1.5, -0.8]], np.eye(2), [[1, 0]], np.diag([1e-3, 0.02]), [[0.01]]
    )
    found = kalman_bucy(cart, readings(40, 0.05))
    np.testing.assert_allclose(found.K[-1], L, rtol=1e-8)


def test_the_faster_the_samples_the_nearer_the_discrete_filter_comes():
    apart = []
    for step in (0.04, 0.02, 0.01):
        run = readings(4, step)
        apart.append(np.abs(kalman_bucy(cart, run).x[-1] - filtered(cart, run).x[-1]).max())
    assert apart[2] < 0.6 * apart[1] < 0.36 * apart[0]


def test_it_bridges_what_is_missing_and_refuses_what_is_not_linear():
    run = readings(4, 0.02)
    run.signals["y"][60:90] = np.nan
    found = kalman_bucy(cart, run)
    assert np.isfinite(found.x).all()
    assert np.all(found.K[65] == 0)
    pendulum = dynamics(lambda y=signal("rad"), *, angle=state("rad"): Motion(
        rates={"angle": -sin(angle)}, outputs=(measured(y, angle, intensity=1.0),)))  # fmt: skip
    with pytest.raises(UsageError, match="is nonlinear: the Kalman-Bucy filter is for linear"):
        kalman_bucy(pendulum, run)
