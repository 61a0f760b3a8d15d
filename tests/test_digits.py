"""Variances against the same algebra in 60 decimal digits, over twelve decades of what is known."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casest import DataError, Run, signal, sin
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
from casest.dynamics.filter import discretised
from casest.dynamics.likelihood import likelihood, prepared
from casest.dynamics.riccati import riccati
from casest.dynamics.transition import Linearised, linearised, process_noise, transitions

DIGITS = 60


def exact(array):
    """Floats as decimal numbers, digit by digit."""
    return np.vectorize(Decimal, otypes=[object])(np.asarray(array, float))


def solved(M, right):
    """M⁻¹·right of decimal numbers, by Gauss's elimination with pivots."""
    both, n = np.hstack([M, right]), len(M)
    for k in range(n):
        best = max(range(k, n), key=lambda i: abs(both[i, k]))
        both[[k, best]] = both[[best, k]]
        both[k] = both[k] / both[k, k]
        for i in set(range(n)) - {k}:
            both[i] = both[i] - both[i, k] * both[k]
    return both[:, n:]


def in_digits(steps, start, covariance):
    """Filtered and smoothed states and covariances, sample by sample, by the textbook."""
    Phi, u, Q, C, R, y = map(exact, (steps.Phi, steps.forced, steps.Q, steps.C, steps.R, steps.y))
    x, P, after, before = exact(start), exact(covariance), [], []
    for k in range(len(C)):
        if k:
            x, P = Phi[k - 1] @ x + u[k - 1], Phi[k - 1] @ P @ Phi[k - 1].T + Q[k - 1]
        before.append((x, P))
        for c, r, reading in zip(C[k], R[k], y[k], strict=True):
            gain = P @ c / (c @ P @ c + r)
            x, P = x + gain * (reading - c @ x), P - np.outer(gain, c @ P)
        after.append((x, P))
    smooth = [after[-1]]
    for k in range(len(C) - 2, -1, -1):
        (x, P), (later, Pl), (ahead, Pa) = after[k], smooth[0], before[k + 1]
        G = solved(Pa, Phi[k] @ P).T
        smooth.insert(0, (x + G @ (later - ahead), P + G @ (Pl - Pa) @ G.T))
    return after, smooth


def rounded_off(steps, covariance, filtered_P):
    """Of each variance (N, n) after a reading, what doubles cannot know: a reading that takes a
    standard deviation to 1e-12 of itself leaves each factor with a rounding error of the whole."""
    before = [
        covariance,
        *(F @ P @ F.T + Q for F, P, Q in zip(steps.Phi, filtered_P, steps.Q, strict=False)),
    ]
    taken = np.array([np.diag(b) / np.diag(a) for b, a in zip(before, filtered_P, strict=True)])
    return np.finfo(float).eps ** 2 * taken


def decades(low, high):
    return st.floats(low, high).map(lambda e: 10.0**e)


@st.composite
def tracked(draw):
    """Position, velocity and bias, one of them read: everything in units of anything."""
    size = np.array(draw(st.lists(decades(-6, 6), min_size=3, max_size=3)))
    prior = np.array(draw(st.lists(decades(0, 6), min_size=3, max_size=3)))
    noise, driven = draw(decades(-6, 0)), draw(decades(-12, 0))
    h, count = draw(decades(-3, 0)), 6
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    A = np.array([[0, 1, 0], [0, 0, -1], [0, 0, 0.0]])
    Phi = (np.eye(3) + h * A + h * h / 2 * A @ A) * size[:, None] / size
    half = driven * h * np.tril(rng.uniform(0.5, 1.5, (3, 3))) * size[:, None]
    C = np.zeros((count, 1, 3))
    C[:, 0, 0] = 1 / size[0]
    y = 0.1 * rng.standard_normal((count, 1))
    Q = half @ half.T
    each = count - 1
    steps = Steps(
        np.repeat(Phi[None], each, 0), np.zeros((each, 3)), np.repeat(Q[None], each, 0),
        C, np.zeros((count, 1)), np.full((count, 1), noise**2), y,
    )  # fmt: skip
    return steps, np.diag((prior * size) ** 2)


@settings(max_examples=60, deadline=None)
@given(tracked())
def test_variances_are_positive_and_right_over_twelve_decades(case):
    steps, covariance = case
    found = kalman(steps, np.zeros(3), covariance)
    x, P = smoothed(steps, found)
    with localcontext() as context:
        context.prec = DIGITS
        after, smooth = in_digits(steps, np.zeros(3), covariance)
        lost = rounded_off(steps, covariance, found.P)
        for mine, theirs in ((found.P, after), (P, smooth)):
            expected = np.array([np.diag(one).astype(float) for _, one in theirs])
            ours = np.diagonal(mine, axis1=1, axis2=2)
            assert (ours > 0).all()
            assert (np.abs(ours - expected) <= (1e-9 + lost) * expected).all()
        for mine, theirs in ((found.x, after), (x, smooth)):
            expected = np.array([one.astype(float) for one, _ in theirs])
            std = np.array([np.sqrt(np.diag(one).astype(float)) for _, one in theirs])
            assert (np.abs(mine - expected) < 1e-6 * std + 1e-9 * np.abs(expected)).all()


# -- models ----------------------------------------------------------------------------------------

T = np.arange(0, 5, 0.01)


@dynamics
def motor(
    u=signal("V"),
    w=signal("rad/s"),
    *,
    current=state("A", intensity=1e-8),
    speed=state("rad/s", std=100.0, intensity=1e-4),
    friction=state("N*m", std=1e-3, intensity=1e-13),
    unseen=state(std=1e9),
):
    """A small motor in SI units, inertia 2.6e-7 kg m², and something that is never seen."""
    rates = {
        "current": (u - 1.2 * current - 5e-3 * speed) / 3e-3,
        "speed": (5e-3 * current - friction) / 2.6e-7,
    }
    return Motion(rates=rates, outputs=(measured(w, speed, intensity=1e-4),))


@dynamics
def pendulum(y=signal("rad"), *, angle=state("rad", std=1e9), rate=state("rad/s", std=1e9)):
    rates = {"angle": rate, "rate": -20 * sin(angle)}
    return Motion(rates=rates, outputs=(measured(y, angle, intensity=1e-3),))


@dynamics
def integrated(y=signal("m"), *, place=state("m"), speed=state("m/s", intensity=1.0)):
    return Motion(rates={"place": speed}, outputs=(measured(y, place, intensity=1e-2),))


def recorded(t=T, **signals):
    columns = {name: np.asarray(values, float)[:, None] for name, values in signals.items()}
    return Run.raw("r", columns, units={}, time=t)


def turning_motor():
    rng = np.random.default_rng(0)
    return recorded(u=6 * np.sin(T), w=rng.standard_normal(len(T)))


def test_a_motor_in_si_units_is_followed_digit_by_digit():
    run = turning_motor().take(slice(0, 40))
    steps = discretised(motor, linearised(motor, run))
    with localcontext() as context:
        context.prec = DIGITS
        after, smooth = in_digits(steps, motor.start, motor.start_covariance)
    found = filtered(motor, run)
    for mine, theirs in ((found.P, after), (found.smoothed_P, smooth)):
        expected = np.array([np.diag(one).astype(float) for _, one in theirs])
        np.testing.assert_allclose(np.diagonal(mine, axis1=1, axis2=2), expected, rtol=1e-9)


@pytest.mark.parametrize("way", [filtered, kalman_bucy, least_squares])
def test_no_way_to_follow_a_motor_in_si_units_meets_a_singular_matrix(way):
    found = way(motor, turning_motor())
    assert np.isfinite(found.x).all()


def test_a_pendulum_of_which_nothing_is_known_is_followed():
    run = recorded(y=0.3 * np.sin(np.sqrt(20) * T))
    found = filtered(pendulum, run)
    assert (np.diagonal(found.P, axis1=1, axis2=2) > 0).all()
    known = filtered(pendulum.known_to(angle=1, rate=1), run)
    np.testing.assert_allclose(found.std[-1], known.std[-1], rtol=5e-3)


def test_the_likelihood_forgets_what_was_known_before_as_that_grows():
    """Of two states that the readings determine it falls by 2·log of their std."""
    run = recorded(y=1e-3 * np.random.default_rng(0).standard_normal(len(T)))
    found = []
    for std in (1e5, 1e6, 1e8):
        model = integrated.known_to(place=std, speed=std)
        ready = prepared(model, run, filtered(model, run).smoothed)
        found.append(likelihood(ready, {"speed": 1e-3, "y": 1e-8}) + 2 * np.log(std))
    np.testing.assert_allclose(found, found[0], atol=1e-6)


# -- the noise of a step ---------------------------------------------------------------------------


def held(A, Xi, h, count=3):
    """A motion with constant coefficients, sampled every h."""
    n, time = len(A), h * np.arange(count)
    zero = np.zeros((count, n))
    A = np.repeat(np.array(A, float)[None], count, 0)
    return Linearised(time, A, zero, zero[:, None], zero[:, :1], zero[:, :1], np.array(Xi, float))


@pytest.mark.parametrize("pole", 10.0 ** np.arange(-6.0, 7.0))
def test_noise_through_a_pole_of_any_speed_is_its_integral(pole):
    """Ξ(1 − exp(−2ah))/2a, and a position behind it that moves with what went through."""
    system = held([[-pole, 0], [1, 0]], np.diag([3.0, 0.0]), 1.0)
    Q = process_noise(system, system.process)[0]
    with localcontext() as context:
        context.prec = DIGITS
        a = Decimal(float(pole))
        e, e2 = (-a).exp(), (-2 * a).exp()
        expected = 3 * np.array([
            (1 - e2) / (2 * a),
            ((1 - e) / a - (1 - e2) / (2 * a)) / a,
            (1 - 2 * (1 - e) / a + (1 - e2) / (2 * a)) / a**2,
        ])  # fmt: skip
    np.testing.assert_allclose(Q[[0, 0, 1], [0, 1, 1]], expected.astype(float), rtol=1e-10)


@pytest.mark.parametrize("h", [1e-6, 1e-2, 1.0, 1e3])
def test_noise_through_four_integrators_is_its_polynomial(h):
    A, order = np.eye(4, k=1), np.arange(3, -1, -1)
    Q = process_noise(held(A, np.diag([0, 0, 0, 1.0]), h), np.diag([0, 0, 0, 1.0]))[0]
    factorial = np.array([6.0, 2.0, 1.0, 1.0])
    power = order[:, None] + order + 1
    np.testing.assert_allclose(Q, h**power / power / np.outer(factorial, factorial), rtol=1e-12)


def test_a_motion_that_grows_beyond_all_numbers_is_refused():
    system = held([[1e4]], [[1.0]], 1.0)
    with pytest.raises(
        DataError, match=r"from t = 0 s to 1 s the motion grows beyond what .* 1e\+04/s"
    ):
        transitions(system)


def test_a_motion_that_is_not_finite_is_refused_like_one_that_grows_beyond_all_numbers():
    """Trial numbers of an effect can lead there: it ended in an OverflowError."""
    with pytest.raises(DataError, match=r"from t = 0 s to 1 s the motion grows beyond what"):
        transitions(held([[np.inf]], [[1.0]], 1.0))


def test_a_nonlinear_motion_far_faster_than_its_samples_is_refused():
    @dynamics
    def stiff(y=signal("rad"), *, angle=state("rad")):
        rates = {"angle": -1e6 * sin(angle)}
        return Motion(rates=rates, outputs=(measured(y, angle, intensity=1.0),))

    with pytest.raises(DataError, match=r"moves 1e\+04 times faster than a step of 0.01 s"):
        filtered(stiff, recorded(y=0 * T))


# -- Riccati's equation ----------------------------------------------------------------------------


@pytest.mark.parametrize("theta", 10.0 ** np.arange(-14.0, 1.0, 2.0))
def test_riccatis_equation_settles_for_any_reading_of_a_double_integrator(theta):
    """√2·Θ^¾, √Θ, √2·Θ^¼ for Ξ = 1."""
    model = integrated.sensing(y=theta).known_to(place=1e3, speed=1e3)
    t = np.arange(0, 40 * max(theta**0.25, 0.01), 0.01)
    P = riccati(model, linearised(model, recorded(t, y=0 * t)))
    assert (np.linalg.eigvalsh(P[:, [[0, 1], [0, 1]], [[0, 0], [1, 1]]]) > 0).all()
    root = np.sqrt(2)
    expected = [root * theta**0.75, theta**0.5, root * theta**0.25]
    np.testing.assert_allclose(P[-1, [0, 0, 1], [0, 1, 1]], expected, rtol=1e-9)


def test_riccatis_equation_follows_a_pole_of_a_microsecond():
    """Behind it the place walks, by Ξ/a² a second: √(Θ·Ξ/a²); the fast state keeps Ξ/2a."""

    @dynamics
    def fast(y=signal("m"), *, place=state("m"), f=state("m/s", intensity=1.0)):
        rates = {"place": f, "f": -1e6 * f}
        return Motion(rates=rates, outputs=(measured(y, place, intensity=1e-14),))

    P = riccati(fast, linearised(fast, recorded(y=0 * T)))
    np.testing.assert_allclose(P[-1, [0, 1], [0, 1]], [1e-13, 0.5e-6], rtol=1e-4)
    assert (np.diagonal(P, axis1=1, axis2=2) > 0).all()


def test_a_covariance_that_grows_beyond_all_numbers_is_refused():
    @dynamics
    def wild(y=signal("m"), *, place=state("m"), x=state(intensity=1.0)):
        return Motion(rates={"x": 100 * x}, outputs=(measured(y, place, intensity=1.0),))

    with pytest.raises(DataError, match=r"the covariance of .* grows beyond what numbers hold"):
        riccati(wild, linearised(wild, recorded(y=0 * T)))
