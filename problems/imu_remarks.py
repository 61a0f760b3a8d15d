"""What an engineer would notice about an IMU's record by hand, and what is no calibration of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import Model, NotTrusted, Run

from .imu_clock import late
from .pair import flat, held_values

Array = NDArray[np.float64]

#: Squares of the rate about one axis over those about another, below which it is left out.
LITTLE_TURNED = 1e-3
#: Share of the angle between one direction of gravity and the next that turns may miss it by.
MISSED = 0.05
#: Chance below which the offset at rest is said to follow the force.
FOLLOWS = 1e-3


def remarks(declared: Model, runs: Sequence[Run], values: Mapping[str, Any]) -> Iterator[str]:
    """Poses in a plane, an offset that follows the force, sensors that are not read together."""
    known = {**held_values(declared), **{n: np.asarray(v) for n, v in values.items()}}
    sensors = {"accelerometer": ("a", "gravity"), "magnetometer": ("m", "field")}
    present = {s.name for s in declared.signals}
    for sensor, (name, length) in sensors.items():
        if name in present:
            v = np.vstack([run.signals[name] for run in runs])
            gain = abs(np.linalg.det(known[f"{sensor}_scale"])) ** (1 / 3)
            yield from flat(v - v.mean(axis=0), float(known[length]) / gain, sensor)
    if not known["g_sensitivity"].any() and "g_sensitivity" not in values:
        yield from _following(runs, known)
    if "gyroscope_delay" not in values:
        yield from late(runs, known)


def refuse_few_axes(runs: Sequence[Run], bias: Array) -> None:
    """Raise NotTrusted where the turns leave an axis of the gyroscope out, or there are none."""
    turning, noise = np.zeros((3, 3)), []
    for run in runs:
        assert run.averaged is not None
        w = run.averaged.run.signals["w"] - bias
        for i, j in zip(run.averaged.last[:-1], run.averaged.first[1:], strict=True):
            turning += w[i:j].T @ w[i:j] / max(sum(map(len, runs)), 1)
        for i, j in zip(run.averaged.first, run.averaged.last, strict=True):
            noise.append(np.mean(np.var(w[i : j + 1], axis=0)))
    squares, axes = np.linalg.eigh(turning)
    if squares[0] > LITTLE_TURNED * squares[2] and squares[2] > np.mean(noise):
        return
    axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
    said = ", ".join(f"{x:.2f}" for x in axis)
    raise NotTrusted(
        f"the turns leave an axis of the gyroscope out: along ({said}) of w there is "
        f"{np.sqrt(max(squares[0], 0) / max(squares[2], 1e-300)):.1%} of what there is along "
        "another, which does not determine its scale: turn about all three axes"
    )


def _following(runs: Sequence[Run], known: Mapping[str, Array]) -> Iterator[str]:
    """Does the gyroscope's offset at rest follow the force?"""
    from scipy.special import fdtrc

    a, w = (np.vstack([run.signals[name] for run in runs]) for name in ("a", "w"))
    if len(a) < 8:
        return
    force = (a - known["accelerometer_offset"]) @ known["accelerometer_scale"].T
    design = np.column_stack([np.ones(len(force)), force])
    left = w - design @ np.linalg.lstsq(design, w, rcond=None)[0]
    before, after = (np.sum((x - x.mean(axis=0)) ** 2, axis=0) for x in (w, left))
    F = (before - after) / 3 / (after / (len(w) - 4))
    p = float(3 * np.min(fdtrc(3, len(w) - 4, F)))
    if p < FOLLOWS:
        share = float(1 - after.sum() / before.sum())
        yield (
            f"the gyroscope's offset at rest follows the force ({share:.0%} of its scatter, "
            f"p = {p:.1g}): --free g_sensitivity"
        )


def refusals(declared: Model, runs: Sequence[Run], values: Mapping[str, Any]) -> Iterator[str]:
    """Turns that miss where they should lead to: a wrong valley, or not one unit's record."""
    known = {**held_values(declared), **{n: np.asarray(v) for n, v in values.items()}}
    scale, offset = known["accelerometer_scale"], known["accelerometer_offset"]
    angles = []
    for run in runs:
        force = (run.signals["a"] - offset) @ scale.T
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        angles.append(np.arccos(np.clip(np.sum(up[1:] * up[:-1], axis=1), -1, 1)))
    usual = np.degrees(np.sqrt(np.mean(np.concatenate(angles) ** 2)))
    missed = float(known["turn_noise"]) * np.sqrt(2)
    if missed > MISSED * usual:
        yield (
            f"the turns miss the next rest by {missed:.3g}° (of {usual:.3g}° between rests): this "
            "is a wrong solution, or the two sensors are not of one unit or one clock; leave "
            "--start out, and check the signs and the order of the axes"
        )
