"""What one mounting of the wheel cannot show, and how many mountings or tilts it takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import simulators as sim
from scipy.spatial.transform import Rotation

from casest import Run, calibrate
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol import ranked
from casest.diagnose.sensor import Sensor
from casest.diagnose.visibility import visible
from casest.effects import cross_axis
from casest.effects.placing import prepared
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Problem
from casest_problems.wheel import wheel

OFFSET, GAIN = np.array([0.4, -0.3, 0.2]), np.array([0.98, 1.01, 1.03])
SPEED = np.array([9.0, -0.09, 5e-4, 2e-6])
CROSS = np.array([0.010, -0.006, 0.008])


def spun(mounting, tilt, *, cross=np.zeros(3), radius=0.28, sigma=0.0, seed=0, phase=0.5):
    """One run: angles of the mounting and the tilt in degrees; cross-axis terms before the gain."""
    t = np.arange(0, 60, 0.02)
    turn = Rotation.from_euler("XYZ", mounting, degrees=True).as_matrix()
    bench = sim.Spin(np.zeros(3), np.ones(3), turn, np.radians(tilt), radius)
    force = bench.read(*sim.cubic_motion(t, phase, SPEED))
    skew = np.array([[1, 0, 0], [cross[0], 1, 0], [cross[1], cross[2], 1]])
    v = OFFSET + GAIN * (force @ skew.T)
    v = v + sigma * np.random.default_rng(seed).standard_normal(v.shape)
    return Run.raw(f"{mounting}-{tilt}", {"t": t[:, None], "v": v}, units={"v": "m/s^2"}, time=t)


ONE, TWO, THREE = (30, 20, 25), (-20, 35, 140), (100, -40, -60)
SETUPS = {
    "one mounting": [(ONE, 45)],
    "two tilts": [(ONE, 45), (ONE, 25)],
    "two mountings": [(ONE, 45), (TWO, 45)],
    "three mountings": [(ONE, 45), (TWO, 45), (THREE, 45)],
}


def missing(model, setup):
    """Undetermined directions at the truth."""
    runs = [spun(mounting, tilt) for mounting, tilt in SETUPS[setup]]
    problem = Problem(model, tuple(runs))
    found = identify(problem, problem.start())
    return found.unknowns - found.rank


def with_cross(model):
    return model.with_effect(replace(cross_axis, on="specific_force"))


@pytest.mark.parametrize(
    ("setup", "cross", "radius", "both"),
    [
        ("one mounting", 3, 1, 4),
        ("two tilts", 0, 0, 1),
        ("two mountings", 0, 0, 1),
        ("three mountings", 0, 0, 0),
    ],
)
def test_what_cross_axis_and_radius_need_to_be_seen(setup, cross, radius, both):
    """Directions lost with three cross-axis terms free, with the radius free, and with both."""
    counted = (
        missing(with_cross(wheel), setup),
        missing(wheel.freed("radius"), setup),
        missing(with_cross(wheel.freed("radius")), setup),
    )
    assert counted == (cross, radius, both)


@pytest.mark.parametrize("name", ["cross_axis", "radius"])
def test_one_mounting_at_one_tilt_hides_both(name):
    run = spun(ONE, 45, cross=CROSS, radius=0.29, sigma=0.02)
    ready = prepared(wheel, [run])
    sensor = Sensor(wheel, ready, (cross_axis,))
    fit = sensor.fitted(wheel, calibrate(wheel, [run]).values)
    listed = sensor.tried.found(fit)[0]
    seen = {v.candidate.name: v for v in visible(sensor.linear(fit), sensor.tried.of(fit, listed))}
    assert np.all(seen[name].survives < LEVELS.survives)
    # Nothing is "found" although both are wrong.
    ranking = ranked(sensor, fit)
    assert not any(ranking.says(e) for e in ranking.found)


def test_three_mountings_give_both_back():
    runs = [
        spun(mounting, tilt, cross=CROSS, radius=0.29, sigma=0.02, seed=k)
        for k, (mounting, tilt) in enumerate(SETUPS["three mountings"])
    ]
    found = calibrate(with_cross(wheel.freed("radius")), runs)
    away = np.abs(found.values["cross_axis.k"] - CROSS)
    assert np.all(away < 4 * found.std["cross_axis.k"])
    assert abs(found.values["radius"] - 0.29) < 4 * found.std["radius"]
