"""The wheel by its equation of motion, against the independent simulator of a slowing wheel."""

from __future__ import annotations

import numpy as np
import simulators
from scipy.spatial.transform import Rotation

import casest
from casest import Run
from casest_problems.wheel_motion import wheel_motion


def test_friction_drag_and_imbalance_of_a_long_spin_are_found():
    """150 s, in which a cubic speed law ends; all within four standard deviations of the truth."""
    rng = np.random.default_rng(7)
    t = np.arange(0, 150, 0.04)
    motion = simulators.physical_motion(t, 0.6, 9.0, eccentric=0.3)
    turn = Rotation.from_euler("XYZ", [30, 20, 25], degrees=True).as_matrix()
    offset, gain = np.array([0.35, -0.2, 0.15]), np.array([0.97, 1.01, 1.04])
    bench = simulators.Spin(offset, gain, turn, 0.8)
    v = bench.read(*motion) + 0.03 * rng.standard_normal((len(t), 3))
    run = Run.raw("spin", {"t": t[:, None], "v": v}, units={"t": "s", "v": "m/s^2"}, time=t)
    found = casest.attempt(wheel_motion, [run])
    assert found.certificate.trusted
    truth = {
        "offset": offset,
        "gain": gain,
        "tilt": 0.8,
        "phase": 0.6,
        "speed": 9.0,
        "friction": 0.004,
        "drag": 4e-4,
        "imbalance": np.array([-0.3, 0.0]),
    }
    for name, expected in truth.items():
        assert np.all(np.abs(found.values[name] - expected) < 4 * found.std[name]), name
