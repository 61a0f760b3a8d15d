"""The wheel by its equation of motion, against the independent simulator of a slowing wheel."""

from __future__ import annotations

import json

import numpy as np
import pytest
import simulators
from scipy.spatial.transform import Rotation

import casest
from casest import Run
from casest.cli import run as casest_run
from casest_problems.wheel_motion import wheel_motion


def test_friction_drag_and_imbalance_of_a_long_spin_are_found():
    """150 s, in which a cubic speed law ends; all within four standard deviations of the truth."""
    rng = np.random.default_rng(7)
    t = np.arange(0, 150, 0.08)
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


def spun(folder, name, seed, phase, speed):
    """40 s of a spin as a file, and the specific force that acted, m/s^2."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 40, 0.04)
    motion = simulators.physical_motion(t, phase, speed, eccentric=0.3)
    turn = Rotation.from_euler("XYZ", [30, 20, 25], degrees=True).as_matrix()
    offset, gain = np.array([0.35, -0.2, 0.15]), np.array([0.97, 1.01, 1.04])
    v = simulators.Spin(offset, gain, turn, 0.8).read(*motion)
    noisy = v + 0.03 * rng.standard_normal(v.shape)
    heading = "t [s],vx [m/s^2],vy [m/s^2],vz [m/s^2]"
    path = folder / f"{name}.csv"
    np.savetxt(path, np.column_stack([t, noisy]), "%.6f", ",", header=heading, comments="")
    return str(path), (v - offset) / gain


@pytest.mark.long
def test_a_second_spin_is_foretold_and_corrected(tmp_path, capsys):
    """Held out, only its own phase, speed, tilt and mounting are fitted; corrected are readings."""
    first, _ = spun(tmp_path, "one", 1, 0.6, 9.0)
    second, force = spun(tmp_path, "two", 2, -1.1, 11.0)
    words = ["calibrate", "wheel-motion", first, "--holdout", second, "-o", str(tmp_path / "w")]
    assert casest_run(words) == 0
    found = json.loads((tmp_path / "w/result.json").read_text())["estimate"]
    assert 0.027 < found["rmse_holdout"] < 0.033
    capsys.readouterr()
    assert casest_run(["apply", str(tmp_path / "w"), second]) == 0
    rows = capsys.readouterr().out.splitlines()[1:]
    corrected = np.array([row.split(",") for row in rows], float)[:, -3:]
    off = corrected - force
    # Noise of 0.03 over the gain, and what gain and offset are uncertain by.
    offset, gain = (np.array(found["parameters"][name]["std"]) for name in ("offset", "gain"))
    moving = np.hypot(0.032, 4 * gain * np.std(force, axis=0))
    assert np.all(np.std(off, axis=0) < moving)
    still = 4 * np.hypot(offset, gain * np.abs(np.mean(force, axis=0)))
    assert np.all(np.abs(np.mean(off, axis=0)) < still)
