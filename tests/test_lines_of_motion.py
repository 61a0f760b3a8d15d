"""A line in the spectrum is a vibration unless it belongs to the motion."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close, load_runs
from casest.effects.lateness import comes_again
from casest.results.find import find_model

ROWS, STEP = 3000, 0.01


def written(path, t, x, y):
    rows = np.stack([t, x, y], axis=1)
    np.savetxt(path, rows, delimiter=",", header="t,reference,reading", comments="", fmt="%.9g")
    return path


def by_hand(rng, t):
    """Turned to and fro by hand, at an uneven pace."""
    phase = 2 * np.pi * np.cumsum(0.7 * np.exp(0.15 * np.sin(0.8 * t + rng.uniform(0, 6)))) * STEP
    return np.sin(phase) * (1 + 0.2 * np.sin(0.31 * t)) + 0.3 * np.sin(2.3 * phase)


def found_in(file):
    return [e.candidate.label for e in close("linear", file).effects]


@pytest.mark.parametrize("seed", range(3))
def test_a_gain_that_changes_a_little_leaves_no_vibration(tmp_path, seed):
    """A line beside that of the motion, 1 % of it."""
    rng, t = np.random.default_rng(seed), STEP * np.arange(ROWS)
    wave = np.sin(4.3 * t) + 0.05 * by_hand(rng, t)
    swaying = 1 + 0.012 * np.cos(0.15 * t + rng.uniform(0, 6))
    file = written(tmp_path / "a.csv", t, wave, swaying * wave + 0.01 * rng.standard_normal(ROWS))
    assert "vibration" not in found_in(file)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_multiples_of_a_wave_are_no_vibration(tmp_path, seed):
    """Steps of a converter bend a wave: overtones that no curve of the catalogue tells."""
    rng, t = np.random.default_rng(seed), STEP * np.arange(ROWS)
    wave = np.sin(4.3 * t + rng.uniform(0, 6))
    overtone = 0.03 * np.sin(3 * 4.3 * t + 1.0)
    file = written(tmp_path / "a.csv", t, wave, wave + overtone + 0.01 * rng.standard_normal(ROWS))
    assert "vibration" not in found_in(file)


@pytest.mark.long
@pytest.mark.parametrize("frequency", [6.1, 9.4, 40.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_vibration_beside_the_motion_is_one(tmp_path, seed, frequency):
    """Within what the motion goes through as well: 1 % of it."""
    rng, t = np.random.default_rng(seed), STEP * np.arange(ROWS)
    x = by_hand(rng, t)
    y = x + 0.01 * np.sin(frequency * t) + 0.01 * rng.standard_normal(ROWS)
    file = written(tmp_path / "a.csv", t, x, y)
    assert "vibration" in found_in(file)


def late(tmp_path, rng, x, by, noise):
    t = STEP * np.arange(ROWS)
    y = np.interp(t - by, t, x(t)) if not callable(x) else x(t - by)
    return written(tmp_path / "late.csv", t, x(t), y + noise * rng.standard_normal(ROWS))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_a_wave_is_late_by_less_than_half_a_period(tmp_path, seed):
    """What is left of a poor fit may make whole periods later a little likelier."""
    rng, period = np.random.default_rng(seed), 0.5
    wander = np.cumsum(rng.standard_normal(ROWS)) * 2e-3  # of its phase

    def wave(s):
        slow = np.interp(s, STEP * np.arange(ROWS), wander)
        return np.sin(2 * np.pi * s / period + 0.2 * slow) + 0.1 * np.sin(6 * np.pi * s / period)

    by = float(rng.uniform(-0.1, 0.1))
    closing = close("linear", late(tmp_path, rng, wave, by, 0.1))
    (delay,) = (float(v) for n, v in closing.after.values.items() if n.endswith("delay"))
    assert delay == pytest.approx(by, abs=0.01)


def test_after_how_long_a_signal_is_the_same(tmp_path):
    rng, t = np.random.default_rng(0), STEP * np.arange(ROWS)
    signals = find_model("linear").signals
    square = np.sign(np.sin(2 * np.pi * t / 0.8 + 0.1))
    runs = load_runs([written(tmp_path / "a.csv", t, square, t)], signals)
    assert comes_again(runs, "reference") == pytest.approx(0.8, abs=STEP)
    for values in (np.cumsum(rng.standard_normal(ROWS)), rng.standard_normal(ROWS), t):
        runs = load_runs([written(tmp_path / "a.csv", t, values, t)], signals)
        assert comes_again(runs, "reference") == np.inf
