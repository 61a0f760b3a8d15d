"""Noise intensities from stated noise, from a record at rest, and from the flight itself."""

from __future__ import annotations

import json
import re
import sys

import flights
import numpy as np
import pytest
import scipy.stats

from casest import DataError, DeclarationError, Run, UsageError, signal
from casest.cli import run
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.allan import allan
from casest.dynamics.filter import filtered
from casest.dynamics.intensities import from_rest, from_stated, intensities, most_likely
from casest.errors import CasestError
from casest.results.observability import assumed
from casest_problems.bias_gravity import bias_gravity

DT = 0.02
T = np.arange(0, 30, DT)
TRUE = {name: sigma**2 * DT for name, sigma in flights.SIGMA.items()}
NAMES = ["t [s]", *(f"a{c} [m/s^2]" for c in "xyz"), *(f"omega_{c} [rad/s]" for c in "xyz"),
         *(f"v{c} [m/s]" for c in "xyz")]  # fmt: skip


@dynamics
def resting(y=signal("m"), *, place=state("m", std=1e9)):
    return Motion(rates={}, outputs=(measured(y, place, std=0.3),))


@dynamics
def walked(speed=signal("m/s"), y=signal("m"), *, place=state("m", std=1e-3)):
    return Motion(rates={"place": speed}, outputs=(measured(y, place, std=1.0),))


@pytest.fixture(scope="module")
def flight():
    return flights.record(flights.in_the_air(), T, np.random.default_rng(0))


def drifting(count, sigma, walk, seed=0):
    """White noise and a random walk of three axes, (count, 3), at 1/DT per second."""
    rng = np.random.default_rng(seed)
    white = sigma * rng.standard_normal((count, 3))
    return white + np.cumsum(walk * np.sqrt(DT) * rng.standard_normal((count, 3)), axis=0)


# -- stated noise ----------------------------------------------------------------------------------


def test_stated_noise_over_its_rate_is_the_intensity(flight):
    found = from_stated(bias_gravity, flight, flights.SIGMA)
    used = intensities(found.model)
    for name, value in TRUE.items():
        assert used[name] == pytest.approx(value, rel=1e-9)
    assert "velocity" not in used  # driven through the sensors alone
    assert used["bias"] == intensities(bias_gravity)["bias"]


def test_a_sensor_that_is_read_less_often_keeps_its_noise(flight):
    v = flight.signals["v"].copy()
    v[np.arange(len(v)) % 5 > 0] = np.nan
    slow = type(flight).raw("slow", {**flight.signals, "v": v}, units={}, time=flight.time)
    found = filtered(from_stated(bias_gravity, slow, flights.SIGMA).model, slow)
    late = found.normalised_innovations[150:]
    assert abs(late[np.isfinite(late)].mean() - 3) < 0.6  # χ² of 810 over 270, 99.9 %: ±0.5


def test_matched_innovations_are_as_large_as_expected(flight):
    matched = from_stated(bias_gravity, flight, flights.SIGMA).model
    assert filtered(bias_gravity, flight).normalised_innovations[150:].mean() < 0.01
    assert abs(filtered(matched, flight).normalised_innovations[150:].mean() - 3) < 0.3


def uneven(kind, rng):
    """Times of about 50 Hz: a fifth of them dropped, or 1 and 39 ms in turn."""
    if kind == "dropped":
        return T[np.sort(rng.choice(len(T), len(T) * 4 // 5, replace=False))]
    return np.cumsum(np.tile([0.001, 0.039], len(T) // 2))[1:-1]


@pytest.mark.parametrize(
    ("kind", "flown"),
    [
        ("dropped", 5),
        pytest.param("in turn", 5, marks=pytest.mark.long),
        pytest.param("dropped", 40, marks=pytest.mark.long),
        pytest.param("in turn", 40, marks=pytest.mark.long),
    ],
)
def test_stated_noise_is_that_of_one_reading_however_the_rows_lie(kind, flown):
    """Errors and innovations of the flights are χ² of 9 and of 3 a reading; 99.9 % bands."""
    errors, innovations, air = [], [], flights.in_the_air()
    for seed in range(flown):
        rng = np.random.default_rng(seed)
        t = uneven(kind, rng)
        record = flights.record(air, t, rng)
        model = from_stated(bias_gravity, record, flights.SIGMA).model.driven(bias=0.0)
        found = filtered(model, record, smooth=False)
        truth = np.r_[air.velocity(t[-1:])[0], air.gravity(t[-1:])[0], flights.BIAS]
        left = found.x[-1] - truth
        errors.append(left @ np.linalg.solve(found.P[-1], left))
        innovations.append(found.normalised_innovations[150:].mean())
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 9 * flown) / flown
    assert low < np.mean(errors) < high
    assert abs(np.mean(innovations) - 3) < 0.08 * np.sqrt(40 / flown)


def test_steps_that_take_turns_are_no_gaps():
    """An odd number of them has a median of 1 ms."""
    t = uneven("in turn", None)
    record = flights.record(flights.in_the_air(), t, np.random.default_rng(0))
    assert np.median(np.diff(t)) < 0.002
    assert assumed(record) == list(record.notes)


def test_noise_of_an_input_lasts_as_long_as_its_reading_is_held():
    """A distance by trapezoids of a noisy speed at uneven times: σ²Σ(half of both steps)²."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.choice([0.01, 0.02, 0.04], 2000))
    none = np.full((2000, 1), np.nan)
    run = Run.raw("r", {"speed": np.ones((2000, 1)), "y": none}, units={}, time=t)
    found = filtered(from_stated(walked, run, {"speed": 0.1}).model, run, smooth=False)
    weights = 0.5 * (t[2:] - t[:-2])
    expected = 0.1**2 * np.sum(weights**2)
    assert found.P[-1, 0, 0] - found.P[0, 0, 0] == pytest.approx(expected, rel=1e-3)


def test_an_output_may_state_the_noise_of_one_reading():
    """Rows of a table at any times weigh alike: the mean, and σ²/N."""
    t, y = np.array([0.0, 1, 2, 5, 10, 20, 60]), np.arange(7.0)[:, None] ** 2
    table = Run.raw("table", {"y": y}, units={}, time=t)
    found = filtered(resting, table)
    assert found.x[-1, 0] == pytest.approx(y.mean(), rel=1e-9)
    assert found.P[-1, 0, 0] == pytest.approx(0.3**2 / 7, rel=1e-9)
    for step in (0.1, 10.0):
        again = filtered(resting, Run.raw("table", {"y": y}, units={}, time=step * t))
        np.testing.assert_allclose(again.x[-1], found.x[-1], rtol=1e-12)


def test_the_intensity_of_a_stated_reading_needs_its_period():
    assert resting.noise_at(0.1)[0, 0] == pytest.approx(0.3**2 * 0.1)
    assert resting.sensing(y=2.0).noise[0, 0] == 2.0
    with pytest.raises(UsageError, match=r"y has the noise of one reading \(std=0.3\)"):
        _ = resting.noise


@pytest.mark.parametrize(("given", "words"), [
    ({"std": 1.0, "intensity": 1.0}, "both of std= and intensity= given"),
    ({"std": 0.0}, "std=0 must be positive and finite"),
])  # fmt: skip
def test_an_output_states_its_noise_once(given, words):
    with pytest.raises(DeclarationError, match=words):
        measured(None, None, **given)


@pytest.mark.parametrize(("stds", "words"), [
    ({"w": 1.0}, "has no signal 'w'; it has a, omega, v"),
    ({"v": 0.0}, "v: the noise 0 must be positive"),
])  # fmt: skip
def test_what_is_no_noise_is_refused(flight, stds, words):
    with pytest.raises(UsageError, match=words):
        from_stated(bias_gravity, flight, stds)


# -- maximum likelihood ----------------------------------------------------------------------------


def test_the_most_likely_intensities_are_the_true_ones(flight):
    """Each within three of its own standard deviations."""
    found = most_likely(bias_gravity, flight)
    used = intensities(found.model)
    for name, true in TRUE.items():
        assert abs(np.log(used[name] / true)) < 3 * found.spread[name], name
    assert found.spread["v"] < 0.05
    assert found.spread["omega"] < 1.0
    assert not found.spread["bias"] < 1.0  # it does not drift at all


def test_the_niles_intensities_are_the_certified_ones(shared_data):
    """A local level: Durbin and Koopman's maximum, 15 098.5 and 1469.2."""

    @dynamics
    def nile(flow=signal(), *, level=state(intensity=1e3, start=1000.0, std=1e4)):
        return Motion(rates={}, outputs=measured(flow, level, intensity=1e4))

    t, flow = np.loadtxt(shared_data / "certified" / "nile.csv", delimiter=",", skiprows=1).T
    run = Run.raw("nile", {"flow": flow[:, None]}, units={}, time=t)
    used = intensities(most_likely(nile, run).model)
    assert used["flow"] == pytest.approx(15_098.5, rel=2e-4)
    assert used["level"] == pytest.approx(1469.2, rel=2e-4)


# -- at rest ---------------------------------------------------------------------------------------


def test_allan_deviation_finds_white_noise_and_random_walk():
    found = allan(drifting(60_000, 0.01, 3e-4), 1 / DT)
    np.testing.assert_allclose(found.white, 0.01 * np.sqrt(DT), rtol=0.02)
    np.testing.assert_allclose(found.walk, 3e-4, rtol=0.35)
    assert found.deviations.shape == (len(found.taus), 3)
    # White noise averages out with the root of time.
    np.testing.assert_allclose(found.deviations[2], found.white / np.sqrt(found.taus[2]), rtol=0.03)


def test_a_record_at_rest_gives_the_inputs_noise_and_the_biass_drift(flight):
    signals = {"a": drifting(40_000, 0.0013, 2e-5), "omega": drifting(40_000, 8.7e-4, 0.0, 1)}
    rest = type(flight).raw("rest", signals, units={}, time=DT * np.arange(40_000))
    tuned, found = from_rest(bias_gravity, rest)
    used = intensities(tuned.model)
    assert used["a"] == pytest.approx(0.0013**2 * DT, rel=0.05)
    assert used["omega"] == pytest.approx(8.7e-4**2 * DT, rel=0.05)
    assert used["bias"] == pytest.approx(2e-5**2, rel=0.7)
    assert set(found) == {"a", "omega"}


@pytest.mark.parametrize(("readings", "words"), [
    (np.zeros((20, 3)), "20 readings at 50 Hz are too few for an Allan deviation"),
    (np.full((2000, 3), np.nan), "needs every reading"),
])  # fmt: skip
def test_a_rest_that_is_too_little(readings, words):
    with pytest.raises(DataError, match=words):
        allan(readings, 50.0)


def test_without_allantools_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "allantools", None)
    with pytest.raises(UsageError, match=r"pip install 'casest\[allan\]'"):
        allan(np.zeros((2000, 3)), 50.0)


# -- through the command line ----------------------------------------------------------------------


@pytest.fixture
def files(tmp_path, flight):
    s = flight.signals
    table = np.c_[T, s["a"], s["omega"], s["v"]]
    still = (
        np.array([0, 0, -9.8]) + drifting(10_000, 0.0013, 2e-5),
        drifting(10_000, 8.7e-4, 0.0, 1),
    )
    for name, values, head in (
        ("flight.csv", table, NAMES),
        ("rest.csv", np.c_[DT * np.arange(10_000), still[0], still[1]], NAMES[:7]),
    ):
        np.savetxt(tmp_path / name, values, delimiter=",", header=",".join(head), comments="")
    return tmp_path


STATED = ["--sensor-noise", "a=0.0013", "--sensor-noise", "omega=8.727e-4"]
VELOCITY = ["--sensor-noise", "v=0.01"]


@pytest.mark.parametrize("options", [
    [*STATED, *VELOCITY], pytest.param(["--noise", "ml"], marks=pytest.mark.long),
    ["--rest", "rest.csv", *VELOCITY],
])  # fmt: skip
def test_declared_and_matched_stand_side_by_side(files, capsys, monkeypatch, options):
    monkeypatch.chdir(files)
    assert run(["filter", "bias-gravity", "flight.csv", *options, "-o", "out"]) == 0
    said = capsys.readouterr().out
    assert "declared         used" in said
    assert "innovations are as large as the noise intensities say" in said
    content = json.loads((files / "out" / "filter.json").read_text("utf-8"))
    both = content["intensities"]
    assert both["declared"]["v"] == 0.1
    assert both["used"]["v"] == pytest.approx(TRUE["v"], rel=0.1)
    assert both["declared_normalised_mean"] < 0.01
    assert abs(content["innovations"]["normalised_mean"] - 3) < 0.3
    assert "Noise intensities" in (files / "out" / "report.html").read_text("utf-8")


CART = """
from casest import signal
from casest.dynamics import Motion, dynamics, measured, state


@dynamics
def cart(y=signal("m"), a=signal("m/s^2"), *, x=state("m", std=1.0), v=state("m/s", std=1.0)):
    return Motion(rates={"x": v, "v": a}, outputs=(measured(y, x),))
"""


@pytest.fixture
def cart(tmp_path):
    """A declaration that says nothing of noise, and a record of a cart that swings."""
    rng, t = np.random.default_rng(1), np.arange(0, 20, 0.05)
    read = 1 + t - np.sin(t) + rng.normal(0, 0.05, len(t)), np.sin(t) + rng.normal(0, 0.02, len(t))
    (tmp_path / "cart.py").write_text(CART, encoding="utf-8")
    named = {"delimiter": ",", "header": "t [s],y [m],a [m/s^2]", "comments": ""}
    np.savetxt(tmp_path / "cart.csv", np.column_stack([t, *read]), **named)
    return [str(tmp_path / "cart.py"), str(tmp_path / "cart.csv")]


OF_CART = ["--sensor-noise", "y=0.05", "--sensor-noise", "a=0.02"]


def test_noise_that_is_only_stated_is_enough_for_a_filter(cart, capsys):
    """It was refused with the advice to state it."""
    assert run(["filter", *cart, *OF_CART, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["intensities"]["declared"] == {}
    assert said["intensities"]["used"]["y"] == pytest.approx(0.05**2 * 0.05)
    assert abs(said["states"]["x"]["value"][0] - 20.037) < 4 * said["states"]["x"]["std"][0]
    assert run(["filter", *cart, *OF_CART[2:]]) == 1
    assert "y has no noise" in capsys.readouterr().err


def test_stated_noise_of_an_input_moves_the_states(cart, capsys):
    """In `observe` and `close` it was accepted and did nothing; a calibration takes it as exact."""
    assert run(["observe", *cart, *OF_CART, "--json"]) == 0
    moving = json.loads(capsys.readouterr().out)
    # The stationary solution of the Riccati equation of a double integrator, of both intensities.
    q, r = 0.02**2 * 0.05, 0.05**2 * 0.05
    expected = np.sqrt([2**0.5 * q**0.25 * r**0.75, 2**0.5 * q**0.75 * r**0.25])
    assert [moving["std"][n][0] for n in ("x", "v")] == pytest.approx(expected, rel=0.05)
    assert run(["close", *cart, *OF_CART]) == 0
    assert "adequate" in capsys.readouterr().out
    assert run(["calibrate", *cart, *OF_CART]) == 1
    assert "noise of a: it drives the states of cart" in capsys.readouterr().err


def test_two_ways_at_once_are_refused(files, capsys):
    words = ["filter", "bias-gravity", str(files / "flight.csv"), "--noise", "ml", *VELOCITY]
    assert run(words) == 1
    assert "--noise ml finds every intensity: leave" in capsys.readouterr().err


def test_stated_noise_takes_a_unit_in_motion_and_nothing_but_one_number():
    from casest.cli.assignments import Assignment
    from casest.interface.sensor_noise import one_number

    def std(text):
        return one_number(Assignment("--sensor-noise", text), bias_gravity.signals)

    assert std("omega=0.05 deg/s") == ("omega", pytest.approx(0.05 * np.pi / 180, rel=1e-15))
    assert std("v=2 cm/s") == ("v", pytest.approx(0.02, rel=1e-15))
    assert std("a=0.0013") == ("a", 0.0013)
    for wrong, said in (
        ("v=2%", "one number for all its readings and axes, and '2%' is none: write v=0.02, or"),
        ("v=u_v", "'u_v' is none"),
        ("v=nan", "'nan' is none"),
        ("v=2 kg", "kg does not convert to m/s"),
        ("omega=3 bananas", "unknown unit 'bananas'"),
    ):
        with pytest.raises(CasestError, match=re.escape(said)):
            std(wrong)
