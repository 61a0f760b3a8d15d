"""Where on the sphere a record has been: directions of the corrected vector, and what is left."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.estimate import Estimate

#: Directions that are asked how far the nearest pose is; evenly spread (a Fibonacci lattice).
ASKED = 4000
#: A direction counts as covered where a pose is no further than this, degrees.
NEAR = 30.0


@dataclass(frozen=True)
class Poses:
    """Unit vectors (n, 3) of each pose: `directions` of the corrected reading, `before` of the raw.

    `raw` and `corrected` (n,) are lengths over the known one, before and after the correction;
    `raw` is over its own median, since a reading may be in another unit. `empty` (3,) is the middle
    of the widest cap without a pose, `radius` its half angle in degrees, `covered` the share of all
    directions that have a pose within NEAR degrees.
    """

    directions: Array
    before: Array
    raw: Array
    corrected: Array
    empty: Array
    radius: float
    covered: float


def poses_of(estimate: Estimate) -> Poses | None:
    """The poses of a model whose corrected vector has a known length; None of any other."""
    model = estimate.model
    name, readings = model.traced.corrected, model.readings
    if not model.implicit or name is None or len(readings) != 1 or readings[0].size != 3:
        return None
    value = ca.vec(model.traced.quantities[name].declared)
    if value.numel() != 3:
        return None
    found = estimate.problem.evaluate(estimate.point, {"c": ca.densify(value)})
    vectors = np.vstack([np.asarray(own[0]).reshape(-1, 3) for own in found])
    raw = np.vstack([run.signals[readings[0].name] for run in estimate.problem.runs])
    length, own = np.linalg.norm(vectors, axis=1), np.linalg.norm(raw, axis=1)
    there = np.isfinite(length) & (length > 0) & (own > 0)
    if there.sum() < 3:
        return None
    directions = vectors[there] / length[there, None]
    empty, radius, covered = _coverage(directions)
    known = float(np.median(length[there]))
    shown = own[there] / np.median(own[there])
    before, after = raw[there] / own[there, None], length[there] / known
    return Poses(directions, before, shown, after, empty, radius, covered)


def _coverage(directions: Array) -> tuple[Array, float, float]:
    """Middle and half angle of the widest cap without a pose, and the share that is near one."""
    k = np.arange(ASKED) + 0.5
    height, turn = 1 - 2 * k / ASKED, np.pi * (1 + np.sqrt(5)) * k
    side = np.sqrt(1 - height**2)
    asked = np.column_stack([side * np.cos(turn), side * np.sin(turn), height])
    nearest = np.full(ASKED, -1.0)
    for part in np.array_split(directions, max(1, len(directions) // 2000)):
        nearest = np.maximum(nearest, (asked @ part.T).max(axis=1))
    angle = np.degrees(np.arccos(np.clip(nearest, -1, 1)))
    widest = int(np.argmax(angle))
    return asked[widest], float(angle[widest]), float(np.mean(angle <= NEAR))


def flat(v: Array) -> tuple[Array, Array]:
    """Lambert's azimuthal projection of one half, its rim on the unit circle."""
    with np.errstate(invalid="ignore"):
        scale = 1 / np.sqrt(1 + np.abs(v[:, 2]))
    return v[:, 0] * scale, v[:, 1] * scale


def cap(middle: Array, radius: float) -> Array:
    """The circle at `radius` around a direction, (k, 3)."""
    side = np.cross(middle, np.eye(3)[int(np.argmin(np.abs(middle)))])
    side = side / np.linalg.norm(side)
    other, turn = np.cross(middle, side), np.linspace(0, 2 * np.pi, 121)[:, None]
    around = np.cos(turn) * side + np.sin(turn) * other
    return np.asarray(np.cos(radius) * middle + np.sin(radius) * around)
