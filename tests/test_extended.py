"""The extended filter and its smoother against textbook forms that share no code with them."""

from __future__ import annotations

import json

import flights
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.stats import chi2

from casest import DataError, Run, atan2, log, norm_2, signal, sin, vertcat
from casest.cli import run as cli
from casest.dynamics import Motion, angle, constraint, dynamics, measured, state
from casest.dynamics.filter import filtered
from casest.dynamics.record import least_squares as at_once_of
from casest.report.text.states import filter_text
from casest.results.observability import observe_motion
from casest.results.states import follow
from casest_problems.bias_gravity import bias_gravity, bias_gravity_magnitude

G_OVER_L, DAMPING = 9.81 / 0.8, 0.15
XI, THETA = np.diag([1e-5, 4e-3]), 2e-4


def pendulum_of():
    @dynamics
    def pendulum(
        torque=signal("1/s^2"),
        y=signal("rad"),
        *,
        angle=state("rad", intensity=XI[0, 0], start=0.6, std=0.3),
        rate=state("rad/s", intensity=XI[1, 1], std=0.5),
    ):
        rates = {"angle": rate, "rate": torque - G_OVER_L * sin(angle) - DAMPING * rate}
        return Motion(rates=rates, outputs=(measured(y, angle, intensity=THETA),))

    return pendulum


def swung(start, t, torque, parts=8):
    """Path (N, 2) by Runge and Kutta's classical rule, torque a straight line between samples."""

    def rate(x, u):
        return np.array([x[1], u - G_OVER_L * np.sin(x[0]) - DAMPING * x[1]])

    path = [np.array(start, float)]
    for k in range(len(t) - 1):
        h, x = (t[k + 1] - t[k]) / parts, path[-1]
        for j in range(parts):
            u = torque[k] + (torque[k + 1] - torque[k]) * (j + np.array([0, 0.5, 1])) / parts
            a = rate(x, u[0])
            b = rate(x + h / 2 * a, u[1])
            c = rate(x + h / 2 * b, u[1])
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, u[2]))
        path.append(x)
    return np.array(path)


def swing(seed=0, seconds=4.0, step=0.04, irregular=False):
    """The record of a pendulum and the truth (N, 2)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, step)
    if irregular:
        t = np.sort(t + 0.4 * step * rng.uniform(-1, 1, len(t)))
    torque = 2 * np.sin(1.3 * t)
    truth = swung([0.9, -0.4], t, torque)
    y = truth[:, 0] + np.sqrt(THETA / np.gradient(t)) * rng.standard_normal(len(t))
    signals = {"torque": torque[:, None], "y": y[:, None]}
    return Run.raw("swing", signals, units={}, time=t), truth


def textbook(run, x, P):
    """Continuous-discrete extended Kalman filter: moments by solve_ivp between readings."""
    t, u, y = run.time, run.signals["torque"][:, 0], run.signals["y"][:, 0]
    step = np.diff(t)

    def rate(time, z):
        angle, speed = z[:2]
        P = z[2:].reshape(2, 2)
        A = np.array([[0, 1], [-G_OVER_L * np.cos(angle), -DAMPING]])
        slope = np.interp(time, t, u) - G_OVER_L * np.sin(angle) - DAMPING * speed
        return np.r_[speed, slope, (A @ P + P @ A.T + XI).ravel()]

    found = []
    for k in range(len(t)):
        if k:
            span = (t[k - 1], t[k])
            z = solve_ivp(rate, span, np.r_[x, P.ravel()], "DOP853", rtol=1e-11, atol=1e-14).y
            x, P = z[:2, -1], z[2:, -1].reshape(2, 2)
        if np.isfinite(y[k]):
            K = P[:, 0] / (P[0, 0] + THETA / step.mean())
            x, P = x + K * (y[k] - x[0]), P - np.outer(K, P[0])
        found.append((x, P))
    return np.array([x for x, _ in found]), np.array([P for _, P in found])


@pytest.mark.parametrize("irregular", [False, True])
def test_it_is_the_textbooks_filter(irregular):
    model = pendulum_of()
    run, _ = swing(seconds=2.5, step=0.02, irregular=irregular)
    y = run.signals["y"].copy()
    y[40:55] = np.nan
    run = Run.raw("swing", {**run.signals, "y": y}, units={}, time=run.time)
    x, P = textbook(run, model.start, model.start_covariance)
    found = filtered(model, run, smooth=False)
    np.testing.assert_allclose(found.x, x, atol=1e-6)
    np.testing.assert_allclose(found.P, P, atol=1e-8)


def test_errors_are_as_large_as_they_are_said_to_be():
    """Of the smoother over 20 swings: driven by torque noise as the model has it."""
    late, quiet = [], pendulum_of().driven(angle=0.0, rate=0.0)
    for seed in range(20):
        run, truth = swing(seed)
        found = filtered(quiet, run)
        error = found.smoothed[-1] - truth[-1]
        late.append(error @ np.linalg.solve(found.smoothed_P[-1], error))
    assert 1.1 < np.mean(late) < 3.2  # two expected; χ² of 40 over 20: 1.2 to 3.0


def test_without_driving_noise_the_smoother_is_a_fit_of_the_start():
    """The start by SciPy's least squares, over the whole record."""
    run, _ = swing(seconds=2.0)
    quiet = pendulum_of().driven(angle=0.0, rate=0.0)
    t, u, y = run.time, run.signals["torque"][:, 0], run.signals["y"][:, 0]
    weight = np.sqrt(np.gradient(t) / THETA)

    def residual(x0):
        path = swung(x0, t, u, parts=4)[:, 0]
        return np.r_[(path - y) * weight, (x0 - quiet.start) / np.array([0.3, 0.5])]

    expected = least_squares(residual, quiet.start, method="lm", diff_step=1e-6)
    found = filtered(quiet, run)
    std = np.sqrt(np.diag(np.linalg.inv(expected.jac.T @ expected.jac)))
    assert np.abs(found.smoothed[0] - expected.x).max() < 1e-3 * std.min()
    np.testing.assert_allclose(np.sqrt(np.diag(found.smoothed_P[0])), std, rtol=1e-3)


def test_the_smoother_is_the_least_squares_of_the_whole_record():
    model = pendulum_of()
    run, _ = swing()
    found, at_once = filtered(model, run), at_once_of(model, run)
    np.testing.assert_allclose(found.smoothed, at_once.x, atol=1e-8)
    np.testing.assert_allclose(found.smoothed_P[-1], at_once.P_end, rtol=1e-6)


def test_range_and_bearing_find_a_moving_body():
    @dynamics
    def radar(
        seen=signal(2),
        *,
        place=state(2, "m", start=(90.0, 40.0), std=20.0),
        speed=state(2, "m/s", intensity=1e-4, std=5.0),
    ):
        both = vertcat(norm_2(place), atan2(place[1], place[0]) * 100)
        return Motion(rates={"place": speed}, outputs=(measured(seen, both, intensity=0.02),))

    rng = np.random.default_rng(4)
    t = np.arange(0, 40, 0.1)
    true = np.c_[80 - 3 * t, 50 + 1.5 * t]
    seen = np.c_[np.hypot(*true.T), 100 * np.arctan2(true[:, 1], true[:, 0])]
    seen += np.sqrt(0.02 / 0.1) * rng.standard_normal(seen.shape)
    run = Run.raw("radar", {"seen": seen}, units={}, time=t)
    found = filtered(radar, run)
    truth = np.c_[true, np.tile([-3, 1.5], (len(t), 1))]
    assert np.abs(found.x[-1, 2:] - [-3, 1.5]).max() < 4 * found.std[-1, 2:].max()
    error = (found.smoothed - truth)[len(t) // 2]
    assert error @ np.linalg.solve(found.smoothed_P[len(t) // 2], error) < 18.5  # χ², 99.9 %
    assert abs(found.normalised_innovations[20:].mean() - 2) < 0.3


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2 * np.pi), ("deg", 360.0)])
def test_a_bearing_goes_on_across_half_a_turn(unit, turn):
    """A body passes behind the radar, where its bearing jumps from one end to the other."""

    @dynamics
    def radar(
        distance=signal("m"),
        bearing=signal(unit),
        *,
        place=state(2, "m", start=(-50.0, 30.0), std=10.0),
        speed=state(2, "m/s", std=5.0),
    ):
        seen = angle(turn / (2 * np.pi) * atan2(place[1], place[0]))
        outputs = (
            measured(distance, norm_2(place), intensity=0.001),
            measured(bearing, seen, intensity=1e-6 * (turn / (2 * np.pi)) ** 2),
        )
        return Motion(rates={"place": speed}, outputs=outputs)

    t, squares = np.arange(0, 30, 0.1), []
    true = np.c_[-45 + 0.3 * t, 25 - 2.0 * t]
    truth = np.c_[true, np.tile([0.3, -2.0], (len(t), 1))]
    for seed in range(10):
        rng = np.random.default_rng(seed)
        distance = np.hypot(*true.T) + 0.1 * rng.standard_normal(len(t))
        read = np.arctan2(true[:, 1], true[:, 0]) + np.sqrt(1e-5) * rng.standard_normal(len(t))
        read = (read + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(np.diff(read)).max() > 6  # it does jump
        signals = {"distance": distance[:, None], "bearing": turn / (2 * np.pi) * read[:, None]}
        found = filtered(radar, Run.raw("radar", signals, units={}, time=t))
        assert found.settled
        assert abs(found.normalised_innovations.mean() - 2) < 0.6
        for x, P in ((found.x, found.P), (found.smoothed, found.smoothed_P)):
            error = x[150] - truth[150]
            squares.append(error @ np.linalg.solve(P[150], error))
    low, high = chi2.ppf([0.0005, 0.9995], 4 * 10)
    for of_all in (squares[::2], squares[1::2]):
        assert low < np.sum(of_all) < high


def test_ranges_alone_find_a_body_from_a_start_far_away():
    """Readings are linearised where they lead to: an update at the prediction alone ends eight
    standard deviations off, and says that it is sure."""

    @dynamics
    def ranging(
        r=signal(2, "m"),
        *,
        place=state(2, "m", start=(10.0, 10.0), std=20.0),
        speed=state(2, "m/s", std=2.0),
    ):
        both = vertcat(norm_2(place), norm_2(place - vertcat(30.0, 0.0)))
        return Motion(rates={"place": speed}, outputs=(measured(r, both, intensity=1e-3),))

    t, squares = np.arange(0, 20, 0.1), []
    true = np.c_[25 - 1.0 * t, 20 + 0.5 * t]
    ranges = np.c_[np.hypot(*true.T), np.hypot(true[:, 0] - 30, true[:, 1])]
    for seed in range(20):
        r = ranges + 0.1 * np.random.default_rng(seed).standard_normal(ranges.shape)
        found = filtered(ranging, Run.raw("r", {"r": r}, units={}, time=t))
        error = found.x[-1] - [*true[-1], -1.0, 0.5]
        squares.append(error @ np.linalg.solve(found.P[-1], error))
    assert chi2.ppf(0.0005, 80) < np.sum(squares) < chi2.ppf(0.9995, 80)


def linear_and_not():
    """The same cart twice, once written so that nobody sees that it is linear."""
    made = []
    for hidden in (0.0, 1e-300):

        @dynamics
        def cart(u=signal("1"), y=signal("1"), *, x=state(std=2.0, intensity=1e-3),
                 v=state(intensity=0.02), ghost=hidden_of(hidden)):  # fmt: skip
            rates = {"x": v, "v": u - 0.8 * v - 1.5 * x + ghost * sin(x)}
            return Motion(rates=rates, outputs=(measured(y, x, intensity=0.01),))

        made.append(cart)
    return made


def hidden_of(value):
    from casest import constant

    return constant(value)


def test_of_a_linear_model_it_is_the_kalman_filter():
    plain, hidden = linear_and_not()
    assert (plain.linear, hidden.linear) == (True, False)
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.01, 0.03, 600))
    y = 0.3 * np.sin(0.9 * t) + 0.3 * rng.standard_normal(600)
    y[200:230] = np.nan
    signals = {"u": np.sin(t)[:, None], "y": y[:, None]}
    run = Run.raw("cart", signals, units={}, time=t)
    one, other = filtered(plain, run), filtered(hidden, run)
    np.testing.assert_allclose(other.x, one.x, atol=1e-8)
    np.testing.assert_allclose(other.P, one.P, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(other.smoothed, one.smoothed, atol=1e-8)
    np.testing.assert_allclose(other.smoothed_P, one.smoothed_P, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(other.innovations, one.innovations, atol=1e-8)
    np.testing.assert_allclose(other.S, one.S, rtol=1e-7)


def test_where_the_model_does_not_hold_it_says_the_row():
    @dynamics
    def falling(y=signal("m"), *, x=state("m", start=1.0, std=0.1)):
        rates = {"x": -1.0 + 0 * log(x)}
        return Motion(rates=rates, outputs=(measured(y, log(x), intensity=1e3),))

    t = np.arange(0, 3, 0.1)
    run = Run.raw("r", {"y": np.zeros((30, 1))}, units={}, time=t)
    with pytest.raises(DataError, match="extended filter of falling diverges at row 1"):
        filtered(falling, run)


# -- what is known exactly -------------------------------------------------------------------------


def circling(known):
    @dynamics
    def direction(
        rate=signal("rad/s"),
        y=signal("1"),
        *,
        n=state(2, start=(0.7, 0.4), std=0.5),
    ):
        rates = {"n": vertcat(-rate * n[1], rate * n[0])}
        constraints = (constraint(norm_2(n), 1.0),) if known else ()
        seen = (measured(y, n[0], intensity=0.005),)
        return Motion(rates=rates, outputs=seen, constraints=constraints)

    return direction


def test_a_known_length_is_kept_and_helps():
    """A direction that turns slowly: one component is read, and the length is one."""
    t = np.arange(0, 6, 0.02)
    true = np.c_[np.cos(0.5 + 0.1 * t), np.sin(0.5 + 0.1 * t)]
    errors, squares = {}, []
    for known in (False, True):
        ends, model = [], circling(known)
        for seed in range(20):
            rng = np.random.default_rng(seed)
            y = true[:, 0] + np.sqrt(0.005 / 0.02) * rng.standard_normal(len(t))
            signals = {"rate": np.full((len(t), 1), 0.1), "y": y[:, None]}
            run = Run.raw("r", signals, units={}, time=t)
            found = filtered(model, run)
            ends.append(found.x[-1] - true[-1])
            if known:
                squares.append(ends[-1] @ np.linalg.solve(found.P[-1], ends[-1]))
                np.testing.assert_allclose(np.linalg.norm(found.smoothed, axis=1), 1, atol=1e-12)
        errors[known] = np.sqrt(np.mean(np.sum(np.square(ends), axis=1)))
    assert errors[True] < 0.5 * errors[False]
    assert 0.5 < np.mean(squares) < 2.0  # one direction is left, and a little of the other


def test_a_nonlinear_model_keeps_to_what_is_known_too():
    """A swing in the plane by its two coordinates, on a thread of known length."""

    @dynamics
    def thread(torque=signal("1/s^2"), y=signal("rad"), *,
               n=state(2, start=(np.sin(0.6), np.cos(0.6)), std=0.3, intensity=1e-5),
               rate=state("rad/s", intensity=4e-3, std=0.5)):  # fmt: skip
        turning = vertcat(rate * n[1], -rate * n[0])
        slope = torque - G_OVER_L * n[0] - DAMPING * rate
        seen = (measured(y, atan2(n[0], n[1]), intensity=THETA),)
        known = (constraint(norm_2(n), 1.0),)
        return Motion(rates={"n": turning, "rate": slope}, outputs=seen, constraints=known)

    run, truth = swing()
    found = filtered(thread, run)
    for states in (found.x, found.smoothed):
        np.testing.assert_allclose(np.linalg.norm(states[:, :2], axis=1), 1, atol=1e-9)
    assert found.settled
    angle = np.arctan2(*found.smoothed[:, :2].T)
    plain = filtered(pendulum_of(), run)
    assert np.std(angle - truth[:, 0]) < 1.2 * np.std(plain.smoothed[:, 0] - truth[:, 0])


def test_the_states_printed_are_those_of_the_whole_record():
    """A pendulum whose length is found from a start far away: the filter ends elsewhere."""

    @dynamics
    def pendulum(
        y=signal("rad"),
        *,
        angle=state("rad", start=0.3, std=0.3),
        rate=state("rad/s", std=1.0),
        length=state("m", start=1.5, std=1.0),
    ):
        rates = {"angle": rate, "rate": -G_OVER_L * 0.8 / length * sin(angle)}
        return Motion(rates=rates, outputs=(measured(y, angle, intensity=2e-8),))

    t, parted = np.arange(0, 20, 0.02), 0
    for seed in range(2):
        rng = np.random.default_rng(300 + seed)
        start = [rng.uniform(0.3, 1.2), rng.uniform(-0.5, 0.5)]
        path = solve_ivp(lambda _, x: [x[1], -G_OVER_L * np.sin(x[0])], (0, 20), start,
                         t_eval=t, rtol=1e-11, atol=1e-12)  # fmt: skip
        y = path.y[0] + 0.001 * rng.standard_normal(len(t))
        result = follow(pendulum, Run.raw("p", {"y": y[:, None]}, units={}, time=t))
        length = result.states["length"]
        assert abs(length.value[0] - 0.8) < 4 * length.std[0]
        off = abs(result.filtered.x[-1] - result.filtered.smoothed[-1]) / result.filtered.std[-1]
        said = "standard deviations of" in " ".join(result.notes)
        assert said == bool(off.max() > 1) or abs(off.max() - 1) < 0.1
        parted += said
    assert parted


def test_a_smoother_that_does_not_settle_says_so(monkeypatch):
    monkeypatch.setattr("casest.dynamics.course.ROUNDS", 1)
    result = follow(pendulum_of(), swing()[0])
    assert not result.filtered.settled
    assert "the smoother's rounds did not settle" in " ".join(result.notes)
    assert not result.settled
    assert "not settled: ± is too small" in filter_text(result)


@pytest.mark.long
def test_a_known_gravity_brings_its_error_and_the_biass_down():
    """Independent flights, matched noise: errors fall, and stay as large as they are said to be."""
    t = np.arange(0, 10, 0.02)
    std = {"velocity": 0.01, "gravity": 0.5, "bias": 0.3}
    bias = np.broadcast_to(flights.BIAS, (len(t), 3))
    errors, squares = {}, []
    for declared in (bias_gravity, bias_gravity_magnitude):
        model = declared.driven(velocity=0.0, gravity=0.0, bias=0.0).known_to(**std)
        model = model.sensing(**{n: s**2 * 0.02 for n, s in flights.SIGMA.items()})
        rng, ends = np.random.default_rng(0), []
        for _ in range(8):
            flight = flights.somewhere(rng)
            run = flights.record(flight, t, rng)
            truth = np.hstack([flight.velocity(t), flight.gravity(t), bias])
            first = truth[0] + np.repeat(list(std.values()), 3) * rng.standard_normal(9)
            found = filtered(
                model.beginning(velocity=first[:3], gravity=first[3:6], bias=first[6:]), run
            )
            ends.append(found.x[-1] - truth[-1])
            if declared is bias_gravity_magnitude:
                squares.append(ends[-1] @ np.linalg.solve(found.P[-1], ends[-1]))
                length = np.linalg.norm(found.x[:, 3:6], axis=1)
                np.testing.assert_allclose(length, 9.80665, rtol=1e-12)
        errors[declared.name] = np.sqrt(np.mean(np.square(ends), axis=0)).reshape(3, 3).mean(axis=1)
    ratio = errors["bias-gravity-magnitude"] / errors["bias-gravity"]
    assert ratio[1] < 0.85
    assert ratio[2] < 0.65
    assert 5.0 < np.mean(squares) < 13.5  # nine expected: χ² of 72 over 8, 99.9 %: 4.9 to 14.3


def test_a_linear_constraint_is_conditioning():
    """The textbook's conditional mean and covariance of a Gaussian."""

    @dynamics
    def pair(y=signal("1"), *, x=state(2, start=(1.0, 3.0), std=2.0)):
        known = constraint(x[0] + 2 * x[1], 4.0)
        seen = (measured(y, x[0], intensity=1.0),)
        return Motion(rates={}, outputs=seen, constraints=(known,))

    free = dynamics(lambda y=signal("1"), *, x=state(2, start=(1.0, 3.0), std=2.0): Motion(
        rates={}, outputs=(measured(y, x[0], intensity=1.0),)))  # fmt: skip
    run = Run.raw("r", {"y": np.ones((5, 1))}, units={}, time=np.arange(5.0))
    one, other = filtered(free, run), filtered(pair, run)
    c = np.array([1.0, 2.0])
    x, P = one.x[-1], one.P[-1]
    K = P @ c / (c @ P @ c)
    np.testing.assert_allclose(other.x[-1], x + K * (4 - c @ x), atol=1e-12)
    np.testing.assert_allclose(other.P[-1], P - np.outer(K, c @ P), atol=1e-12)
    assert other.innovations.shape == (5, 1)


# -- through the command line ----------------------------------------------------------------------


@pytest.fixture
def in_the_air(tmp_path):
    """A flight as a user's file."""
    t = np.arange(0, 8, 0.02)
    run = flights.record(flights.in_the_air(), t, np.random.default_rng(0))
    head = ["t [s]", *(f"a{c} [m/s^2]" for c in "xyz"), *(f"omega_{c} [rad/s]" for c in "xyz")]
    head += [f"v{c} [m/s]" for c in "xyz"]
    table = np.c_[t, run.signals["a"], run.signals["omega"], run.signals["v"]]
    np.savetxt(tmp_path / "f.csv", table, delimiter=",", header=",".join(head), comments="")
    return str(tmp_path / "f.csv")


def test_a_magnitude_can_be_set(in_the_air, capsys):
    words = ["filter", "bias-gravity-magnitude", in_the_air, "--json"]
    for magnitude in (9.80665, 9.81):
        assert cli([*words, "--set", f"gravity_magnitude={magnitude}"]) == 0
        found = json.loads(capsys.readouterr().out)["states"]["gravity"]["value"]
        assert np.linalg.norm(found) == pytest.approx(magnitude, rel=1e-12)


def test_what_is_known_is_not_counted_as_a_reading_and_that_is_said(in_the_air, capsys):
    assert cli(["observe", "bias-gravity-magnitude", in_the_air, "--json"]) == 0
    notes = " ".join(json.loads(capsys.readouterr().out)["notes"])
    assert "(constraint) is not counted: this the readings alone show" in notes


def test_a_nonlinear_model_is_observed_along_its_own_trajectory(tmp_path, capsys):
    """A pendulum's length from its swing."""
    model = """
from casest import signal, sin
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def pendulum(
    y=signal("rad"), *, angle=state("rad", start=0.1), rate=state("rad/s"),
    stiffness=state("1/s^2", start=10.0, std=3.0),
):
    rates = {"angle": rate, "rate": -stiffness * sin(angle)}
    return Motion(rates=rates, outputs=(measured(y, angle, intensity=1e-5),))
"""
    (tmp_path / "p.py").write_text(model, encoding="utf-8")
    t = np.arange(0, 5, 0.02)
    y = swung([0.6, 0.0], t, 0 * t)[:, 0] + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    np.savetxt(tmp_path / "r.csv", np.c_[t, y], delimiter=",", header="t,y [rad]", comments="")
    assert cli(["observe", str(tmp_path / "p.py"), str(tmp_path / "r.csv"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["rank"], told["structural_rank"]) == (3, 3)
    # Of small swings the frequency is √stiffness, and 5 s of 0.3 rad (rms) at σ²Δt = 1e-5 rad²s
    # tell it to √(12·1e-5/(0.3²·5³)) = 0.0033 rad/s, so stiffness to 2·3.2·0.0033.
    assert 0.01 < told["std"]["stiffness"][0] < 0.04


def test_at_rest_below_the_length_of_a_pendulum_is_not_seen():
    @dynamics
    def pendulum(y=signal("rad"), *, angle=state("rad"), rate=state("rad/s"),
                 stiffness=state("1/s^2", start=10.0)):  # fmt: skip
        rates = {"angle": rate, "rate": -stiffness * sin(angle)}
        return Motion(rates=rates, outputs=(measured(y, angle, intensity=1e-5),))

    run = Run.raw("r", {"y": np.zeros((100, 1))}, units={}, time=np.arange(100) * 0.05)
    told = observe_motion(pendulum, run)
    assert (told.rank, told.structural_rank) == (2, 3)
    assert told.unobservable == ["stiffness changes no reading"]
