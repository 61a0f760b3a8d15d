"""`casest demo`: shipped simulated records whose truth is known."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casest.results.file import load_result

FOLDER = Path(__file__).parent
#: A hand-held accelerometer, and one on a wheel with an eccentric mass that nobody declared.
RECORD, WHEEL = FOLDER / "handheld.csv", FOLDER / "wheel.csv"


def story(folder: Path) -> str:
    """What the loop on `WHEEL` is worth: the worst number before and after, then all of them.

    The estimates are read from the folder, the truth is that of the simulation.
    """
    truth = json.loads((FOLDER / "wheel_truth.json").read_text(encoding="utf-8"))
    result = load_result(folder)
    rows = list(_rows(result, truth["parameters"]))
    worst = max(rows, key=lambda row: abs(row.before / row.std_before))
    then, now = (abs(worst.before / worst.std_before), abs(worst.after / worst.std_after))
    effects = ", ".join(e["name"] for e in result["effects"])
    size = f"{abs(worst.before):.2g} {worst.unit}".strip()
    lines = [
        f"Before: {worst.label} was wrong by {size}, {then:.0f} of "
        "its printed standard deviations.",
        f"After:  it is within {now:.1f} of them.",
        f"What was missing: {effects}. Nobody had declared that the wheel is out of",
        "balance; the residual fell by 5 % only. The record is simulated, so that the",
        "truth is known; errors (in standard deviations):",
        "",
        f"  {'':<10} {'before':>20} {'after':>20}",
        *(row.line for row in rows),
    ]
    return "\n".join(lines)


@dataclass(frozen=True)
class _Row:
    """Errors of one number before and after, with the standard deviations that were printed."""

    label: str
    unit: str
    before: float
    after: float
    std_before: float
    std_after: float

    @property
    def line(self) -> str:
        cells = [f"{self.before:+.4f} ({self.before / self.std_before:+.1f})",
                 f"{self.after:+.4f} ({self.after / self.std_after:+.1f})"]  # fmt: skip
        return f"  {self.label:<10} {cells[0]:>20} {cells[1]:>20}  {self.unit}".rstrip()


def _rows(result: Mapping[str, Any], truth: Mapping[str, Any]) -> Iterator[_Row]:
    for name, true in truth.items():
        sides = [result[part]["parameters"][name] for part in ("before", "after")]
        value, std = (np.array([np.atleast_1d(s[key]) for s in sides]) for key in ("value", "std"))
        errors, unit = value - np.atleast_1d(true), sides[0]["unit"]
        for k in range(errors.shape[1]):
            label = name if np.ndim(true) == 0 else f"{name}[{k}]"
            yield _Row(label, "" if unit == "1" else unit, *errors[:, k], *std[:, k])


def furthest(values: Mapping[str, Any], std: Mapping[str, Any]) -> float:
    """How far an estimate of `RECORD` is from the truth at most, in standard deviations."""
    truth = json.loads((FOLDER / "truth.json").read_text(encoding="utf-8"))["parameters"]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = [np.abs(values[n] - np.array(true)) / std[n] for n, true in truth.items()]
    return float(max(np.nanmax(one) for one in z))
