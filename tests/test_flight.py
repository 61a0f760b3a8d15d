"""Batista V-B in short: what `studies/flight.py` shows at length, on closed-form flights."""

from __future__ import annotations

import flights
import numpy as np
import pytest
from scipy.stats import chi2

from casest import UsageError
from casest.dynamics.filter import filtered
from casest.dynamics.riccati import riccati
from casest.dynamics.transition import linearised
from casest_problems.bias_gravity import bias_gravity

DT, STD = 0.02, {"velocity": 0.01, "gravity": 0.05, "bias": 0.1}
MATCHED = bias_gravity.driven(velocity=0.0, gravity=0.0, bias=0.0).sensing(
    **{name: sigma**2 * DT for name, sigma in flights.SIGMA.items()}
)
T = np.arange(0, 30, DT)


def follow(model, flight, rng):
    """The filter and its errors (N, 9), from a start drawn from what it is told."""
    run = flights.record(flight, T, rng)
    bias = np.broadcast_to(flights.BIAS, (len(T), 3))
    truth = np.hstack([flight.velocity(T), flight.gravity(T), bias])
    start = truth[0] + np.repeat(list(STD.values()), 3) * rng.standard_normal(9)
    model = model.beginning(velocity=start[:3], gravity=start[3:6], bias=start[6:])
    found = filtered(model.known_to(**STD), run, smooth=False)
    return found, found.x - truth


def nees(found, errors):
    return np.sum(errors * np.linalg.solve(found.P, errors[:, :, None])[:, :, 0], axis=1)


@pytest.fixture(scope="module")
def runs():
    rng = np.random.default_rng(0)
    return [follow(MATCHED, flights.somewhere(rng), rng) for _ in range(10)]


def test_the_flights_are_rigid_motions():
    """Angular velocity turns the attitude, force changes the velocity: by finite differences."""
    t, h = np.linspace(0, 20, 50), 1e-5
    for flight in (flights.on_the_table(), flights.in_the_air()):
        turn = (flight.body(t - h) * flight.body(t + h).inv()).as_rotvec() / (2 * h)
        np.testing.assert_allclose(turn, flight.omega(t), atol=1e-7)
        inertial = [flight.body(s).inv().apply(flight.velocity(s)) for s in (t - h, t + h)]
        force = flight.body(t).apply((inertial[1] - inertial[0]) / (2 * h) - flights.GRAVITY)
        np.testing.assert_allclose(force, flight.force(t), atol=1e-6)


def test_normalised_errors_lie_where_chi_square_says(runs):
    mean = np.mean([nees(*run) for run in runs], axis=0)
    low, high = chi2.ppf([0.025, 0.975], 9 * len(runs)) / len(runs)
    assert np.mean((mean > low) & (mean < high)) > 0.8  # errors are correlated over seconds
    # Each run's last instant is independent of the others.
    assert low < mean[-1] < high


def test_normalised_innovations_lie_where_chi_square_says(runs):
    squares = np.array([found.normalised_innovations for found, _ in runs])
    low, high = chi2.ppf([0.001, 0.999], 3 * squares.size) / squares.size
    assert low < squares.mean() < high
    band = chi2.ppf([0.025, 0.975], 3 * len(runs)) / len(runs)
    inside = np.mean((squares.mean(axis=0) > band[0]) & (squares.mean(axis=0) < band[1]))
    assert abs(inside - 0.95) < 4 * np.sqrt(0.95 * 0.05 / len(T))


def test_errors_reach_the_bound_and_do_not_pass_it(runs):
    """The Riccati covariance along the true states, from the stated noises."""
    late = np.array([errors[-1] for _, errors in runs])
    claimed = np.array([found.std[-1] for found, _ in runs])
    ratio = np.sum((late / claimed) ** 2)
    assert chi2.ppf(0.005, late.size) < ratio < chi2.ppf(0.995, late.size)


@pytest.mark.long
def test_errors_stay_within_what_the_filter_claims_on_both_sides_of_a_gap():
    """What the inputs did for 4 s is unknown: velocity and gravity are forgotten, the bias not."""
    t, squares, bias = np.concatenate([T[T < 14], T[T > 18]]), [], []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        flight = flights.somewhere(rng)
        run = flights.record(flight, t, rng)
        known = np.tile(flights.BIAS, (len(t), 1))
        truth = np.hstack([flight.velocity(t), flight.gravity(t), known])
        start = truth[0] + np.repeat(list(STD.values()), 3) * rng.standard_normal(9)
        model = MATCHED.beginning(velocity=start[:3], gravity=start[3:6], bias=start[6:])
        wide = model.known_to(velocity=10.0, gravity=10.0, bias=0.1)
        found = filtered(wide, run)
        k = int(np.sum(t < 14))
        at = [k - 1, k + 25, len(t) - 1]
        squares.append(nees(found, found.x - truth)[at])
        smooth = found.smoothed - truth
        late = np.sum(smooth * np.linalg.solve(found.smoothed_P, smooth[:, :, None])[:, :, 0], 1)
        squares.append(late[[k - 1, k, k + 25]])
        bias.append(found.std[k + 1, 6:] / found.std[k - 1, 6:])
    low, high = chi2.ppf([0.001, 0.999], 9 * 6) / 6
    for half in (squares[::2], squares[1::2]):
        mean = np.mean(half, axis=0)
        assert np.all((low < mean) & (mean < high))
    assert np.max(bias) < 1.01


def test_published_tuning_claims_many_times_its_errors():
    rng = np.random.default_rng(1)
    found, errors = follow(bias_gravity, flights.in_the_air(), rng)
    assert nees(found, errors)[T > 10].mean() < 1  # nine expected
    assert found.normalised_innovations[T > 10].mean() < 1e-3  # three expected


def test_the_pendulum_is_many_times_worse_than_the_filter():
    """a_m/‖a_m‖ as the direction of gravity, on a vehicle that accelerates."""
    flight, rng = flights.in_the_air(), np.random.default_rng(2)
    found, _ = follow(MATCHED, flight, rng)
    late, gravity = T > 10, flight.gravity(T)
    pendulum = -flights.record(flight, T, rng).signals["a"]

    def off(direction):
        unit = direction / np.linalg.norm(direction, axis=1)[:, None]
        return np.sqrt(np.mean(np.sum((unit - gravity / 9.80665) ** 2, axis=1)[late]))

    assert off(pendulum) > 100 * off(found.x[:, 3:6])


def test_gyro_noise_reaches_gravity_and_velocity_as_the_cross_product_says():
    """S(g)QS(g)ᵀ and S(v)QS(v)ᵀ (Batista, IV, with matched intensities)."""
    rng = np.random.default_rng(3)
    run = flights.record(flights.in_the_air(), T[:5])
    along = rng.standard_normal((5, 9))
    system = linearised(bias_gravity.sensing(omega=0.3, a=0.7), run, along=along)

    def skew(v):
        return np.array([np.cross(v, axis) for axis in np.eye(3)]).T

    v, g = skew(along[2, :3]), skew(along[2, 3:6])
    expected = bias_gravity.process.copy()
    expected[:3, :3] += 0.3 * v @ v.T + 0.7 * np.eye(3)
    expected[3:6, 3:6] += 0.3 * g @ g.T
    expected[:3, 3:6] += 0.3 * v @ g.T
    expected[3:6, :3] += 0.3 * g @ v.T
    np.testing.assert_allclose(system.process[2], expected, atol=1e-14)


def test_the_bound_of_gravity_is_no_smaller_than_two_thirds_of_the_accelerometers_noise():
    """Batista, V-B: "well below" cannot be; 100 Hz, his noises."""
    t = np.arange(0, 60, 0.01)
    flight = flights.on_the_table()
    model = bias_gravity.driven(velocity=0.0, gravity=0.0, bias=0.0).known_to(**STD)
    model = model.sensing(**{name: sigma**2 * 0.01 for name, sigma in flights.SIGMA.items()})
    truth = np.hstack([flight.velocity(t), flight.gravity(t), np.tile(flights.BIAS, (len(t), 1))])
    P = riccati(model, linearised(model, flights.record(flight, t), along=truth))[-1]
    gravity = np.sqrt(np.trace(P[3:6, 3:6]) / 3)
    assert 0.6 < gravity / flights.SIGMA["a"] < 0.75


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"v": 0.0}, "v: a reading without noise makes the Riccati equation singular"),
        ({"a": -1.0}, "a: the intensity -1 must be finite and not negative"),
        ({"w": 1.0}, "bias-gravity has no signal 'w'; it has a, omega, v"),
    ],
)
def test_an_intensity_that_is_none_is_refused(said, words):
    with pytest.raises(UsageError, match=words):
        bias_gravity.sensing(**said)
