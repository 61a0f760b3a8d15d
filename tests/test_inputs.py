"""Noise of a measured input is no motion: at rest it is at rest, on one axis it stays on it."""

from __future__ import annotations

import json
from functools import lru_cache

import flights
import numpy as np
import pytest
from scipy.stats import chi2

from casest import Run, constant, cross, signal, sin
from casest.cli import run as cli
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.filter import coefficients, filtered
from casest.dynamics.gramian import Products, gramian, observed, over_windows
from casest.dynamics.inputs import estimate, scatter, unstated
from casest.dynamics.record import least_squares
from casest.report.text.observability import observe_text
from casest.results.fitted import WeakCombination
from casest.results.observability import ObservedParameters, observe_motion
from casest.results.result import reproduced
from casest.results.states import follow
from casest.results.trajectory import weakly_told
from casest_problems.bias_gravity import bias_gravity

DT, SIGMA = 0.02, {"a": 0.02, "v": 0.01}
T = np.arange(0, 30, DT)
PRIOR = {"velocity": 0.01, "gravity": 10.0, "bias": 1.0}


def estimator(degrees, declared=bias_gravity):
    sigma = SIGMA | ({"omega": np.radians(degrees)} if degrees else {})
    quiet = declared.driven(velocity=0.0, gravity=0.0, bias=0.0).known_to(**PRIOR)
    return quiet.sensing(**{name: s**2 * DT for name, s in sigma.items()})


@lru_cache
def turned(spin):
    return flights.spun(flights.SPINS[spin][0], T)


def record(spin, degrees, seed=0):
    """A body that stays where it is and turns, and its true states (N, 9)."""
    rate, rng = flights.SPINS[spin][0], np.random.default_rng(seed)
    omega, gravity = rate(T), turned(spin)
    exact = {"a": flights.BIAS - gravity, "omega": omega, "v": 0 * omega}
    sigma = {**SIGMA, "omega": np.radians(degrees)}
    signals = {n: x + sigma[n] * rng.standard_normal(x.shape) for n, x in exact.items()}
    truth = np.hstack([0 * gravity, gravity, np.tile(flights.BIAS, (len(T), 1))])
    return Run.raw("spun", signals, units=flights.UNITS, time=T), truth


def test_the_spins_turn_as_they_say():
    """Gravity in body axes changes by −omega × gravity: by finite differences."""
    for spin, (rate, _) in flights.SPINS.items():
        g = turned(spin)
        expected = -np.cross(rate(T), g)
        np.testing.assert_allclose(np.gradient(g, T, axis=0)[2:-2], expected[2:-2], atol=5e-4)


# -- what a trajectory shows -----------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0.05, 1.0])
@pytest.mark.parametrize("spin", flights.SPINS)
def test_the_rank_is_that_of_the_motion_whatever_the_noise(spin, degrees):
    run, model = record(spin, degrees)[0], estimator(degrees)
    assert observed(model, gramian(model, coefficients(model, run))).rank == 3 + known(spin)


@pytest.mark.parametrize("spin", ["at rest", "one axis, 1 °/s"])
def test_noise_that_nobody_stated_is_found_and_left_out_too(spin):
    told = observe_motion(estimator(0.0), record(spin, 0.2)[0])
    assert (told.rank, told.structural_rank) == (3 + known(spin), 9)


def known(spin):
    """Of the six numbers of gravity and bias."""
    return flights.SPINS[spin][1]


def test_without_noise_of_inputs_the_bound_is_the_gramians():
    run = record("all axes, 30 °/s", 0.0)[0]
    model = estimator(0.0)
    noisy = model.sensing(omega=1e-20)
    one, other = (gramian(m, coefficients(m, run)) for m in (model, noisy))
    np.testing.assert_allclose(np.linalg.inv(other), np.linalg.inv(one), rtol=1e-3, atol=1e-12)


def test_what_the_noise_of_inputs_hides_is_what_the_smoother_says():
    """What all readings tell of the first state, from a prior that tells nothing."""
    run = record("all axes, 30 °/s", 0.2)[0]
    model = estimator(0.2)
    system = coefficients(model, run)
    std = observed(model, gramian(model, system)).std
    wide = model.known_to(velocity=1e3, gravity=1e3, bias=1e3)
    smoothed = filtered(wide, run, system=system).smoothed_P[0]
    # The smoother counts single readings, the Gramian a curve: half a sample in 1500.
    np.testing.assert_allclose(std, np.sqrt(np.diag(smoothed)), rtol=0.05)
    assert np.all(std[3:6] > 3 * observed(model, gramian(*exact(model, run))).std[3:6])


def exact(model, run):
    """The model with inputs that are taken for exact, along the record."""
    quiet = estimator(0.0)
    return quiet, coefficients(quiet, run)


def test_what_is_told_less_well_than_it_was_known_is_weak():
    rate, t = flights.SPINS["all axes, 1 °/s"][0], T[::4]
    gravity = turned("all axes, 1 °/s")[::4]
    signals = {"a": flights.BIAS - gravity, "omega": rate(t), "v": 0 * gravity}
    run = Run.raw("slow", signals, units=flights.UNITS, time=t)
    model = estimator(0.0).sensing(v=1e4)
    told = observe_motion(model, run)
    assert told.rank == 9
    assert told.weak
    assert all("is told to" in words and "was known beforehand" in words for words in told.weak)
    assert not observe_motion(estimator(0.0), run).weak


def test_a_weak_direction_is_named_without_the_shares_of_rounding():
    """Nearly one axis: -0.00595 of a velocity beside it would be no part of a sentence."""
    t = T[::4]
    rate = (0.1 + 0.3 * np.sin(0.4 * t))[:, None] * flights.AXIS
    rate[:, 0] += 1e-3 * np.cos(t)

    def turning(s):
        return np.column_stack([np.interp(s, t, part) for part in rate.T])

    gravity = flights.spun(turning, t)
    signals = {"a": flights.BIAS - gravity, "omega": rate, "v": 0 * gravity}
    run = Run.raw("slow", signals, units=flights.UNITS, time=t)
    told = observed(bias_gravity, gramian(bias_gravity, coefficients(bias_gravity, run)))
    (words,) = told.weak
    assert words.startswith("gravity and bias along the body axis (0.27, 0.53, 0.80) move together")
    assert told.rank == 9


def test_windows_that_hide_a_direction_say_zero_and_no_rounding():
    run = record("at rest", 0.0)[0].take(slice(0, None, 10))
    smallest = over_windows(Products.of(bias_gravity, run), 3.0, 3).eigenvalues[:, :3]
    assert np.all(smallest == 0)


def test_a_calibration_of_full_rank_whose_numbers_say_nothing_is_called_weak():
    """A wheel seen for 2 s: offset[2] to 2.8e8 m/s^2 is not "every unknown is determined"."""
    weak = WeakCombination("offset[2] +2.9e+06, gain[2] -6.4e+05", 1.17e9, 2.8e8)
    told = ObservedParameters(
        model="wheel", rank=15, unknowns=15, unobservable=[], weak=[weak], std={"offset": [2.8e8]},
        trusted=False, data=[], reproduce=reproduced("", ()),
    )  # fmt: skip
    text = observe_text(told)
    assert text.startswith("wheel: rank 15 of 15, 1 of them weak\n  - weak: offset[2] +2.9e+06")
    assert "every unknown is determined" not in text


# -- the filter and the smoother -------------------------------------------------------------------


def hidden():
    """The same estimator, written so that nobody sees that it is linear."""

    @dynamics
    def hidden(
        a=signal(3, "m/s^2"),
        omega=signal(3, "rad/s"),
        v=signal(3, "m/s"),
        *,
        velocity=state(3, "m/s"),
        gravity=state(3, "m/s^2"),
        bias=state(3, "m/s^2"),
        ghost=constant(1e-300, "m/s^2"),
    ):
        turned = a - cross(omega, velocity) + gravity - bias + ghost * sin(velocity[0])
        rates = {"velocity": turned, "gravity": -cross(omega, gravity)}
        return Motion(rates=rates, outputs=(measured(v, velocity, intensity=0.1),))

    return hidden


@pytest.mark.parametrize(
    ("declared", "spin", "degrees"),
    [
        pytest.param(bias_gravity, "at rest", 1.0, id="linear, at rest"),
        pytest.param(
            *(bias_gravity, "one axis, 17 °/s", 0.2),
            id="linear, one axis",
            marks=pytest.mark.long,
        ),
        pytest.param(
            *(hidden(), "all axes, 1 °/s", 0.2),
            id="nonlinear, all axes",
            marks=pytest.mark.long,
        ),
    ],
)
def test_errors_are_no_larger_than_they_are_said_to_be(declared, spin, degrees):
    """Noise that counts as motion gives 10 000 at rest, where nine are expected.

    Two hundred flights of each kind are a study (studies/inputs.py)."""
    squares, flown = [], 10 if declared is bias_gravity else 4
    for seed in range(flown):
        run, truth = record(spin, degrees, seed)
        rng = np.random.default_rng([seed, 1])
        start = truth[0] + np.repeat(list(PRIOR.values()), 3) * rng.standard_normal(9)
        model = estimator(degrees, declared)
        found = filtered(
            model.beginning(velocity=start[:3], gravity=start[3:6], bias=start[6:]), run
        )
        for x, P in ((found.x, found.P), (found.smoothed, found.smoothed_P)):
            e = x[len(T) // 2] - truth[len(T) // 2]
            squares.append(e @ np.linalg.solve(P[len(T) // 2], e))
    assert np.mean(squares[::2]) < chi2.ppf(0.9995, 9 * flown) / flown
    assert np.mean(squares[1::2]) < chi2.ppf(0.9995, 9 * flown) / flown
    assert np.mean(squares) > chi2.ppf(0.0005, 9 * flown) / flown  # and not much smaller either


def test_a_rate_as_small_as_the_noise_of_one_reading_deceives_no_filter():
    """Along the filter's own states: 58 and 59, of a χ² with nine degrees of freedom."""
    run, truth = record("all axes, 1 °/s", 1.0, seed=7)
    rng = np.random.default_rng([7, 1])
    start = truth[0] + np.repeat(list(PRIOR.values()), 3) * rng.standard_normal(9)
    begun = estimator(1.0).beginning(velocity=start[:3], gravity=start[3:6], bias=start[6:])
    found = filtered(begun, run)
    for k in (len(T) // 2, -1):
        e = found.x[k] - truth[k]
        assert e @ np.linalg.solve(found.P[k], e) < chi2.ppf(1 - 1e-4, 9)


@pytest.mark.parametrize(
    ("spin", "weak"), [("one axis, 17 °/s", ["bias[2]"]), ("all axes, 30 °/s", [])]
)
def test_what_a_record_tells_less_of_than_was_declared_is_called_weak(spin, weak):
    """Of gravity and bias along the axis only the sum is seen, and known to ± 10 and ± 1."""
    left = flights.AXIS[2] / np.sqrt(1 + PRIOR["bias"] ** 2 / PRIOR["gravity"] ** 2)
    run = record(spin, 0.0)[0].take(slice(0, 900))
    result = follow(estimator(0.0), run)
    said = [note for note in result.notes if note.startswith("weak: ")]
    assert said == weakly_told(filtered(estimator(0.0), run))  # as close does
    assert [f"weak: {name} (± {left:.3g} m/s^2 at the end, ± 1 declared" for name in weak] == [
        note.partition(" of the start")[0] for note in said
    ]


def test_where_noise_acts_on_what_stays_hidden_the_filter_says_that_it_claims_too_much():
    told = follow(estimator(1.0), record("one axis, 17 °/s", 1.0)[0])
    claim = "squared errors of all states together may be as small as"
    assert any(claim in note for note in told.notes)
    assert 0.5 < told.filtered.least < 0.9  # NEES of 200 runs: 7.5 of 9 (studies/inputs.md)
    assert filtered(estimator(0.2), record("all axes, 30 °/s", 0.2)[0]).least > 0.99


@pytest.mark.parametrize("declared", [bias_gravity, hidden()], ids=["linear", "nonlinear"])
def test_smoother_and_least_squares_agree(declared):
    run = record("all axes, 30 °/s", 0.2)[0].take(slice(200))
    model = estimator(0.2, declared)
    found, at_once = filtered(model, run), least_squares(model, run)
    std = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))
    assert np.max(np.abs(found.smoothed - at_once.x) / std) < 1e-3
    np.testing.assert_allclose(
        np.sqrt(np.diag(at_once.P_start)), np.sqrt(np.diag(found.smoothed_P[0])), rtol=1e-3
    )


def test_at_rest_nothing_is_told_of_gravity_and_bias_apart():
    run, _ = record("at rest", 1.0)
    found = filtered(estimator(1.0), run)
    np.testing.assert_allclose(found.std[-1, 3:6], 10 / np.sqrt(101), rtol=1e-3)


# -- estimates -------------------------------------------------------------------------------------


def test_an_input_at_rest_is_at_rest():
    noise = 0.01 * np.random.default_rng(0).standard_normal((3000, 3))
    assert np.all(estimate(noise, 1e-4) == 0)


def test_an_input_that_moves_keeps_its_motion_and_loses_its_noise():
    t, rng = np.arange(3000) * DT, np.random.default_rng(1)
    true = (0.3 * np.sin(0.4 * t) + 0.1)[:, None] * flights.AXIS
    found = estimate(true + 0.01 * rng.standard_normal(true.shape), 1e-4)
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.002
    assert np.linalg.matrix_rank(found, tol=1e-9) == 1  # it stays on one axis


@pytest.mark.parametrize("line", [0.0, 0.5])
def test_noise_is_found_beside_slow_and_fast_motion(line):
    t, rng = np.arange(3000) * DT, np.random.default_rng(2)
    values = np.c_[np.sin(t), np.cos(0.3 * t), line * np.sin(2 * np.pi * 17.3 * t)]
    assert scatter(values + 0.01 * rng.standard_normal(values.shape)) == pytest.approx(
        0.01, rel=0.1
    )


def test_of_inputs_without_noise_none_is_found():
    run = record("all axes, 30 °/s", 0.0)[0]
    assert unstated(bias_gravity, run).get("omega", 0.0) < 1e-6
    assert "a" not in unstated(bias_gravity, record("at rest", 0.05)[0])  # no coefficient


# -- through the command line ----------------------------------------------------------------------


@pytest.fixture
def file(tmp_path):
    run, _ = record("one axis, 17 °/s", 0.05)
    head = ["t [s]", *(f"{n}{c} [{u}]" for n, u in flights.UNITS.items() for c in "xyz")]
    table = np.column_stack([T, *(run.signals[n] for n in flights.UNITS)])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header=",".join(head), comments="")
    return str(tmp_path / "r.csv")


STATED = ["--sensor-noise", "omega=8.7e-4", "--sensor-noise", "a=0.02", "--sensor-noise", "v=0.01"]


def test_observe_takes_the_sensors_noise_and_says_what_it_leaves_out(file, capsys):
    assert cli(["observe", "bias-gravity", file, "--json", *STATED]) == 0
    stated = json.loads(capsys.readouterr().out)
    assert stated["rank"] == 8
    assert "omega has noise of 0.00087 rad/s; what that makes of the motion" in stated["notes"][-1]
    assert cli(["observe", "bias-gravity", file, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rank"] == 8
    assert "(--sensor-noise omega=… states it)" in found["notes"][-1]
    assert cli(["observe", "bias-gravity", file, "--json", "--intensity", "omega=1e-5"]) == 0
    louder = json.loads(capsys.readouterr().out)
    assert louder["rank"] == 8
    assert louder["notes"] != stated["notes"]


def test_filter_says_where_noise_is_taken_for_motion(file, capsys):
    assert cli(["filter", "bias-gravity", file, "--json"]) == 0
    notes = " ".join(json.loads(capsys.readouterr().out)["notes"])
    assert "it is taken for motion" in notes
    assert "--sensor-noise omega=0.000" in notes
    assert cli(["filter", "bias-gravity", file, "--json", *STATED]) == 0
    assert "taken for motion" not in " ".join(json.loads(capsys.readouterr().out)["notes"])


@pytest.mark.long
@pytest.mark.parametrize("words", [[], STATED], ids=["found", "stated"])
def test_close_does_not_tell_gravity_from_bias_by_noise(file, capsys, words):
    assert cli(["close", "bias-gravity", file, "--json", *words]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "adequate"
    gravity = told["after"]["parameters"]["gravity"]
    along = np.abs(gravity["std"] @ flights.AXIS)
    assert 0.9 < along < 1.1  # the prior of the bias
