"""Attitudes that a person can set by hand, and their words: "z up, then tilt 45° about x".

A sensor lies on one of its faces (in one of four directions, where that matters) and is tilted
about one of its own axes, then about another. R turns what the sensor sees into the reference
frame, whose z axis points up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array

#: Degrees between tilts, and the largest from a face: there the next face begins.
STEP, FURTHEST = 15.0, 45.0
#: Directions closer than this (degrees) are one.
SAME = 0.5
NAMES = "xyz"


@dataclass(frozen=True)
class Frame:
    """What the words call the reference frame's z axis and, where it matters, its x axis."""

    up: str = "up"
    down: str = "down"
    ahead: str = ""


def tilted(up: int, sign: int, first: float, second: float) -> Array:
    """Where up is for a sensor lying with axis `up` (times sign) up, then tilted, (3,).

    `first` and `second` (rad): about the next axis in the order x y z, then about the one after.
    """
    a, b = (up + 1) % 3, (up + 2) % 3
    found = np.zeros(3)
    found[up] = np.cos(first) * np.cos(second)
    found[a] = -np.cos(first) * np.sin(second)
    found[b] = np.sin(first)
    return sign * found


def directions(step: float = STEP, reach: float | None = None) -> Array:
    """Directions of up in the sensor's frame (N, 3), from each face in tilts of `step` degrees.

    `reach`: the largest angle in degrees from z up that can be set; None for any.
    """
    tilts = np.radians(_tilts(step))
    every = [
        tilted(up, sign, first, second)
        for up in (2, 0, 1)
        for sign in (1, -1)
        for first in tilts
        for second in tilts
    ]
    found = np.array(every)
    if reach is not None:
        found = found[found[:, 2] >= np.cos(np.radians(reach)) - 1e-9]
    return _different(found, np.cos(np.radians(SAME)))


def _tilts(step: float) -> Array:
    """From −45° to 45°, zero first: what is simplest comes first."""
    count = int(FURTHEST / step + 1e-9)
    sizes = [step * k for k in range(1, count + 1)]
    return np.array([0.0, *(s * size for size in sizes for s in (1, -1))])


def _different(found: Array, near: float) -> Array:
    """The first of each group of directions that are alike."""
    kept: list[int] = []
    for i, direction in enumerate(found):
        if not kept or np.max(found[kept] @ direction) < near:
            kept.append(i)
    return found[kept]


def attitudes(step: float = STEP, reach: float | None = None) -> Array:
    """Rotations (N, 3, 3), sensor to reference: every direction of up, on each of four sides."""
    found = []
    for up in directions(step, reach):
        axis, sign, first, second = faces(up)
        for ahead in _sides(axis):
            found.append(_attitude(axis, sign, ahead, first, second))
    return np.array(found)


def faces(up: Array) -> tuple[int, int, float, float]:
    """The face from which a direction of up is reached with the fewest, roundest, smallest tilts.

    Axis, sign, and the two angles in rad, as `tilted` takes them.
    """
    best: tuple[tuple[int, int, float], tuple[int, int, float, float]] | None = None
    for axis in (2, 0, 1):
        sign = 1 if up[axis] >= 0 else -1
        a, b = (axis + 1) % 3, (axis + 2) % 3
        first = float(np.arcsin(np.clip(sign * up[b], -1, 1)))
        second = float(np.arctan2(-sign * up[a], sign * up[axis]))
        if max(abs(first), abs(second)) > np.radians(FURTHEST + 12):
            continue
        tilts = sum(abs(angle) > np.radians(SAME) for angle in (first, second))
        odd = sum(abs(a - np.radians(5) * round(a / np.radians(5))) > 1e-6 for a in (first, second))
        rank = (tilts, odd, round(abs(first) + abs(second), 6))
        if best is None or rank < best[0]:
            best = rank, (axis, sign, first, second)
    assert best is not None
    return best[1]


def _sides(axis: int) -> list[tuple[int, int]]:
    a, b = (axis + 1) % 3, (axis + 2) % 3
    return [(a, 1), (b, 1), (a, -1), (b, -1)]


def _attitude(axis: int, sign: int, ahead: tuple[int, int], first: float, second: float) -> Array:
    """Sensor to reference: `axis` up and `ahead` along the reference's x, then tilted."""
    lying = np.zeros((3, 3))
    lying[2, axis], lying[0, ahead[0]] = sign, ahead[1]
    lying[1] = np.cross(lying[2], lying[0])
    return lying @ about((axis + 1) % 3, first) @ about((axis + 2) % 3, second)


def about(axis: int, angle: float) -> Array:
    """Rotation by an angle (rad) about one axis, (3, 3)."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    found = np.eye(3)
    found[a, a] = found[b, b] = np.cos(angle)
    found[a, b], found[b, a] = -np.sin(angle), np.sin(angle)
    return found


def words(up: Array, frame: Frame = Frame(), side: str = "") -> str:
    """How a person sets this direction of up (3,): the face, then the tilts."""
    axis, sign, first, second = faces(up)
    said = f"{NAMES[axis]} {frame.up if sign > 0 else frame.down}{side}"
    order = ((first, (axis + 1) % 3), (second, (axis + 2) % 3))
    tilts = [(angle, k) for angle, k in order if abs(angle) > np.radians(SAME)]
    for i, (angle, k) in enumerate(tilts):
        verb = "then tilt " if i == 0 else "then "
        said += f", {verb}{_degrees(angle)} about {NAMES[k]}"
    return said


def attitude_words(R: Array, frame: Frame) -> str:
    """How a person sets an attitude (3, 3), sensor to reference."""
    axis, _, first, second = faces(R[2])
    lying = R @ about((axis + 2) % 3, second).T @ about((axis + 1) % 3, first).T
    ahead = int(np.argmax(np.abs(lying[0])))
    side = f", {'' if lying[0, ahead] > 0 else '−'}{NAMES[ahead]} {frame.ahead}"
    return words(R[2], frame, side)


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.0f}°".replace("-", "−")
