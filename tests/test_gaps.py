"""Motion across gaps, noise that changes along it, and a smoother that does not settle.

Against moments by SciPy's integrator, dense least squares and simulated motions.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import quad_vec, solve_ivp
from test_dynamics import flight
from test_extended import DAMPING, G_OVER_L, THETA, XI, pendulum_of, swing, swung

from casest import Run, cross, norm_2, signal
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.extended import extended, relinearised
from casest.dynamics.filter import filtered, trajectory
from casest.dynamics.gramian import gramian, gramian_by_ode
from casest.dynamics.record import least_squares
from casest.dynamics.transition import linearised, process_noise
from casest_problems.bias_gravity import bias_gravity

STEP = 0.05


@dynamics
def cart(
    u=signal("m/s^2"),
    y=signal("m"),
    *,
    position=state("m", intensity=1e-3, std=2.0),
    velocity=state("m/s", intensity=0.02, std=1.5),
    zero=state("m", std=0.4),
):
    """A cart whose drive is measured; the scale that reads its place has a zero of its own."""
    rates = {"position": velocity, "velocity": u - 0.8 * velocity - 1.5 * position}
    return Motion(rates=rates, outputs=(measured(y, position + zero, intensity=0.01),))


def interrupted(run, first, last):
    """The run without the samples from first to last."""
    return run.take(np.r_[0:first, last : len(run)])


def cart_run(n=160, seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(n) * STEP
    y = 0.3 * np.sin(0.9 * t) + 0.2 + 0.3 * rng.standard_normal(n)
    return Run.raw("cart", {"u": np.sin(t)[:, None], "y": y[:, None]}, units={}, time=t)


# -- gaps ------------------------------------------------------------------------------------------


def test_of_a_linear_model_the_extended_filter_crosses_a_gap_as_kalmans_does():
    """Two ways of one estimate: symbols of one step, and matrices of all.

    Between samples one has Runge and Kutta's rule and the other Magnus', which differ in the gap.
    """
    run = interrupted(cart_run(), 70, 77)
    by_steps, found = extended(cart, run), filtered(cart, run)
    assert np.max(np.diff(run.time)) > 7 * STEP
    by_matrices = (
        found.x,
        found.P,
        found.predicted_x,
        found.predicted_P,
        found.innovations,
        found.S,
    )
    size = found.predicted_P[70].max()
    assert size > 4  # the gap has made it large
    for ours, theirs in zip(by_steps, by_matrices, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * size)


@pytest.mark.parametrize("gap", [(70, 77), (151, 159), (1, 8)])
def test_filter_smoother_and_least_squares_agree_across_a_gap(gap):
    """The extended ones on a linear model: at the end they know the same, before it the smoother
    knows what all states at once tell, by sparse equations."""
    run = interrupted(cart_run(), *gap)
    x, P = extended(cart, run)[:2]
    along, smooth, settled = trajectory(cart, run, x)
    at_once = least_squares(cart, run)
    assert settled
    np.testing.assert_allclose(along[-1], x[-1], atol=1e-7)
    np.testing.assert_allclose(smooth[-1], P[-1], atol=1e-7)
    std = np.sqrt(np.diagonal(smooth, axis1=1, axis2=2))
    assert np.max(np.abs(along - at_once.x) / std) < 1e-3
    np.testing.assert_allclose(smooth[0], at_once.P_start, atol=1e-3 * smooth[0].max())


def test_a_nonlinear_smoother_is_the_least_squares_across_a_gap():
    model, run = pendulum_of(), interrupted(swing(seconds=4.0)[0], 40, 55)
    found = filtered(model, run)
    assert found.settled
    at_once = least_squares(model, run)
    std = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))
    assert np.max(np.abs(found.smoothed - at_once.x) / std) < 1e-3
    np.testing.assert_allclose(found.smoothed_P[0], at_once.P_start, rtol=1e-3, atol=1e-9)


def test_the_extended_filter_crosses_a_gap_as_its_moments_do():
    """In a gap what is driven is as little known as in the beginning, before it and after it."""
    model, run = pendulum_of(), interrupted(swing(seconds=2.5)[0], 30, 42)
    t, u, y = run.time, run.signals["torque"][:, 0], run.signals["y"][:, 0]
    step = np.diff(t)
    usual = np.minimum(step, np.median(step))  # a reading stands for its own period
    period = np.r_[usual[0], 0.5 * (usual[1:] + usual[:-1]), usual[-1]]

    def rate(time, z):
        P, (angle, speed) = z[2:].reshape(2, 2), z[:2]
        A = np.array([[0, 1], [-G_OVER_L * np.cos(angle), -DAMPING]])
        slope = np.interp(time, t, u) - G_OVER_L * np.sin(angle) - DAMPING * speed
        return np.r_[speed, slope, (A @ P + P @ A.T + XI).ravel()]

    x, P = model.start, model.start_covariance
    found = filtered(model, run, smooth=False)
    for k in range(len(t)):
        if k:
            lost = np.diag([0.3**2, 0.5**2]) if step[k - 1] > 0.2 else np.zeros((2, 2))
            z = solve_ivp(
                rate, (t[k - 1], t[k]), np.r_[x, (P + lost).ravel()], "DOP853",
                rtol=1e-11, atol=1e-14,
            ).y  # fmt: skip
            x, P = z[:2, -1], z[2:, -1].reshape(2, 2) + lost
        K = P[:, 0] / (P[0, 0] + THETA / period[k])
        x, P = x + K * (y[k] - x[0]), P - np.outer(K, P[0])
        # 0.5 s in one step of Runge and Kutta's: some percent of a standard deviation
        assert np.all(np.abs(found.x[k] - x) < 0.1 * np.sqrt(np.diag(P)))
        np.testing.assert_allclose(found.P[k], P, atol=0.05 * P.max())
    assert np.sum(step > 0.2) == 1


def test_whatever_an_input_did_in_a_gap_the_errors_after_it_are_as_claimed():
    """A torque that nobody recorded throws the pendulum; 30 of them."""
    model, squares, careless = pendulum_of().driven(angle=0.0, rate=0.0), [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        t = np.arange(0, 4, 0.04)
        torque = 2 * np.sin(1.3 * t)
        torque[41:54] += 0.8 * rng.standard_normal()
        truth = swung([0.9, -0.4], t, torque, parts=4)
        y = truth[:, 0] + np.sqrt(THETA / 0.04) * rng.standard_normal(len(t))
        whole = Run.raw("r", {"torque": torque[:, None], "y": y[:, None]}, units={}, time=t)
        run = interrupted(whole, 41, 54)
        found = filtered(model, run, smooth=False)
        error, P = found.x[41] - truth[54], found.P[41]
        squares.append(error @ np.linalg.solve(P, error))
        careless.append(np.abs(found.predicted_x[41] - truth[54])[0])
    assert np.mean(careless) > 4 * found.std[40, 0]  # as far as it was known before
    assert np.mean(squares) < 3.2  # χ² of 60 over 30: 99.9 % below 3.2; claims are cautious


def test_states_that_inputs_drive_through_others_are_lost_in_a_gap_and_constants_are_not():
    found = filtered(cart, interrupted(cart_run(), 70, 110), smooth=False)
    before, after = found.std[69], np.sqrt(np.diag(found.predicted_P[70]))
    assert before[0] < 0.5
    assert after[0] >= 2.0
    assert after[1] >= 1.5
    assert after[2] == pytest.approx(before[2], rel=1e-12)


@dynamics
def resting(y=signal("m"), *, place=state("m", std=1e6)):
    return Motion(rates={"place": 0 * place}, outputs=(measured(y, place, intensity=0.04),))


def test_a_reading_stands_for_its_own_time_and_for_none_of_a_gap():
    """Of a constant the variance is that of a mean, and what the Gramian tells its inverse."""
    n, rng = 100, np.random.default_rng(0)
    t = np.arange(n) * STEP
    t[60:] += 30.0
    y = 0.3 + rng.standard_normal((n, 1))
    run = Run.raw("r", {"y": y}, units={}, time=t)
    found = filtered(resting, run)
    expected = 0.04 / STEP / n
    assert found.P[-1, 0, 0] == pytest.approx(expected, rel=1e-3)
    assert found.x[-1, 0] == pytest.approx(y.mean(), abs=1e-6)
    system = linearised(resting, run)
    # The integral over 99 steps and one of the usual length for the gap; readings are 100.
    for W in (gramian(resting, system), gramian_by_ode(resting, system)):
        assert W[0, 0] == pytest.approx(99 * STEP / 0.04, rel=1e-9)


def test_readings_of_several_components_are_taken_one_after_the_other_as_all_at_once():
    """Three velocities that share a lot: by steps, by matrices, and by the textbook's gain."""
    run = flight(4.0)[0]
    x, P, before_x, before_P, innovations, S = extended(bias_gravity, run)
    found = filtered(bias_gravity, run)
    std = found.std
    assert np.max(np.abs(x - found.x) / std) < 1e-4
    np.testing.assert_allclose(P[-1], found.P[-1], atol=1e-6 * P[-1].max())
    C = np.hstack([np.eye(3), np.zeros((3, 6))])
    K = before_P @ C.T @ np.linalg.inv(S)
    taken = before_x + np.einsum("kij,kj->ki", K, innovations)
    assert np.max(np.abs(x - taken) / std) < 1e-6


# -- noise along the motion ------------------------------------------------------------------------


def test_noise_that_changes_along_a_step_is_integrated_along_it():
    """∫ΦΞ(s)Φᵀds by SciPy's quadrature: Ξ a straight line between samples, full matrices."""
    run, rng = cart_run(8), np.random.default_rng(1)
    system = linearised(cart, run)
    root = rng.standard_normal((8, 3, 3))
    Xi = root @ root.transpose(0, 2, 1)
    Q = process_noise(system, Xi)
    for k in range(7):
        A = system.A[k]

        def integrand(s, A=A, k=k):
            Phi = scipy.linalg.expm(A * (STEP - s))
            return Phi @ (Xi[k] + s / STEP * (Xi[k + 1] - Xi[k])) @ Phi.T

        expected = quad_vec(integrand, 0, STEP, epsrel=1e-12)[0]
        np.testing.assert_allclose(Q[k], expected, atol=1e-12 * np.abs(expected).max())


@dynamics
def turning(
    omega=signal(3, "rad/s"), a=signal(3, "m/s^2"), *, g=state(3, "m/s^2", start=(0.0, 3.0, 9.0))
):
    predicted = -9.8 * g / norm_2(g)
    return Motion(rates={"g": -cross(omega, g)}, outputs=(measured(a, predicted, intensity=0.1),))


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def test_noise_of_an_input_follows_the_state_along_a_step():
    """A gyro's noise reaches gravity as S(g)QS(g)ᵀ, and g turns by half a radian in the step."""
    n, h = 6, 0.1
    t = np.arange(n) * h
    rng = np.random.default_rng(2)
    omega = np.array([4.0, 2.0, -1.0]) + rng.standard_normal((n, 3))
    run = Run.raw("r", {"omega": omega, "a": np.zeros((n, 3))}, units={}, time=t)
    model = turning.sensing(omega=1e-3)
    intensity = np.asarray(model.process)
    along = rng.standard_normal((n, 3)) + np.array([0.0, 3.0, 9.0])
    Q = relinearised(model, run, along).Q
    for k in range(n - 1):

        def rate(s, z, k=k):
            w = omega[k] + s / h * (omega[k + 1] - omega[k])
            A, P, S = -skew(w), z[3:].reshape(3, 3), skew(z[:3])
            Xi = 1e-3 * S @ S.T + intensity
            return np.r_[A @ z[:3], (A @ P + P @ A.T + Xi).ravel()]

        z = solve_ivp(rate, (0, h), np.r_[along[k], np.zeros(9)], rtol=1e-10, atol=1e-14).y
        expected = z[3:, -1].reshape(3, 3)
        np.testing.assert_allclose(Q[k], expected, atol=1e-3 * np.abs(expected).max())


def test_innovations_are_as_large_as_they_are_said_to_be():
    """Motions simulated exactly: Van Loan's covariance, 4000 readings that are means of a step."""
    A = np.array([[0, 1.0], [-1.5, -0.8]])
    block = scipy.linalg.expm(
        STEP * np.block([[-A, np.diag([1e-3, 0.02])], [np.zeros((2, 2)), A.T]])
    )
    Phi = block[2:, 2:].T
    root = np.linalg.cholesky(Phi @ block[:2, 2:])
    rng, n = np.random.default_rng(3), 4000
    x, path = np.array([2.0, 1.5]) * rng.standard_normal(2), []
    for _ in range(n):
        path.append(x)
        x = Phi @ x + root @ rng.standard_normal(2)
    y = np.array(path)[:, :1] + 0.1 + np.sqrt(0.01 / STEP) * rng.standard_normal((n, 1))
    run = Run.raw("r", {"u": np.zeros((n, 1)), "y": y}, units={}, time=np.arange(n) * STEP)
    found = filtered(cart, run)
    assert 0.93 < found.normalised_innovations.mean() < 1.07  # three of its 0.022
    error = (found.smoothed[:, :2] - np.array(path))[50:-50]
    std = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))[50:-50, :2]
    # 200 s of memory of about one: the mean square's own spread is 0.1
    assert np.all(np.abs(np.mean((error / std) ** 2, axis=0) - 1) < 0.3)


# -- a smoother that does not settle ---------------------------------------------------------------


def test_where_rounds_do_not_settle_the_first_ones_states_are_given(monkeypatch):
    """Dense least squares of the record linearised once, along the filter's own states."""
    model, run = pendulum_of(), swing(seconds=2.0)[0]
    start = extended(model, run)[0]
    right = trajectory(model, run, start)
    assert right[2]
    monkeypatch.setattr("casest.dynamics.filter.ROUNDS", 3)
    monkeypatch.setattr("casest.dynamics.filter.SETTLED", 0.0)
    x, P, settled = trajectory(model, run, start)
    assert not settled
    steps, N = relinearised(model, run, start), len(run)
    rows = [np.zeros((2, 2 * N)) for _ in range(N)]
    left = [np.zeros(2) for _ in range(N)]
    root = np.linalg.cholesky(np.linalg.inv(model.start_covariance)).T
    rows[0][:, :2], left[0] = root, root @ model.start
    for k in range(N - 1):
        root = np.linalg.cholesky(np.linalg.inv(steps.Q[k])).T
        rows[k + 1][:, 2 * k : 2 * k + 4] = root @ np.hstack([-steps.Phi[k], np.eye(2)])
        left[k + 1] = root @ steps.forced[k]
    seen = np.zeros((N, 2 * N))
    for k in range(N):
        seen[k, 2 * k : 2 * k + 2] = steps.C[k, 0] / np.sqrt(steps.R[k, 0])
    H = np.vstack([*rows, seen])
    z = np.concatenate([*left, ((steps.y - steps.d) / np.sqrt(steps.R))[:, 0]])
    expected = np.linalg.lstsq(H, z, rcond=None)[0].reshape(N, 2)
    np.testing.assert_allclose(x, expected, atol=1e-6)
    spread = np.linalg.inv(H.T @ H)
    np.testing.assert_allclose(P[N // 2], spread[N : N + 2, N : N + 2], rtol=1e-4, atol=1e-9)
    # Which is not where the rounds would have ended.
    assert np.abs(x - right[0]).max() > 1e-4
