"""Half-turn speeds of a wheel: those of the bench, and a law that does not hold is seen in them."""

from __future__ import annotations

import numpy as np
import pytest
import simulators as sim
from scipy.spatial.transform import Rotation

from casest import NotTrusted, Run, UsageError, attempt
from casest_problems.wheel import wheel
from casest_problems.wheel_pictures import draw_half_turns, half_turn_speeds, half_turns

BENCH = sim.Spin(
    np.array([1.0, -1.0, 1.0]),
    np.array([0.9, 1.0, 1.1]),
    Rotation.from_euler("XYZ", [30, 20, 25], degrees=True).as_matrix(),
    np.radians(45),
)
SPEED = np.array([9.0, -0.09, 5e-4, 2e-6])


def readings(motion, sigma, seed=0):
    v = BENCH.read(*motion)
    return v + sigma * np.random.default_rng(seed).standard_normal(v.shape)


def as_run(t, v, name="run"):
    return Run.raw(name, {"t": t[:, None], "v": v}, units={"t": "s", "v": "m/s^2"}, time=t)


def fitted(*runs):
    return attempt(wheel, runs, solver="trust-region")


def physical(seconds, rate=12.0):
    """A wheel slowed by air and bearings, read with the noise of a cheap sensor."""
    t = np.arange(0, seconds, 0.01)
    return as_run(t, readings(sim.physical_motion(t, 0.5, rate), 0.08), f"{seconds} s")


@pytest.fixture(scope="module")
def long_run():
    return fitted(physical(300))


@pytest.mark.parametrize("direction", [1, -1])
def test_without_noise_the_half_turn_speeds_are_those_of_the_bench(direction):
    """Either way round: to a fifth of a milliradian per second of 6 to 9 rad/s."""
    t = np.arange(0, 90, 1 / 200)
    times, speeds = half_turn_speeds(
        t, readings(sim.cubic_motion(t, 0.5, direction * SPEED), sigma=0.0)
    )
    true = np.polynomial.polynomial.polyval(times, SPEED)
    np.testing.assert_allclose(speeds, true, atol=2e-4)


def test_every_half_turn_is_there_but_those_at_the_ends():
    t = np.arange(0, 90, 1 / 200)
    angle, *_ = motion = sim.cubic_motion(t, 0.5, SPEED)
    times, _ = half_turn_speeds(t, readings(motion, sigma=0.08))
    assert 0 <= (angle[-1] - angle[0]) / np.pi - len(times) < 7
    np.testing.assert_allclose(np.diff(np.interp(times, t, angle)), np.pi, atol=0.1)


@pytest.mark.parametrize(("sigma", "rate"), [(0.08, 200), (1.0, 200), (0.08, 50)])
def test_noise_scatters_the_speeds_as_much_as_the_readings_allow(sigma, rate):
    """Mean angle of two half turns of n samples each, σ/(g·sin α) a sample, over their distance."""
    t = np.arange(0, 90, 1 / rate)
    times, speeds = half_turn_speeds(t, readings(sim.cubic_motion(t, 0.5, SPEED), sigma))
    true = np.polynomial.polynomial.polyval(times, SPEED)
    seconds = np.pi / true
    expected = np.sqrt(2 / (rate * seconds)) * sigma / (9.80665 * np.sqrt(0.5)) / seconds
    scatter = np.sqrt(np.mean(((speeds - true) / expected) ** 2))
    assert 0.8 < scatter < 1.5
    assert abs(np.mean((speeds - true) / expected)) < 4 / np.sqrt(len(times))


def test_the_speeds_know_no_law_of_motion():
    """Ten minutes of air drag, where the best cubic is far off: still those of the bench."""
    t = np.arange(0, 600, 0.01)
    motion = sim.physical_motion(t, 0.5, 12.0)
    times, speeds = half_turn_speeds(t, readings(motion, sigma=0.0))
    np.testing.assert_allclose(speeds, np.interp(times, t, motion[1]), atol=1e-3)


def test_a_knock_costs_no_more_than_the_turns_around_it():
    t = np.arange(0, 60, 0.01)
    v = readings(sim.cubic_motion(t, 0.5, SPEED), 0.08)
    v[3000:3003] += 150.0
    times, speeds = half_turn_speeds(t, v)
    off = np.abs(speeds - np.polynomial.polynomial.polyval(times, SPEED))
    assert off[np.abs(times - 30) > 2].max() < 0.05
    assert np.all(np.isfinite(speeds))


def test_where_the_cubic_holds_the_residual_is_noise():
    t = np.arange(0, 90, 0.01)
    found = fitted(as_run(t, readings(sim.cubic_motion(t, 0.5, SPEED), 0.08)))
    (turns,) = half_turns(found)
    assert abs(turns.structure) < 4 / np.sqrt(len(turns.times))
    assert turns.residual.std() < 0.01


def test_on_a_long_run_of_a_real_wheel_the_residual_is_a_wave(long_run):
    """300 s of drag: the residual repeats a turn later (correlation over 0.9), as a slow curve."""
    (turns,) = half_turns(long_run)
    assert turns.structure > 0.9
    assert np.abs(turns.residual).max() > 0.1  # rad/s; noise alone leaves 0.03


def grey(path):
    from matplotlib.image import imread

    return imread(path)[..., :3].mean(axis=2)


def test_the_picture_is_drawn_for_each_run(tmp_path, long_run):
    one = tmp_path / "one.png"
    draw_half_turns(long_run, one)
    both = tmp_path / "both.png"
    found = draw_half_turns(fitted(physical(60), physical(40, rate=9.0)), both)
    assert [turns.run for turns in found] == ["60 s", "40 s"]
    assert found[0].speeds[0] == pytest.approx(12, abs=0.3)
    assert found[1].speeds[0] == pytest.approx(9, abs=0.3)
    assert grey(both).shape[1] > 1.5 * grey(one).shape[1]
    for path in (one, both):
        share = np.mean(grey(path) < 0.9)
        assert 0.01 < share < 0.5, "a picture is neither blank nor black"


def test_too_few_turns_are_refused():
    t = np.arange(0, 4, 0.01)
    with pytest.raises(NotTrusted, match="half turns are too few to look at"):
        half_turn_speeds(t, readings(sim.cubic_motion(t, 0.5, SPEED), 0.01))


def test_a_model_without_speed_cannot_be_drawn(tmp_path, long_run):
    held = wheel.having(speed=long_run.values["speed"])
    found = attempt(held, long_run.problem.runs, solver="trust-region")
    with pytest.raises(UsageError, match="no unknown `speed`"):
        draw_half_turns(found, tmp_path / "none.png")
