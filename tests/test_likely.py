"""Noise of an input beside readings that are finer than it: the most likely noise is found too.

Truth and optimum are NumPy's and SciPy's: turns of a plane by cosines, all noises of the record as
unknowns of one least-squares problem.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares as minimised

from casest import Run, signal, sin, vertcat
from casest.dynamics import Motion, dynamics, least_squares, measured, rounds, state
from casest.dynamics import filter as filtering
from casest.dynamics.course import followed
from casest.dynamics.filter import filtered

STEP, GYRO, COMPASS = 0.1, 0.02, 1e-3
START = np.array([0.5, 0.0, 0.0, 0.0, 0.0])
STD = np.array([1.0, 1.0, 0.3, 0.3, 0.1])


@dynamics
def turned(
    rate=signal("rad/s", held=True),
    m=signal(2, "1"),
    *,
    field=state(2, start=(0.5, 0.0), std=1.0),
    offset=state(2, std=0.3),
    drift=state("rad/s", std=0.1),
):
    """A field in a plane that turns, and a compass with an offset."""
    w = rate - drift
    return Motion(
        rates={"field": w * vertcat(field[1], -field[0])},
        outputs=(measured(m, field + offset, std=COMPASS),),
    )


@dynamics
def lit(
    light=signal("1"),
    y=signal("1"),
    *,
    level=state(intensity=0.01),
    share=state(std=0.3),
):
    """A noisy input that only the reading knows."""
    return Motion(
        rates={"level": -sin(level)}, outputs=(measured(y, level + share * light, std=0.05),)
    )


def turn(angle, field):
    """The field seen by a body that has turned by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * field[0] + s * field[1], c * field[1] - s * field[0]])


def record(seed, rates, field=(0.8, 0.3), drift=0.05):
    """A record whose rates are read with noise, and the five unknowns at its beginning."""
    rng = np.random.default_rng(seed)
    field, offset = np.array(field), 0.2 * rng.standard_normal(2)
    angles = np.concatenate([[0.0], np.cumsum(rates[:-1]) * STEP])
    m = turn(angles, field).T + offset + COMPASS * rng.standard_normal((len(rates), 2))
    read = rates + drift + GYRO * rng.standard_normal(len(rates))
    signals = {"rate": read[:, None], "m": m}
    units = {"rate": "rad/s", "m": "1"}
    run = Run.raw("turned", signals, units=units, time=np.arange(len(rates)) * STEP)
    return run, np.concatenate([field, offset, [drift]])


def optimum(run):
    """The most likely beginning, with the noise of every step as an unknown of its own."""
    read, m = run.signals["rate"][:-1, 0], run.signals["m"]

    def left(unknown):
        x, noise = START + STD * unknown[:5], GYRO * unknown[5:]
        angles = np.concatenate([[0.0], np.cumsum(read + noise - x[4]) * STEP])
        return np.concatenate([((turn(angles, x[:2]).T + x[2:4] - m) / COMPASS).ravel(), unknown])

    found = minimised(left, np.zeros(5 + len(read)), x_scale="jac", xtol=1e-14, ftol=1e-14)
    cov = np.linalg.inv(found.jac.T @ found.jac)[:5, :5] * np.outer(STD, STD)
    return START + STD * found.x[:5], np.sqrt(np.diag(cov))


MODEL = turned.sensing(rate=GYRO**2 * STEP)


@pytest.mark.long
def test_the_smoother_finds_the_joint_optimum_of_states_and_noise():
    rng = np.random.default_rng(1)
    for seed in range(3):
        run, truth = record(seed, 0.5 * rng.standard_normal(150))
        best, std = optimum(run)
        found = filtered(MODEL, run)
        assert found.settled
        assert np.max(np.abs(found.smoothed[0] - best) / std) < 0.05
        np.testing.assert_allclose(found.smoothed_std[0], std, rtol=0.03)
        assert np.max(np.abs(found.smoothed[0] - truth) / std) < 4


def test_all_states_at_once_are_the_smoothed_ones():
    run, _ = record(7, 0.5 * np.random.default_rng(2).standard_normal(80))
    found = filtered(MODEL, run)
    at_once = least_squares(MODEL, run)
    assert np.max(np.abs(at_once.x - found.smoothed) / found.smoothed_std) < 1e-4


def test_at_rest_the_noise_of_the_rate_tells_the_field_and_the_offset_not_apart():
    """A compass that does not turn reads their sum alone, whatever its gyroscope's noise."""
    run, truth = record(3, np.zeros(200))
    found = filtered(MODEL, run)
    prior = STD[2] * STD[0] / np.hypot(STD[0], STD[2])  # of two that are known apart by their sum
    # What the drift is wrong by turns both a little, and tells some of it.
    assert np.all(found.smoothed_std[0, 2:4] > 0.85 * prior)
    assert np.all(np.abs(found.smoothed[0, :4] - truth[:4]) < 4 * prior)


@pytest.mark.parametrize("seed", [37, 104, 125])
def test_rounds_settle_where_noise_moves_a_state_by_its_square_alone(seed):
    """Little motion: again and again one number of the field is nothing."""
    rng = np.random.default_rng(seed)
    rates = 0.05 * rng.standard_normal(150) + 0.1 * np.sin(0.03 * np.arange(150))
    run, truth = record(seed, rates, field=(-1.6, -0.6), drift=0.25)
    found = filtered(MODEL, run)
    assert found.settled
    assert np.all(np.abs(found.smoothed[0] - truth) < 4 * found.smoothed_std[0])


def test_an_input_that_only_the_reading_knows_moves_no_state():
    rng, t = np.random.default_rng(0), np.arange(0, 10, 0.05)
    light = np.sin(t)[:, None]
    y = 0.2 * light + 0.05 * rng.standard_normal(light.shape)
    read = {"light": light + 0.01 * rng.standard_normal(light.shape), "y": y}
    run = Run.raw("lit", read, units={"light": "1", "y": "1"}, time=t)
    model = lit.sensing(light=0.01**2 * 0.05)
    found = filtered(model, run)
    assert found.settled
    assert abs(found.smoothed[-1, 1] - 0.2) < 4 * found.smoothed_std[-1, 1]
    np.testing.assert_allclose(least_squares(model, run).x, found.smoothed, atol=1e-4)


def astray(x):
    """States of a filter gone astray."""
    return 1e3 * np.random.default_rng(4).standard_normal(x.shape)


def test_where_the_filter_goes_astray_rounds_begin_again_at_the_declared_start(monkeypatch):
    run, _ = record(5, 0.5 * np.random.default_rng(4).standard_normal(150))
    right, straight = filtered(MODEL, run), filtering.extended

    def off(*given):
        x, *others = straight(*given)
        return astray(x), *others

    monkeypatch.setattr(filtering, "extended", off)
    found = filtered(MODEL, run)
    assert right.settled
    assert found.settled
    assert np.max(np.abs(found.smoothed - right.smoothed) / right.smoothed_std) < 0.01


def test_the_same_in_pieces(monkeypatch):
    run, _ = record(5, 0.5 * np.random.default_rng(4).standard_normal(150))
    right, straight = followed(turned, run), rounds.filtered

    def off(*given):
        for where, x, *others in straight(*given):
            yield where, astray(x), *others

    monkeypatch.setattr(rounds, "filtered", off)
    found = followed(turned, run)
    assert right.settled
    assert found.settled
    np.testing.assert_allclose(found.smoothed, right.smoothed, atol=1e-6)
