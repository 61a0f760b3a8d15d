"""Make the record that `casest demo` calibrates: python tests/make_demo_record.py

A simulated hand-held accelerometer, from the tests' independent simulator; its truth is kept
beside it, so that the demo can show how far the estimate is from it.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import simulators

FOLDER = Path(__file__).parent.parent / "casest" / "demo"


def main() -> None:
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


if __name__ == "__main__":
    main()
