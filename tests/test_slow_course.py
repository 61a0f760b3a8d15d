"""A slow course in a residual is seen, and coloured noise is not called one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import simulators as sim
from scipy.signal import butter, lfilter

from casest import Residual, Run, attempt, model, param, quantity, signal
from casest.cli import run as casest
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.left import doubts
from casest.diagnose.noise.slow_course import COLOUR, FAST, MEMORY, SLOW, slow_course
from casest.results.find import find_model
from casest_problems.norm import norm_triangular

MODELS = Path(__file__).parent / "models"
thermistor = find_model(str(MODELS / "thermistor.py"))


@model
def line(x=signal("V"), y=signal("V"), *, zero=param("V"), gain=param()):
    """A line."""
    return Residual(measured=y, predicted=quantity("level", zero + gain * x, "V"))


def series(values, **more):
    """A run of residuals (N,) or (N, m) in time."""
    values = np.reshape(values, (len(values), -1))
    time = 0.01 * np.arange(len(values))
    return [replace(Run.raw("r", {"y": values}, units={}, time=time), **more)], [values]


def seen(values):
    found = slow_course(*series(values))
    return found.p_value < LEVELS.misfit and found.share >= LEVELS.share


def filtered(b, a, seed, n=2000):
    rng = np.random.default_rng(seed)
    return lfilter(b, a, rng.standard_normal(n + 500))[500:]


# -- sensors ---------------------------------------------------------------------------------------


def thermistor_record(seed, lag, n=1000):
    rng = np.random.default_rng([seed, 9])
    reference = sim.chamber(n, 1.0, rng)
    resistance = sim.thermistor(reference, 1.0, lag, rng)
    signals = {"resistance": resistance[:, None], "reference": reference[:, None]}
    units = {"resistance": "ohm", "reference": "K"}
    return Run.raw("thermistor", signals, units=units, time=1.0 * np.arange(n))


def test_a_thermistor_that_lags_behind_its_reference_leaves_a_slow_course():
    for seed in range(4):
        found = doubts(attempt(thermistor, [thermistor_record(seed, 8.0)]))
        assert found
    said = [f.where for f in found if "slow course" in f.where]
    assert said
    assert "of unknown cause" in said[0]


def test_a_thermistor_that_does_not_lag_leaves_noise():
    for seed in range(10):
        assert doubts(attempt(thermistor, [thermistor_record(seed, 0.0)])) == []


@pytest.mark.parametrize("per_ampere", [0.0, 0.05, 0.3])
def test_a_magnetometer_beside_a_motor_whose_current_nobody_recorded(per_ampere):
    for seed in range(5):
        rng = np.random.default_rng([seed, 10])
        sensor = sim.Sensor(np.diag([1.03, 0.98, 1.01]), np.array([3.0, -7.0, 5.0]), 48.0)
        t, v, _ = sim.drone(sensor, per_ampere * sim.sphere(1, rng)[0], 0.3, rng)
        run = Run.raw("drone", {"v": v}, units={"v": "uT"}, time=t)
        found = doubts(attempt(norm_triangular.having(norm=48.0), [run]))
        assert bool(found) == bool(per_ampere)


def test_the_prompt_says_how_much_of_the_residual_it_is_and_over_how_long(tmp_path, capsys):
    run = thermistor_record(3, 8.0, n=4000)
    table = np.column_stack([run.time, run.signals["resistance"], run.signals["reference"]])
    path = tmp_path / "thermistor.csv"
    names = "t [s],resistance [ohm],reference [K]"
    np.savetxt(path, table, delimiter=",", header=names, comments="")
    assert casest(["calibrate", str(MODELS / "thermistor.py"), str(path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "trusted, but the residual is not noise" in said
    assert "% of it is a slow course over about" in said
    assert "nothing in the residual speaks against the model" not in said


@model
def probe(reference=signal("K"), y=signal("K"), *, gain=param(start=1.0), zero=param("K")):
    """A thermometer that is compared with another one."""
    return Residual(measured=y, predicted=quantity("reading", zero + gain * reference, "K"))


def short_record(rows, seed, misfit):
    """So many readings of a bath that goes up and down: noise of 0.1 K, and a misfit."""
    rng, s = np.random.default_rng([rows, seed, 11]), np.linspace(0, 1, rows)
    bath = 20 + 15 * np.sin(2 * np.pi * 1.7 * s) + 5 * np.sin(2 * np.pi * 4.1 * s)
    y = 1.02 * bath - 0.4 + misfit(s) + 0.1 * rng.standard_normal(rows)
    signals = {"reference": bath[:, None], "y": y[:, None]}
    return Run.raw("bath", signals, units={"reference": "K", "y": "K"}, time=10.0 * np.arange(rows))


def wave(s):
    return 0.3 * np.sin(2 * np.pi * 2.3 * s)


def bump(s):
    return np.exp(-(((s - 0.6) / 0.1) ** 2))


@pytest.mark.parametrize(
    ("rows", "misfit"),
    [*((n, wave) for n in (40, 60, 99, 100, 130, 220)), *((n, bump) for n in (60, 99, 100, 220))],
)
def test_a_plain_misfit_of_a_short_series_is_seen(rows, misfit):
    """Eight means, or none, were never unlikely enough. (Of a bump in forty rows ten say so.)"""
    for seed in range(3):
        assert doubts(attempt(probe, [short_record(rows, seed, misfit)]))


@pytest.mark.long
@pytest.mark.parametrize("rows", [40, 99, 100, 220])
def test_a_short_series_without_one_leaves_noise(rows):
    """Each question has a chance of 0.001, and there are five at most."""
    none = [bool(doubts(attempt(probe, [short_record(rows, s, np.zeros_like)]))) for s in range(60)]
    assert sum(none) <= 3


@pytest.mark.parametrize("rows", [100, 160, 220])
def test_colour_over_a_fiftieth_of_a_short_series_is_no_slow_course(rows):
    kept = np.exp(-48 / rows)
    alarms = sum(seen(filtered([1], [1, -kept], [s, rows], rows)) for s in range(400))
    assert alarms <= 4


# -- its size --------------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [100, 400, 4000])
@pytest.mark.parametrize("size", [0.5, 2.0])
def test_share_and_length_of_a_wave_are_those_that_it_has(period, size):
    t, rng = np.arange(4000), np.random.default_rng(period)
    wave = size * np.sqrt(2) * np.sin(2 * np.pi * t / period + 1)
    found = slow_course(*series(wave + rng.standard_normal(4000)))
    assert found.p_value < 1e-6
    assert found.share == pytest.approx(size**2 / (1 + size**2), abs=0.05)
    assert found.samples == pytest.approx(period / 2, rel=0.1)


def test_a_wave_without_any_noise_is_seen_in_two_hundred_samples():
    for period in (80, 100, 150):
        assert seen(np.sin(2 * np.pi * np.arange(200) / period + 0.4))


def test_the_axis_with_the_course_counts_and_so_do_all_runs():
    rng, t = np.random.default_rng(0), np.arange(500)
    noise = rng.standard_normal((500, 3))
    noise[:, 1] += np.sin(2 * np.pi * t / 150)
    assert slow_course(*series(noise)).p_value < LEVELS.misfit
    runs, values = zip(*(series(noise[a:b]) for a, b in ((0, 240), (240, 500))), strict=True)
    both = slow_course([r[0] for r in runs], [v[0] for v in values])
    assert both.p_value < LEVELS.misfit


# -- noise -----------------------------------------------------------------------------------------


def test_the_longest_colour_is_as_strong_at_slow_periods_as_is_allowed_for():
    """AR(1) noise with a memory of MEMORY samples, by its periodogram."""
    rho, n, powers = np.exp(-1 / MEMORY), 6000, []
    for seed in range(60):
        powers.append(np.abs(np.fft.rfft(filtered([1], [1, -rho], seed, n))) ** 2)
    power, period = np.mean(powers, axis=0)[1:], n / np.arange(1, n // 2 + 1)
    slowest, compared = period > 10 * SLOW, (period < SLOW) & (period > FAST)
    # At periods as fast as FAST, noise in steps of a sample is a little stronger than in theory.
    assert power[slowest].mean() / power[compared].mean() == pytest.approx(COLOUR, rel=0.1)


COLOURS = {
    "white": ([1], [1]),
    "AR(1)": ([1], [1, -0.6]),
    "memory of five samples": ([1], [1, -np.exp(-1 / 5)]),
    "low-pass": butter(2, 0.1),
    "running mean": (np.ones(10), [1]),
}


@pytest.mark.parametrize("colour", COLOURS)
def test_coloured_noise_is_no_slow_course(colour):
    for n in (150, 600, 2000):
        alarms = sum(seen(filtered(*COLOURS[colour], [seed, n], n)) for seed in range(100))
        # At 1 % two of a hundred come in one try of four, four in one of fifty.
        assert alarms <= 3


def test_heavy_tails_and_unequal_noise_are_no_slow_course():
    rng, t = np.random.default_rng(3), np.arange(2000)
    scale = np.exp(1.5 * np.sin(t / 100))
    assert sum(seen(scale * rng.standard_normal(2000)) for _ in range(100)) <= 3
    assert sum(seen(np.clip(rng.standard_t(3, 2000), -5, 5)) for _ in range(100)) <= 3


def test_noise_that_wanders_is_a_slow_course_too():
    walks = [filtered([0.05], [1, -1], s) + filtered([1], [1], [s, 1]) for s in range(20)]
    assert sum(map(seen, walks)) >= 18


def test_what_rounding_leaves_of_a_slow_input_is_known():
    rng, t = np.random.default_rng(4), np.arange(2000.0)
    x = 2 * np.sin(2 * np.pi * t / 2000) + 0.3 * np.sin(2 * np.pi * t / 777)
    for step, said in ((2.0, False), (1e-3, True)):
        y = 1 + x + (0.02 if step > 1 else 0.3) * rng.standard_normal(2000)
        if said:
            y += 0.3 * np.sin(2 * np.pi * t / 190 + np.sin(t / 300))
        y = np.round(y / step) * step
        signals = {"x": x[:, None], "y": y[:, None]}
        run = Run.raw("r", signals, units={"x": "V", "y": "V"}, time=0.01 * t)
        found = doubts(attempt(line, [run]))
        assert any("slow course" in f.where for f in found) == said


def test_rest_intervals_and_short_records_are_not_asked():
    wave = np.sin(np.arange(99) / 9)
    assert slow_course(*series(wave)) is None
    rests, values = series(np.sin(np.arange(200) / 30), spread={"y": np.ones((200, 1))})
    assert slow_course(rests, values) is None
