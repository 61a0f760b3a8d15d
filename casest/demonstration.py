"""`casest demo`: a shipped simulated record whose truth is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from casest.result import load_result, saved_parameters

FOLDER = Path(__file__).parent / "demo"
RECORD = FOLDER / "handheld.csv"


def comparison(folder: Path) -> str:
    """How far the saved estimate is from the simulated truth, in its own standard deviations."""
    truth = json.loads((FOLDER / "truth.json").read_text(encoding="utf-8"))["parameters"]
    found = saved_parameters(load_result(folder))
    lines = ["The record is simulated, so the truth is known (error in standard deviations):"]
    for name, true in truth.items():
        value, std = np.array(found[name]["value"]), np.array(found[name]["std"])
        known = std > 0
        errors = (value - np.array(true))[known] / std[known]
        lines.append(f"  {name:<7} " + " ".join(f"{z:+.1f}" for z in errors))
    return "\n".join(lines)
