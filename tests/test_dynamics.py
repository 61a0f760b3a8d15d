"""Estimators in motion against identities, other libraries, and an independent flight."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from scipy.spatial.transform import Rotation

from casest import DataError, DeclarationError, Run, cross, norm_2, signal
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.filter import filtered
from casest.dynamics.gramian import gramian, gramian_by_ode, observed, smallest_eigenvalue
from casest.dynamics.record import least_squares
from casest.dynamics.riccati import riccati
from casest.dynamics.transition import linearised, transitions
from casest.engine import Replay
from casest.results.observability import observe_motion
from casest_problems.bias_gravity import bias_gravity, bias_gravity_position

BIAS = np.array([0.1, -0.05, 0.025])


def turning(kind, t):
    """Angular velocity (N, 3), rad/s."""
    if kind == "all round":
        return np.c_[0.5 * np.sin(0.3 * t), 0.4 * np.cos(0.21 * t), 0.3 * np.sin(0.11 * t + 1)]
    if kind == "one axis":
        return (1 + 0.5 * np.sin(0.2 * t))[:, None] * np.array([0.27, 0.53, 0.80])
    return np.zeros((len(t), 3))


def motionless(omega, t):
    zero = np.zeros((len(t), 3))
    return Run.raw("r", {"a": zero, "omega": omega, "v": zero}, units={}, time=t)


def flight(seconds=40.0, rate=100, seed=0, noisy=True):
    """A body that turns and moves: truth by SciPy's rotations, sensors with Batista's noise.

    Returns the run, gravity in body axes (N, 3) and velocity in body axes.
    """
    t = np.arange(0, seconds, 1 / rate)
    fine = np.arange(-1, 2 * len(t) + 1) / (2 * rate)
    roll, pitch, yaw = 0.5 * np.sin(0.6 * fine), 0.4 * np.cos(0.42 * fine), 0.3 * np.sin(0.2 * fine)
    R = Rotation.from_euler("ZYX", np.c_[yaw, pitch, roll])
    step = (R[:-2].inv() * R[2:]).as_rotvec() * rate  # over two half steps
    omega = step[0::2][: len(t)]
    here = R[1::2][: len(t)].inv()
    speed = np.c_[np.sin(0.4 * t), np.cos(0.3 * t), 0.2 * np.sin(0.2 * t)]
    change = np.c_[0.4 * np.cos(0.4 * t), -0.3 * np.sin(0.3 * t), 0.04 * np.cos(0.2 * t)]
    gravity, v = here.apply([0, 0, 9.80665]), here.apply(speed)
    a = here.apply(change) - gravity + BIAS
    if noisy:
        rng = np.random.default_rng(seed)
        a = a + 0.0013 * rng.standard_normal(a.shape)
        omega = omega + np.radians(0.05) * rng.standard_normal(omega.shape)
        readings = v + 0.01 * rng.standard_normal(v.shape)
    else:
        readings = v
    signals = {"a": a, "omega": omega, "v": readings}
    return Run.raw("flight", signals, units={}, time=t), gravity, v


@dynamics
def cart(
    u=signal("m/s^2"),
    y=signal("m"),
    *,
    position=state("m", intensity=1e-3, std=2.0),
    velocity=state("m/s", intensity=0.02, std=1.0),
):
    """A damped cart on a spring: constant coefficients, stable."""
    rates = {"position": velocity, "velocity": u - 0.8 * velocity - 1.5 * position}
    return Motion(rates=rates, outputs=(measured(y, position, intensity=0.01),))


A, C = np.array([[0, 1.0], [-1.5, -0.8]]), np.array([[1.0, 0]])
XI, THETA = np.diag([1e-3, 0.02]), np.array([[0.01]])


def cart_run(n=400, h=0.05, seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(n) * h
    u, y = np.sin(t), 0.3 * np.sin(0.9 * t) + 0.3 * rng.standard_normal(n)
    return Run.raw("cart", {"u": u[:, None], "y": y[:, None]}, units={}, time=t)


# -- observability -----------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "rank"), [("all round", 9), ("one axis", 8), ("not at all", 6)])
def test_the_rank_is_what_batista_proves(kind, rank):
    t = np.arange(0, 60, 0.02)
    system = linearised(bias_gravity, motionless(turning(kind, t), t))
    assert observed(bias_gravity, gramian(bias_gravity, system)).rank == rank


def test_the_hidden_direction_is_gravity_and_bias_along_the_axis():
    t = np.arange(0, 60, 0.02)
    system = linearised(bias_gravity, motionless(turning("one axis", t), t))
    seen = observed(bias_gravity, gramian(bias_gravity, system))
    (words,) = seen.unobservable
    assert "gravity and bias along the body axis (0.27, 0.53, 0.80) move together" in words
    axis = np.array([0.27, 0.53, 0.80])
    expected = np.concatenate([np.zeros(3), axis, axis]) / (np.linalg.norm(axis) * 2**0.5)
    assert abs(abs(expected @ seen.directions[:, 0]) - 1) < 1e-9


def test_a_reading_that_is_missing_tells_nothing():
    """Half of the velocities: half of the information, but for the stretches' edges."""
    t = np.arange(0, 20, 0.02)
    run = motionless(turning("all round", t), t)
    v = np.zeros((len(t), 3))
    v[: len(t) // 2] = np.nan
    part = Run.raw("r", {**run.signals, "v": v}, units={}, time=t)
    late = run.take(slice(len(t) // 2, None))
    W = gramian(bias_gravity, linearised(bias_gravity, part))
    expected = gramian(bias_gravity, linearised(bias_gravity, late))
    Phi = np.eye(9)
    for step in transitions(linearised(bias_gravity, run))[0][: len(t) // 2]:
        Phi = step @ Phi
    expected = Phi.T @ expected @ Phi
    np.testing.assert_allclose(W, expected, atol=3e-3 * np.abs(expected).max())


def test_readings_at_a_third_of_the_rate_tell_a_third():
    t = np.arange(0, 20, 0.02)
    run = motionless(turning("all round", t), t)
    v = np.zeros((len(t), 3))
    v[np.arange(len(t)) % 3 > 0] = np.nan
    thin = Run.raw("r", {**run.signals, "v": v}, units={}, time=t)
    whole, third = (gramian(bias_gravity, linearised(bias_gravity, r)) for r in (run, thin))
    np.testing.assert_allclose(3 * third, whole, atol=3e-3 * np.abs(whole).max())


def test_with_positions_the_rank_is_full_too():
    t = np.arange(0, 60, 0.02)
    zero, omega = np.zeros((len(t), 3)), turning("all round", t)
    run = Run.raw("r", {"a": zero, "omega": omega, "p": zero}, units={}, time=t)
    model = bias_gravity_position
    assert observed(model, gramian(model, linearised(model, run))).rank == 12


@pytest.mark.parametrize(
    ("seconds", "rate"), [(20, 100), pytest.param(300, 20, marks=pytest.mark.long)]
)
def test_both_forms_of_the_gramian_agree(seconds, rate):
    """Every entry, beside the states' own; at 300 s and 100 Hz: benchmarks/motion.py."""
    t = np.arange(0, seconds, 1 / rate)
    system = linearised(bias_gravity, motionless(turning("all round", t), t))
    product, ode = gramian(bias_gravity, system), gramian_by_ode(bias_gravity, system, 1e-13)
    scale = np.sqrt(np.outer(np.diag(product), np.diag(product)))
    assert np.abs((product - ode) / scale).max() < 1e-8


def test_it_is_said_since_when_a_trajectory_tells_everything():
    """Straight on for 30 s, then it turns about changing axes."""
    t = np.arange(0, 60, 0.05)
    run = motionless(np.where((t > 30)[:, None], 2 * turning("all round", t), 0.0), t)
    windows = observe_motion(bias_gravity.known_to(bias=0.5), run, window=10.0).windows
    assert 30 < windows.informative_from_s < 45
    still = observe_motion(bias_gravity, motionless(turning("not at all", t), t)).windows
    assert still.informative_from_s is None


def test_a_slow_precession_shows_more_in_longer_windows():
    t = np.arange(0, 200, 0.1)
    axis = np.c_[np.cos(0.01 * t), np.sin(0.01 * t), np.zeros_like(t)]
    run = motionless(0.5 * axis, t)
    smallest = [smallest_eigenvalue(bias_gravity, run, w, 5)[1].min() for w in (10, 40, 160)]
    assert smallest[0] < 0.1 * smallest[1] < 0.01 * smallest[2] * 10


def test_the_gramian_of_a_stable_system_is_the_lyapunov_solution_and_python_controls(control):
    t = np.arange(0, 60, 0.02)
    run = Run.raw("cart", {"u": 0 * t[:, None], "y": 0 * t[:, None]}, units={}, time=t)
    W = gramian(cart, linearised(cart, run)) * THETA[0, 0]
    expected = scipy.linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
    np.testing.assert_allclose(W, expected, rtol=1e-8, atol=1e-9)
    system = control.ss(A, np.zeros((2, 1)), C, 0)
    np.testing.assert_allclose(W, control.gram(system, "o"), rtol=1e-8, atol=1e-9)


# -- transitions, Riccati ----------------------------------------------------------------------


def test_transitions_of_constant_coefficients_are_scipys_exponential():
    Phi, _ = transitions(linearised(cart, cart_run()))
    np.testing.assert_allclose(Phi[7], scipy.linalg.expm(A * 0.05), rtol=1e-13, atol=1e-15)


def test_without_process_noise_the_covariance_is_the_information_carried_forward():
    """P = Φ(P₀⁻¹ + W)⁻¹Φᵀ."""
    quiet = bias_gravity.driven(velocity=0.0, gravity=0.0, bias=0.0)
    t = np.arange(0, 20, 0.01)
    system = linearised(quiet, motionless(turning("all round", t), t))
    W, P = gramian(quiet, system), riccati(quiet, system)[-1]
    Phi = np.eye(9)
    for step in transitions(system)[0]:
        Phi = step @ Phi
    expected = Phi @ np.linalg.inv(np.linalg.inv(quiet.start_covariance) + W) @ Phi.T
    assert np.abs(P - expected).max() < 1e-8 * np.abs(expected).max()


def test_the_riccati_equation_settles_where_scipy_and_python_control_say(control):
    t = np.arange(0, 40, 0.05)
    run = Run.raw("cart", {"u": 0 * t[:, None], "y": 0 * t[:, None]}, units={}, time=t)
    P = riccati(cart, linearised(cart, run))[-1]
    np.testing.assert_allclose(P, scipy.linalg.solve_continuous_are(A.T, C.T, XI, THETA), rtol=1e-8)
    _, by_control, _ = control.lqe(A, np.eye(2), C, XI, THETA)
    np.testing.assert_allclose(P, by_control, rtol=1e-8)


@pytest.mark.parametrize("theta", [1e-4, pytest.param(1e-8, marks=pytest.mark.long)])
def test_a_stiff_riccati_equation_is_solved_as_an_implicit_integrator_does(theta):
    """Readings so good that the variance falls a million times within the first step."""

    @dynamics
    def stiff(
        u=signal("m/s^2"),
        y=signal("m"),
        *,
        position=state("m", intensity=1e-3, std=100.0),
        velocity=state("m/s", intensity=0.02, std=10.0),
    ):
        rates = {"position": velocity, "velocity": u - 0.8 * velocity - 1.5 * position}
        return Motion(rates=rates, outputs=(measured(y, position, intensity=theta),))

    def rate(_, z):
        P = np.array([[z[0], z[1]], [z[1], z[2]]])
        slope = A @ P + P @ A.T + XI - P @ C.T @ C @ P / theta
        return slope[[0, 0, 1], [0, 1, 1]]

    run = cart_run(100)
    found = riccati(stiff, linearised(stiff, run))
    expected = scipy.integrate.solve_ivp(
        rate, (0, run.time[-1]), [1e4, 0.0, 100.0], "Radau", run.time, rtol=1e-8, atol=1e-16
    ).y.T  # fmt: skip
    np.testing.assert_allclose(found[1:, [0, 0, 1], [0, 1, 1]], expected[1:], rtol=1e-5)
    settled = scipy.linalg.solve_continuous_are(A.T, C.T, XI, [[theta]])
    np.testing.assert_allclose(found[-1], settled, rtol=1e-3)


def test_a_stiff_riccati_equation_of_nine_states_stays_positive():
    """Measurement intensity 1e-6 against process 1e-3."""
    model = bias_gravity.driven(velocity=1e-3, gravity=1e-4, bias=1e-5).sensing(v=1e-6)
    t = np.arange(0, 20, 0.01)
    P = riccati(model, linearised(model, motionless(turning("all round", t), t)))
    assert np.all(np.isfinite(P))
    assert np.linalg.eigvalsh(P[1:]).min() > 0
    # Where the velocity is read so well its variance settles at √(ΞΘ) of a walk, or above.
    assert np.all(P[-1, range(3), range(3)] > np.sqrt(1e-3 * 1e-6))
    assert np.all(P[-1, range(3), range(3)] < 1.5 * np.sqrt(1e-3 * 1e-6))


# -- filter and smoother -----------------------------------------------------------------------


def by_normal_equations(model, run):
    """All states of a linear record at once, by dense normal equations."""
    from casest.dynamics.transition import process_noise

    system = linearised(model, run)
    Phi, forced = transitions(system)
    Q = process_noise(system, model.process)
    N, n = len(system.time), model.size
    H, g = np.zeros((N * n, N * n)), np.zeros(N * n)
    start = np.linalg.inv(model.start_covariance)
    H[:n, :n] += start
    g[:n] += start @ model.start
    for k in range(N - 1):
        rows = slice(k * n, (k + 2) * n)
        J = np.hstack([-Phi[k], np.eye(n)])
        weight = np.linalg.inv(Q[k])
        H[rows, rows] += J.T @ weight @ J
        g[rows] += J.T @ weight @ forced[k]
    for k, dt in enumerate(np.full(N, 0.05)):
        rows = slice(k * n, (k + 1) * n)
        weight = np.linalg.inv(model.noise / dt)
        H[rows, rows] += system.C[k].T @ weight @ system.C[k]
        g[rows] += system.C[k].T @ weight @ (system.y[k] - system.d[k])
    x = np.linalg.solve(H, g).reshape(N, n)
    return x, np.linalg.inv(H)[-n:, -n:]


@pytest.mark.parametrize("work", [filtered, least_squares])
def test_the_engine_evaluates_rates_outputs_and_their_slopes(work, monkeypatch):
    """Over all samples at once, from the replayed instructions; and the motion between samples, of
    a nonlinear model with its Jacobian."""
    run, seen = flight(2.0)[0], []
    replayed = Replay.__call__

    def counted(self, parameters, samples):
        seen.append(len(samples))
        return replayed(self, parameters, samples)

    monkeypatch.setattr(Replay, "__call__", counted)
    monkeypatch.setenv("CASEST_KERNEL", "off")
    for model in (bias_gravity, turning_gravity):
        seen.clear()
        work(model, run)
        assert seen
        assert set(seen) <= {len(run), len(run) - 1}


@dynamics
def turning_gravity(
    omega=signal(3, "rad/s"), a=signal(3, "m/s^2"), *, g=state(3, "m/s^2", start=(0.0, 0.0, 9.8))
):
    """Gravity from the direction of the accelerometer alone: nonlinear."""
    predicted = -9.8 * g / norm_2(g)
    return Motion(rates={"g": -cross(omega, g)}, outputs=(measured(a, predicted, intensity=0.1),))


def test_filter_smoother_and_least_squares_are_one_estimate():
    run = cart_run(200)
    found, (x, P) = filtered(cart, run), by_normal_equations(cart, run)
    np.testing.assert_allclose(found.smoothed, x, atol=1e-8)
    np.testing.assert_allclose(found.x[-1], x[-1], atol=1e-8)
    np.testing.assert_allclose(found.P[-1], P, rtol=1e-8)


@pytest.mark.parametrize("kind", ["published", "undriven", "matched", "irregular"])
def test_the_whole_record_at_once_is_the_filters_end(kind):
    """Sparse augmented equations: no filter, no inverse of what may be singular."""
    run, _, _ = flight(10)
    model = bias_gravity
    if kind != "published":
        model = model.driven(velocity=0.0, gravity=0.0, bias=0.0)
    if kind == "matched":
        model = model.sensing(a=1.7e-8, omega=7.6e-9, v=1e-6)
    if kind == "irregular":
        kept = np.sort(np.random.default_rng(0).choice(len(run), 600, replace=False))
        run = run.take(kept)
        run.signals["v"][100:150] = np.nan
    at_once, found = least_squares(model, run), filtered(model, run)
    # Noise of inputs acts along the states, of which the filter knew less at the time.
    x, P = (found.smoothed, found.smoothed_P) if kind == "matched" else (found.x, found.P)
    np.testing.assert_allclose(found.x[-1], x[-1], atol=0.05 * found.std[-1].min())
    np.testing.assert_allclose(at_once.x[-1], x[-1], atol=1e-8)
    np.testing.assert_allclose(at_once.x, found.smoothed, atol=1e-8)
    size = np.abs(P[-1]).max()
    np.testing.assert_allclose(at_once.P_end, P[-1], atol=1e-8 * size)
    size = np.abs(found.smoothed_P[0]).max()
    np.testing.assert_allclose(at_once.P_start, found.smoothed_P[0], atol=1e-8 * size)


def test_missing_readings_say_nothing_and_do_no_harm():
    run, gravity, _ = flight()
    v = run.signals["v"].copy()
    v[1000:1500] = np.nan
    v[2000, 1] = np.nan
    holed = Run.raw("r", {**run.signals, "v": v}, units={}, time=run.time)
    found = filtered(bias_gravity, holed)
    assert np.all(np.isfinite(found.x))
    assert np.isnan(found.innovations[1200]).all()
    assert np.isfinite(found.innovations[2000, [0, 2]]).all()
    assert np.abs(found.x[-1, 3:6] - gravity[-1]).max() < 0.05


def test_the_filter_finds_gravity_and_bias_from_far_away():
    run, gravity, v = flight(noisy=False)
    far = bias_gravity.beginning(gravity=(5.0, 5.0, -5.0), bias=(1.0, 1.0, -1.0)).known_to(bias=2)
    found = filtered(far, run)
    assert np.abs(found.x[-1, :3] - v[-1]).max() < 0.01
    assert np.abs(found.x[-1, 3:6] - gravity[-1]).max() < 0.01
    assert np.abs(found.x[-1, 6:] - BIAS).max() < 0.01


# -- bad input ---------------------------------------------------------------------------------


def test_time_that_goes_backwards_is_named():
    run = cart_run(50)
    time = run.time.copy()
    time[20] = time[10]
    with pytest.raises(DataError, match="row 20: time goes backwards"):
        filtered(cart, Run.raw("r", run.signals, units={}, time=time))


def test_a_missing_input_is_refused_and_counted():
    run, _, _ = flight(5)
    omega = run.signals["omega"].copy()
    omega[100:110] = np.nan
    with pytest.raises(DataError, match="input omega is missing in 10 of 500 rows, first in row"):
        filtered(
            bias_gravity, Run.raw("r", {**run.signals, "omega": omega}, units={}, time=run.time)
        )


def test_a_reading_without_noise_is_refused():
    with pytest.raises(DeclarationError, match="must be positive, not 0"):
        measured(None, None, intensity=0)


def test_a_start_that_is_no_covariance_is_refused():
    with pytest.raises(DataError, match="not positive"):
        riccati(cart, linearised(cart, cart_run()), np.diag([1.0, -1.0]))
