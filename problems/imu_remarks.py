"""What an engineer would notice about an IMU's record by hand, and what is no calibration of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import Model, Run

from .pair import flat, held_values

Array = NDArray[np.float64]

#: Angle (rad) about an axis, all turns together, below which nothing is said of that axis.
LITTLE_TURNED = np.pi / 2
#: Share of the angle between one direction of gravity and the next that turns may miss it by.
MISSED = 0.05
#: Chance below which the offset at rest is said to follow the force.
FOLLOWS = 1e-3


def remarks(declared: Model, runs: Sequence[Run], values: Mapping[str, Any]) -> Iterator[str]:
    """Poses in a plane, turns about too few axes, an offset that follows the force."""
    known = {**held_values(declared), **{n: np.asarray(v) for n, v in values.items()}}
    sensors = {"accelerometer": ("a", "gravity"), "magnetometer": ("m", "field")}
    present = {s.name for s in declared.signals}
    for sensor, (name, length) in sensors.items():
        if name in present:
            v = np.vstack([run.signals[name] for run in runs])
            gain = abs(np.linalg.det(known[f"{sensor}_scale"])) ** (1 / 3)
            yield from flat(v - v.mean(axis=0), float(known[length]) / gain, sensor)
    yield from _axes(runs, known)
    if not known["g_sensitivity"].any() and "g_sensitivity" not in values:
        yield from _following(runs, known)


def _rates(runs: Sequence[Run], known: Mapping[str, Array]) -> Iterator[tuple[Array, Array]]:
    """Rate (N, 3) between rests and the time of each sample, run by run."""
    for run in runs:
        assert run.averaged is not None
        raw = run.averaged.run
        steps = np.gradient(np.asarray(raw.time))
        moving = np.zeros(len(raw), dtype=bool)
        for i, j in zip(run.averaged.last[:-1], run.averaged.first[1:], strict=True):
            moving[i:j] = True
        rate = (raw.signals["w"] - known["gyroscope_offset"]) @ known["gyroscope_scale"].T
        yield rate[moving], steps[moving]


def _axes(runs: Sequence[Run], known: Mapping[str, Array]) -> Iterator[str]:
    """An axis about which the unit is hardly turned."""
    parts = list(_rates(runs, known))
    rate, step = (np.concatenate(part) for part in zip(*parts, strict=True))
    axes = np.linalg.eigh(rate.T @ (rate * step[:, None]))[1]
    turned = [float(np.sum(np.abs(rate @ axis) * step)) for axis in axes.T]
    left_out = [axis for axis, angle in zip(axes.T, turned, strict=True) if angle < LITTLE_TURNED]
    if left_out:
        axis = left_out[0] * np.sign(left_out[0][np.argmax(np.abs(left_out[0]))])
        said = ", ".join(f"{x:.2f}" for x in axis)
        yield (
            f"the turns leave an axis out: about ({said}) the unit is turned by "
            f"{np.degrees(min(turned)):.0f}° in all, which does not determine what the gyroscope "
            "makes of it: turn about all three axes, a quarter turn or more each time"
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
