"""`casest demo`: shipped simulated records whose truth is known."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casest.results.file import load_result

FOLDER = Path(__file__).parent
#: A hand-held accelerometer, and one on a wheel with an eccentric mass that nobody declared.
RECORD, WHEEL = FOLDER / "handheld.csv", FOLDER / "wheel.csv"


def comparison(folder: Path) -> str:
    """Errors of the saved estimates before and after, as the simulated truth shows them."""
    truth = json.loads((FOLDER / "wheel_truth.json").read_text(encoding="utf-8"))
    result = load_result(folder)
    lines = [
        "The record is simulated: a wheel with an eccentric mass, integrated as a physical body.",
        "So the truth is known; errors in m/s^2, of 1, in rad (in standard deviations):",
        f"  {'':<10} {'before':>20} {'after':>20}",
    ]
    for name, true in truth["parameters"].items():
        for k, value in enumerate(np.atleast_1d(true)):
            label = name if np.ndim(true) == 0 else f"{name}[{k}]"
            cells = [_error(result[part], name, k, value) for part in ("before", "after")]
            lines.append(f"  {label:<10} {cells[0]:>20} {cells[1]:>20}")
    return "\n".join(lines)


def _error(part: Mapping[str, Any], name: str, k: int, true: float) -> str:
    found = part["parameters"][name]
    value, std = np.atleast_1d(found["value"])[k], np.atleast_1d(found["std"])[k]
    return f"{value - true:+.4f} ({(value - true) / std:+.1f})"


def furthest(values: Mapping[str, Any], std: Mapping[str, Any]) -> float:
    """How far an estimate of `RECORD` is from the truth at most, in standard deviations."""
    truth = json.loads((FOLDER / "truth.json").read_text(encoding="utf-8"))["parameters"]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = [np.abs(values[n] - np.array(true)) / std[n] for n, true in truth.items()]
    return float(max(np.nanmax(one) for one in z))
