"""Make the records that are shipped: python tests/make_demo_record.py

A hand-held accelerometer, and one on a wheel with an eccentric mass whose motion is integrated (an
ODE with drag and friction, not the catalogue's formula). From the tests' independent simulators;
the truth is kept beside each, so that the demo can show how far the estimate is from it.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import simulators
from scipy.spatial.transform import Rotation

FOLDER = Path(__file__).parent.parent / "casest" / "demo"


def handheld() -> None:
    rng = np.random.default_rng(2024)
    sensor = simulators.accelerometer(rng)
    poses = simulators.spread_poses(24, rng)
    v, rests = simulators.handheld(sensor, poses, 0.03, rng, rate=50.0, rest=2.0, move=1.0)
    lines = ["ax [m/s^2],ay [m/s^2],az [m/s^2]"]
    lines += [",".join(f"{x:.3f}" for x in row) for row in v]
    (FOLDER / "handheld.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    truth = {
        "norm": sensor.norm,
        "rests": len(rests),
        "parameters": {"scale": sensor.scale.tolist(), "offset": sensor.b.tolist()},
    }
    (FOLDER / "truth.json").write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")


def wheel() -> None:
    rng = np.random.default_rng(2025)
    offset, gain, tilt = np.array([0.35, -0.20, 0.15]), np.array([0.97, 1.01, 1.04]), 0.8
    turn = Rotation.from_euler("XYZ", [30, 20, 25], degrees=True).as_matrix()
    t = np.arange(0, 60, 0.01)
    motion = simulators.physical_motion(t, 0.6, 9.0, eccentric=0.3)
    bench = simulators.Spin(offset, gain, turn, tilt)
    v = bench.read(*motion) + 0.03 * rng.standard_normal((len(t), 3))
    lines = ["t [s],vx [m/s^2],vy [m/s^2],vz [m/s^2]"]
    lines += [f"{s:.2f},{x:.3f},{y:.3f},{z:.3f}" for s, (x, y, z) in zip(t, v, strict=True)]
    (FOLDER / "wheel.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    truth = {
        "effect": "imbalance",
        "parameters": {"offset": offset.tolist(), "gain": gain.tolist(), "tilt": tilt},
    }
    (FOLDER / "wheel_truth.json").write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    handheld()
    wheel()
