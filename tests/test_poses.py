"""The sphere of poses: what is covered, and where the widest gap lies."""

from __future__ import annotations

import numpy as np
import pytest
import simulators as sim

from casest import calibrate
from casest.results.poses import poses_of
from casest_problems.norm import norm_diagonal

CALIBRATED = norm_diagonal.having(norm=sim.GRAVITY)


def poses(directions, rng):
    sensor = sim.accelerometer(rng, skew=False)
    found = calibrate(CALIBRATED, sensor.read(directions, 1e-4, rng), columns={"v": "0,1,2"})
    return poses_of(found)


def test_a_hemisphere_leaves_a_gap_of_ninety_degrees_on_the_other_side():
    rng = np.random.default_rng(1)
    everywhere = sim.spread_poses(4000, rng, jitter=0.0)
    found = poses(everywhere[everywhere[:, 2] > 0], rng)
    assert found.radius == pytest.approx(90, abs=4)
    assert found.empty == pytest.approx([0, 0, -1], abs=0.07)
    # within 30 degrees of a hemisphere: (1 + sin 30) / 2 of the sphere
    assert found.covered == pytest.approx(0.75, abs=0.03)


def test_poses_all_over_leave_no_gap_and_have_one_length():
    rng = np.random.default_rng(2)
    found = poses(sim.spread_poses(400, rng), rng)
    assert found.covered == 1
    assert found.radius < 20
    assert np.ptp(found.corrected) < 1e-3
    assert np.ptp(found.raw) > 1e-2
    assert np.linalg.norm(found.directions, axis=1) == pytest.approx(1)


def test_a_model_without_a_known_length_has_no_sphere():
    from casest.demo import WHEEL

    assert poses_of(calibrate("wheel", WHEEL)) is None
