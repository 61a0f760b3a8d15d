"""The loop in motion: effects planted in closed-form flights are found and named; nulls are not."""

from __future__ import annotations

import csv
import json

import casadi as ca
import flights
import numpy as np
import pytest
from flights import Sensors
from scipy.integrate import solve_ivp
from scipy.linalg import solve_triangular

from casest import DataError, Run, cli, cross, norm_2, signal, sin
from casest.diagnose.motion.candidates import candidates
from casest.diagnose.motion.candidates import prepared as with_columns
from casest.diagnose.motion.delays import by_reading, shifted
from casest.diagnose.motion.fit import fitted, rise
from casest.diagnose.motion.innovations import Innovations
from casest.diagnose.motion.loop import close_motion
from casest.diagnose.motion.sensitivity import pushes, sensitivity
from casest.diagnose.motion.whiteness import whiteness
from casest.diagnose.protocol import ranked
from casest.dynamics import Motion, constraint, dynamics, measured, state
from casest.dynamics.filter import filtered
from casest.dynamics.likelihood import applied, first_guess, likelihood, matched, prepared
from casest.effects.moving import Body, Colour, extended
from casest.results.motion import motion_result, rms_settled, sentence
from casest_problems.bias_gravity import bias_gravity, bias_gravity_position

RATE = 25.0
#: Noises at the rate of the tests.
SIGMA = {"a": 0.005, "omega": np.radians(0.1), "v": 0.01}


def flight(sensors=Sensors(), seed=0, seconds=30.0):
    rng = np.random.default_rng(seed)
    motion = flights.somewhere(rng)
    return flights.record(motion, np.arange(0, seconds, 1 / RATE), rng, sensors, SIGMA)


def names(closing):
    return [a.candidate.label for a in closing.effects]


# -- the loop ----------------------------------------------------------------------------------


@pytest.mark.long
def test_a_flight_that_lacks_nothing_is_adequate():
    closing = close_motion(bias_gravity, flight(seed=1, seconds=20))
    assert names(closing) == []
    result = motion_result(closing, model_name="bias-gravity", data=[])
    assert result.verdict == "adequate"
    assert result.before.rmse_holdout == result.after.rmse_holdout


@pytest.mark.long
def test_a_body_in_its_place_beside_a_noisy_gyro_lacks_nothing():
    """A factor that took the accelerometer away, and with it its noise, explained zero best."""
    t = np.arange(0, 60, 0.02)
    rate, _ = flights.SPINS["all axes, 1 °/s"]
    rng, sigma = np.random.default_rng(0), {"a": 0.02, "omega": np.radians(1.0), "v": 0.01}
    exact = {
        "a": flights.BIAS - flights.spun(rate, t),
        "omega": rate(t),
        "v": np.zeros((len(t), 3)),
    }
    signals = {n: x + sigma[n] * rng.standard_normal(x.shape) for n, x in exact.items()}
    run = Run.raw("spun", signals, units=flights.UNITS, time=t)
    model = bias_gravity.sensing(**{n: s**2 * 0.02 for n, s in sigma.items()})
    closing = close_motion(model, run)
    assert (closing.verdict, names(closing)) == ("adequate", [])


@pytest.mark.long
@pytest.mark.parametrize(
    ("sensors", "label", "planted", "alike"),
    [
        (Sensors(gyro_bias=(0.01, -0.005, 0.004)), "bias of omega", [0.01, -0.005, 0.004], ()),
        # So large that the matched intensities swallow it at first.
        (Sensors(gyro_bias=(0.1, -0.05, 0.04)), "bias of omega", [0.1, -0.05, 0.04], ()),
        # Not a whole number of samples, and no longer small against a period of the motion.
        (Sensors(delay=0.31), "time_delay of v", [0.31], ()),
        # A scale of the velocity does the same: the unknown gravity follows either.
        (Sensors(gain=0.03), "gain of a", [0.03, 0.03, 0.03], ("gain of v",)),
    ],
    ids=["gyro bias", "large gyro bias", "delay", "scale"],
)
def test_a_planted_effect_is_found_and_named_with_its_size(sensors, label, planted, alike):
    closing = close_motion(bias_gravity, flight(sensors, seed=3))
    assert names(closing) == [label]
    assert set(alike) <= set(closing.effects[0].indistinguishable_from)
    ((_, value),) = closing.after.added
    np.testing.assert_allclose(value, planted, atol=4 * closing.after.std.max())
    before, after = rms_settled(closing)
    assert after < before
    assert rise(closing.after, closing.before) > 50
    # The report shows the smoother's spread, which is below the filter's at the beginning.
    fit = closing.after.found
    first, later = (np.diagonal(P[0]).sum() for P in (fit.P, fit.smoothed_P))
    assert later < 0.1 * first


@pytest.mark.long
@pytest.mark.parametrize("seed", [7, 80_000, 80_001])
def test_what_a_noisy_gyro_leaves_of_a_scale_is_never_claimed_for_another_cause_alone(seed):
    """Noise that was matched to three gains hid their worth: a drift of one number was claimed.

    Alone in the last two of these flights; a rival's refit in the first goes beyond all numbers.
    """
    rng = np.random.default_rng(seed)
    sigma = {**flights.SIGMA, "omega": np.radians(0.5)}
    t = np.arange(0, 60, 0.02)
    run = flights.record(flights.somewhere(rng), t, rng, Sensors(gain=0.01), sigma)
    closing = close_motion(bias_gravity, run)
    assert closing.effects
    for effect in closing.effects:
        assert "gain of a" in (effect.candidate.label, *effect.indistinguishable_from)


@pytest.mark.long
@pytest.mark.parametrize(
    "sensors",
    [Sensors(lever=(0.1, -0.05, 0.07)), Sensors(gyro_bias=(0.002, -0.001, 0.0015))],
    ids=["lever arm", "gyro bias"],
)
def test_what_is_far_less_likely_is_not_called_alike(sensors):
    """Innovations in the deviations of each fit are one in the mean: held-out squares said nothing,
    and what was hundreds behind in likelihood was "not told apart"."""
    rng = np.random.default_rng(360_000)
    motion = flights.somewhere(rng)
    run = flights.record(motion, np.arange(0, 60, 0.02), rng, sensors)
    (effect,) = close_motion(bias_gravity, run).effects
    assert effect.candidate.label in ("lever_arm of v", "bias of omega")
    assert effect.indistinguishable_from == ()


@pytest.mark.long
def test_coloured_noise_becomes_a_state_and_nothing_else_is_named():
    closing = close_motion(bias_gravity, flight(Sensors(colour=0.5, coloured=0.03), seed=4))
    assert names(closing) == ["coloured_noise of v"]
    (effect,) = motion_result(closing, model_name="bias-gravity", data=[]).effects
    assert 0.2 < effect.parameters["correlation_time"].value < 1.2
    assert 0.015 < effect.parameters["std"].value < 0.06


@pytest.mark.long
def test_a_disturbance_with_a_colour_of_its_own_is_named():
    """What the accelerometer lacks is slow: from sample to sample it shows no such noise."""
    run, still = flight(seed=2), bias_gravity.driven(bias=0.0)
    slow = flights.coloured(run.time, 0.5, 0.1, np.random.default_rng(12))
    closing = close_motion(still, flights.with_signals(run, a=run.signals["a"] + slow))
    assert names(closing) == ["coloured_noise of a"]
    assert not closing.loud


@pytest.mark.long
def test_a_state_that_must_be_driven_absurdly_is_no_answer():
    """A force that comes and goes in steps is no drift of the mass' speed."""

    @dynamics
    def cart(
        x=signal("m"),
        *,
        place=state("m"),
        speed=state("m/s", intensity=1e-6),
    ):
        return Motion(rates={"place": speed}, outputs=(measured(x, place, std=0.001),))

    t = np.arange(0, 40, 0.04)
    rng = np.random.default_rng(5)
    kicks = np.where(np.arange(len(t)) % 53 == 0, rng.choice([-0.3, 0.3], len(t)), 0.0)
    x = np.cumsum(np.cumsum(kicks)) * 0.04 + 0.001 * rng.standard_normal(len(t))
    run = Run.raw("cart", {"x": x[:, None]}, units={"x": "m"}, time=t)
    closing = close_motion(cart, run)
    assert closing.verdict == "unexplained"
    result = motion_result(closing, model_name="cart", data=[])
    factor = closing.loud["speed"]
    assert factor > 500
    assert f"speed is driven by {factor:.2g} times the intensity that was declared" in sentence(
        result
    )


@pytest.mark.long
@pytest.mark.parametrize("kind", ["g-sensitivity", "knock", "temperature"])
def test_an_effect_of_the_sensors_catalogue_is_found_in_motion(kind):
    """The other kinds: `studies/flight_loop.py`."""
    changed, label, _ = flights.CHANGES[kind]
    rng = np.random.default_rng(2)
    motion, t = flights.somewhere(rng), np.arange(0, 40, 1 / RATE)
    run = changed(flights.record(motion, t, rng, Sensors(), SIGMA), motion, t)
    closing = close_motion(bias_gravity, run)
    assert names(closing) == [label]
    assert closing.verdict == "extended"


@pytest.mark.long
def test_what_one_sample_says_adds_up_to_what_all_say():
    """The adjoint of the sensitivities: pushes summed over the samples are Hᵀz."""
    run = with_columns(bias_gravity, flight(seed=6, seconds=20))
    fit = fitted(bias_gravity, run, filtered(bias_gravity, run).smoothed)
    for candidate in candidates(bias_gravity, run):
        if candidate.label in ("bias of omega", "bias_step of v", "quadratic of a"):
            own = sensitivity(bias_gravity, [], [candidate], fit.run, fit.found)
            said = pushes(bias_gravity, [], candidate, fit.run, fit.found, own.z[:, :, None])
            together = np.einsum("kij,ki->j", own.H, own.z)
            np.testing.assert_allclose(said[:, :, 0].sum(axis=0), together, rtol=1e-8)


@pytest.mark.parametrize("seeds", [[0], pytest.param([1, 2], marks=pytest.mark.long)])
def test_a_right_nonlinear_model_is_adequate(seeds):
    """A pendulum whose length is found: the filter that steps forward is far off at first."""

    @dynamics
    def pendulum(
        y=signal("rad"),
        *,
        angle=state("rad", start=0.3, std=0.3),
        rate=state("rad/s", std=1.0),
        length=state("m", start=1.5, std=1.0),
    ):
        rates = {"angle": rate, "rate": -9.81 / length * sin(angle)}
        return Motion(rates=rates, outputs=(measured(y, angle, intensity=2e-8),))

    t = np.arange(0, 20, 0.02)
    for seed in seeds:
        rng = np.random.default_rng(300 + seed)
        start = [rng.uniform(0.3, 1.2), rng.uniform(-0.5, 0.5)]
        swing = solve_ivp(lambda _, x: [x[1], -9.81 / 0.8 * np.sin(x[0])], (0, 20), start,
                          t_eval=t, rtol=1e-11, atol=1e-12)  # fmt: skip
        y = swing.y[0] + 0.001 * rng.standard_normal(len(t))
        closing = close_motion(pendulum, Run.raw("p", {"y": y[:, None]}, units={}, time=t))
        assert (closing.verdict, names(closing)) == ("adequate", [])
        end, P = closing.after.found.end
        assert abs(end[2] - 0.8) < 4 * np.sqrt(P[2, 2])


@pytest.mark.long
@pytest.mark.parametrize(
    ("sensors", "found"),
    [(Sensors(), []), (Sensors(lever=(0.3, -0.1, 0.2)), ["lever_arm of v"])],
    ids=["nothing missing", "lever arm"],
)
def test_a_gap_in_time_is_no_effect_and_hides_none(sensors, found):
    rng = np.random.default_rng(1)
    t = np.arange(0, 40, 1 / RATE)
    t = t[(t < 20) | (t > 24)]
    run = flights.record(flights.somewhere(rng), t, rng, sensors, SIGMA)
    closing = close_motion(bias_gravity, run)
    assert names(closing) == found
    assert closing.left.p_value > 1e-3


@pytest.mark.long
def test_a_delay_is_found_where_samples_come_at_uneven_times():
    rng = np.random.default_rng(7)
    t = np.cumsum(rng.uniform(0.02, 0.06, 750))
    run = flights.record(flights.somewhere(rng), t, rng, Sensors(delay=0.25), SIGMA)
    closing = close_motion(bias_gravity, run)
    assert names(closing) == ["time_delay of v"]
    ((_, value),) = closing.after.added
    assert abs(value[0] - 0.25) < 4 * closing.after.std[0]


@pytest.mark.long
def test_readings_that_come_a_second_late_are_found_late():
    """Moved by 25 samples they are fewer: what is refitted was compared row by row, and failed."""
    closing = close_motion(bias_gravity, flight(Sensors(delay=1.0), seed=2))
    assert names(closing) == ["time_delay of v"]
    ((_, value),) = closing.after.added
    assert abs(value[0] - 1.0) < 4 * closing.after.std[0]


def test_readings_that_were_moved_are_given_back_in_their_rows():
    run = flight(seconds=2)
    for shift in (3, -2):
        moved = shifted(bias_gravity, run, {"v": shift})
        off = moved.signals["v_moved"][5:-5, 0]
        np.testing.assert_allclose(off, shift / RATE)
        back = by_reading(bias_gravity, {"v": shift}, moved.signals["v"])
        kept = np.isfinite(back).all(axis=1)
        assert np.sum(~kept) == abs(shift)
        np.testing.assert_array_equal(back[kept], run.signals["v"][kept])


# -- its parts ---------------------------------------------------------------------------------


@dynamics
def sledge(
    a=signal("m/s^2"),
    v=signal("m/s"),
    *,
    speed=state("m/s", std=1.0),
    bias=state("m/s^2", std=1.0),
):
    """On rails: an accelerometer with a bias, and a speed."""
    return Motion(rates={"speed": a - bias}, outputs=(measured(v, speed, std=0.01),))


def standing(std):
    """A record of the sledge in its place, an accelerometer with a bias and so much noise."""
    t, rng = np.arange(0, 20, 0.02), np.random.default_rng(0)
    a = 0.3 + std * rng.standard_normal((len(t), 1))
    v = 0.01 * rng.standard_normal((len(t), 1))
    return Run.raw("r", {"a": a, "v": v}, units={"a": "m/s^2", "v": "m/s"}, time=t)


@pytest.mark.parametrize("std", [0.05, 0.5])
def test_noise_that_an_effect_would_take_away_is_no_evidence_for_it(std):
    """A reading of noise about a constant says nothing of a factor: the bias may follow any."""
    model = sledge.sensing(a=std**2 * 0.02)
    run = with_columns(model, standing(std))
    fit = fitted(model, run, filtered(model, run).smoothed)
    labels = ("gain of a", "gain_by_sign of a", "quadratic of a", "cubic of a")
    subject = Innovations(run, tuple(c for c in candidates(model, run) if c.label in labels))
    trials = subject.trials(fit)
    assert len(trials) == len(labels)
    for trial in trials:
        better = subject.refit(fit, [trial])
        if isinstance(better, str):
            assert better.startswith("it would leave 0.0")
        else:
            assert abs(rise(better, fit)) < 0.5


def test_innovations_of_one_fit_in_the_deviations_of_another():
    """Those of a filter with the wrong bias, by the covariances of the right one."""
    run = standing(0.05)
    model = sledge.sensing(a=0.05**2 * 0.02)
    subject = Innovations(with_columns(model, run), ())
    fit = fitted(model, subject.run, filtered(model, run).smoothed)
    stiff = model.sensing(a=1e-6 * 0.05**2 * 0.02)
    other = fitted(stiff, subject.run, filtered(stiff, run).smoothed, bounded=True)
    there = subject.linear_in(fit, other)
    expected = [
        solve_triangular(np.linalg.cholesky(S), nu, lower=True)
        for S, nu in zip(fit.found.S, other.found.innovations, strict=True)
    ]
    np.testing.assert_allclose(there.residual, expected, rtol=1e-8, atol=1e-10)
    assert np.std(subject.linear(other).residual) == pytest.approx(1, rel=0.1)
    assert np.std(there.residual) > 1.1 * np.std(subject.linear(fit).residual)


def test_without_what_a_refit_adds_means_through_the_filter_of_the_refit():
    """Against that filter itself, run without the lever arm; the declared model's own noise, which
    allows for it, leaves quite other innovations in every row."""
    run = flight(Sensors(lever=(0.3, -0.1, 0.2)), seed=5, seconds=16)
    subject = Innovations(with_columns(bias_gravity, run), tuple(candidates(bias_gravity, run)))
    declared = fitted(bias_gravity, subject.run, filtered(bias_gravity, run).smoothed)
    (arm,) = [t for t in subject.trials(declared) if t.what.label == "lever_arm of v"]
    more = subject.refit(declared, [arm])
    less, whole = subject.compared(declared, more)
    found = filtered(applied(bias_gravity, more.intensities), subject.run)
    expected = [
        solve_triangular(np.linalg.cholesky(S), nu, lower=True)
        for S, nu in zip(found.S, found.innovations, strict=True)
    ]
    effect = np.std(whole.residual - less.residual)
    assert np.std(less.residual - expected) < 0.05 * effect  # to first order
    assert np.std(subject.linear(declared).residual - expected) > 0.2 * effect


@pytest.mark.long
@pytest.mark.parametrize("seed", [400_100, 400_101])
def test_two_causes_at_once_are_both_named(seed):
    """Of the second the likelihood rises by less noise, hardly by smaller innovations."""
    rng = np.random.default_rng(seed)
    motion, t = flights.somewhere(rng), np.arange(0, 60, 1 / 50)
    two = Sensors(gyro_bias=(0.002, -0.001, 0.0015), lever=(0.1, -0.05, 0.07))
    closing = close_motion(bias_gravity, flights.record(motion, t, rng, two, flights.SIGMA))
    assert sorted(names(closing)) == ["bias of omega", "lever_arm of v"]


def test_a_true_input_is_found_from_its_reading_however_large_the_effect_is():
    found = {c.label: c for c in candidates(sledge, with_columns(sledge, standing(0.05)))}
    reading, k = np.array([[2.0], [-2.0]]), ca.SX.sym("k")

    def true(label, value):
        y = ca.SX.sym("y")
        changed = found[label].changed(y, k, Body(read={"a": y}))
        function = ca.Function("true", [y, k], [changed])
        return np.array([float(function(r, value)) for r in reading[:, 0]])

    for value in (0.98, -0.98):  # 1 + k above zero, 1 - k below
        expected = reading[:, 0] / (1 + value * np.sign(reading[:, 0]))
        np.testing.assert_allclose(true("gain_by_sign of a", value), expected, rtol=1e-12)
    root = (np.sqrt(1 + 4 * 0.05 * reading[:, 0]) - 1) / (2 * 0.05)
    np.testing.assert_allclose(true("quadratic of a", 0.05), root, rtol=1e-9)


def test_what_an_effect_leaves_of_its_signal():
    found = {c.label: c for c in candidates(sledge, with_columns(sledge, standing(0.05)))}
    signals = {"a": np.full((3, 1), 2.0), "v": np.array([[3.0], [np.nan], [3.0]])}
    left = {("gain of a", 3.0): 0.25, ("gain of v", -0.9): 0.1, ("bias of v", 7.0): 1.0,
            ("time_delay of v", 0.3): 1.0, ("dead_zone of v", 4.0): 0.0}  # fmt: skip
    for (label, k), share in left.items():
        assert found[label].left_of(np.array([k]), signals) == pytest.approx(share)
    assert found["quadratic of a"].left_of(np.array([1e7]), signals) < 1e-3


def test_readings_slower_than_the_inputs_are_enough():
    """Five readings a second, 25 of the inputs: one candidate, scored and then fitted."""
    run = flight(Sensors(lever=(0.3, -0.1, 0.2)), seed=5, seconds=16)
    v = run.signals["v"].copy()
    v[np.arange(len(v)) % 5 != 0] = np.nan
    run = Run.raw("slow", {**run.signals, "v": v}, units=flights.UNITS, time=run.time)
    fit = fitted(bias_gravity, run, filtered(bias_gravity, run).smoothed)
    tried = [c for c in candidates(bias_gravity, run) if c.label == "lever_arm of v"]
    subject = Innovations(run, tuple(tried))
    (evidence,) = ranked(subject, fit).found
    assert evidence.p_value < 1e-4
    better = subject.refit(fit, evidence.trials)
    ((_, arm),) = better.added
    assert np.all(np.abs(arm - [0.3, -0.1, 0.2]) < 4 * better.std)


@pytest.mark.parametrize(
    "labels",
    [
        pytest.param({"bias of omega", "lever_arm of v", "time_delay of v"}, id="some"),
        pytest.param(None, id="all", marks=pytest.mark.long),
    ],
)
def test_sensitivities_are_the_differences_of_two_filters(labels):
    """Of effects at a small size; the filter's gains are the same on both sides.

    To 1 %, after the start: they are taken along the smoothed states, not those of the filter.
    """
    run = with_columns(bias_gravity, flight(seed=6, seconds=20))
    run = shifted(bias_gravity, run, {})  # says that nothing was moved
    # Constant intensities: the noise of the inputs would be taken along other states.
    model = bias_gravity.driven(velocity=1e-5, gravity=1e-5, bias=1e-8).sensing(v=1e-5)
    found = filtered(model, run)
    # A dead zone is a kink where the reading crosses zero: no difference shows its slope there.
    tried = [c for c in candidates(bias_gravity, run) if c.effect.name != "dead_zone"]
    tried = [c for c in tried if labels is None or c.label in labels]
    assert labels is None or len(tried) == len(labels)
    answers = sensitivity(model, [], tried, run, found)
    for candidate, where in zip(tried, answers.columns, strict=True):
        typical = np.where(np.isfinite(candidate.typical), candidate.typical, 1e-3)
        k = np.minimum(1e-5, 1e-2 * typical) * np.arange(1, candidate.size + 1)
        there = filtered(extended(model, [(candidate, k)]), run)
        expected = found.innovations - there.innovations
        linear = np.einsum("kij,kjl,l->ki", answers.L, answers.H[:, :, where], k)
        off, size = np.abs(linear - expected)[100:], np.abs(expected)[100:]
        assert off.max() < 0.01 * size.max(), candidate.label


def test_matched_intensities_are_those_of_the_sensors():
    run = flight(seed=7, seconds=120)
    ready = prepared(bias_gravity, run, filtered(bias_gravity, run).smoothed)
    found, best = matched(ready, run)
    truth = {name: sigma**2 / RATE for name, sigma in SIGMA.items()}
    assert abs(np.log(found["v"] / truth["v"])) < 0.1
    assert abs(np.log(found["omega"] / truth["omega"])) < 0.7
    assert best > likelihood(ready, {**truth, "bias": 1e-14}) - 0.5
    guess = first_guess(ready, run)
    for name, value in truth.items():
        assert abs(np.log(guess[name] / value)) < 0.25, name


def test_whiteness_rejects_as_often_as_it_says():
    rng = np.random.default_rng(0)
    p = np.array([whiteness(rng.standard_normal((1500, 3))).p_value for _ in range(400)])
    assert abs(np.mean(p < 0.05) - 0.05) < 3 * np.sqrt(0.05 * 0.95 / len(p))


def test_correlated_innovations_are_not_white():
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((2001, 3))
    assert whiteness(noise[1:] + 0.2 * noise[:-1]).p_value < 1e-6


def test_a_bias_that_is_a_state_already_is_no_candidate():
    labels = [c.label for c in candidates(bias_gravity, flight(seconds=2))]
    assert "bias of a" not in labels
    assert {"bias of omega", "gain of a", "lever_arm of v", "time_delay of v"} <= set(labels)


def test_units_of_effects_are_those_of_the_quantities():
    tried = candidates(bias_gravity, with_columns(bias_gravity, flight(seconds=2)))
    units = {c.label: c.numbers[0].unit for c in tried}
    assert units["bias of omega"] == "rad/s"
    assert units["lever_arm of v"] == "m"
    assert units["time_delay of v"] == "s"
    assert units["gain of a"] == "1"
    assert units["quadratic of a"] == "1/(m/s^2)"
    assert units["g_sensitivity(a) of omega"] == "(rad/s)/(m/s^2)"


def test_a_lever_arm_is_one_of_a_speed_not_of_a_position():
    run = flight(seconds=2)
    signals = {"a": run.signals["a"], "omega": run.signals["omega"], "p": run.signals["v"]}
    there = Run.raw("p", signals, units={}, time=run.time)
    labels = [c.label for c in candidates(bias_gravity_position, there)]
    assert "bias of p" in labels
    assert not any("lever" in label for label in labels)


def test_an_effect_leaves_what_is_known_exactly_as_it_was():
    """A constraint of the declaration holds in the extended one too."""

    @dynamics
    def heavy(
        a=signal(3, "m/s^2"),
        omega=signal(3, "rad/s"),
        v=signal(3, "m/s"),
        *,
        velocity=state(3, "m/s"),
        gravity=state(3, "m/s^2", start=(0.0, 0.0, 9.8), std=1.0),
    ):
        rates = {
            "velocity": a - cross(omega, velocity) + gravity,
            "gravity": -cross(omega, gravity),
        }
        return Motion(
            rates=rates,
            outputs=(measured(v, velocity, intensity=0.1),),
            constraints=(constraint(norm_2(gravity), 9.8),),
        )

    tried = [c for c in candidates(heavy, flight(seconds=2)) if c.on == "v"]
    grown = extended(heavy, [(c, np.ones(c.size)) for c in tried], Colour("v", 3, "m/s", 1.0, 0.1))
    assert len(grown.function(**symbols(grown)).constraints) == 1


def symbols(model):
    import casadi as ca

    return {s.name: ca.SX.sym(s.name, s.size) for s in (*model.signals, *model.states)}


# -- the command -------------------------------------------------------------------------------


@pytest.fixture
def record(tmp_path):
    run = flight(Sensors(lever=(0.3, -0.1, 0.2)), seed=3, seconds=16)
    path = tmp_path / "flight.csv"
    head = ",".join(f"{s}{x} [{u}]" for s, u in flights.UNITS.items() for x in "xyz")
    columns = [run.time, *(run.signals[s] for s in flights.UNITS)]
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=f"t [s],{head}", comments="")
    return path


def test_close_writes_what_the_design_says(record, tmp_path, capsys):
    assert cli.run(["close", "bias-gravity", str(record), "-o", str(tmp_path / "out")]) == 0
    assert "extended: lever_arm of v was missing" in " ".join(capsys.readouterr().out.split())
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert content["verdict"] == "extended"
    assert [(e["name"], e["on"]) for e in content["effects"]] == [("lever_arm", "v")]
    arm = content["effects"][0]["parameters"]["k"]
    assert np.all(np.abs(np.subtract(arm["value"], [0.3, -0.1, 0.2])) < 4 * np.array(arm["std"]))
    assert arm["unit"] == "m"
    assert content["after"]["rmse_holdout"] < content["before"]["rmse_holdout"]
    assert set(content["before"]["rmse_holdout_by_axis"]) == {"v[0]", "v[1]", "v[2]"}
    assert content["before"]["certificate"]["trusted"]
    with (tmp_path / "out" / "residuals.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["file", "run", "row", "t", "axis", "split", "before", "after"]
    assert len(rows) == 2 * 3 * 400
    assert "lever_arm of v was missing" in (tmp_path / "out" / "report.html").read_text()


def test_options_of_calibrations_are_refused(record, capsys):
    assert cli.run(["close", "bias-gravity", str(record), "--fix", "bias=0"]) == 1
    assert "--fix is for calibrations; bias-gravity is an estimator" in capsys.readouterr().err


def test_a_record_too_short_to_hold_any_of_it_out_is_refused():
    with pytest.raises(DataError, match="100 samples are too few to hold some of them out"):
        close_motion(bias_gravity, flight(seconds=4))
