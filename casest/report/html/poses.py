"""The sphere of poses: which directions a record has seen, and lengths before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.figures import Figures, axis, panel
from casest.report.html.numbers import number
from casest.results.poses import NEAR, Poses

#: Poses that are drawn.
DRAWN = 4000


def poses_seen(poses: Poses | None, figures: Figures) -> str:
    """Two halves of the sphere of equal area, and the length of each reading; nothing elsewhere."""
    if poses is None:
        return ""
    halves = [_half(poses, figures, sign) for sign in (1, -1)]
    where = ", ".join(number(v, 2) for v in poses.empty)
    seen = figures.add(
        "sphere",
        (
            "Directions of the poses.",
            f"The sphere from above and below, equal areas as they are. "
            f"{100 * poses.covered:.0f} % of all directions have a pose within {NEAR:g}°; the "
            f"widest empty cap (outlined) has a half angle of {poses.radius:.0f}° around "
            f"({where}).",
        ),
        halves,
        two=True,
    )
    return seen + _lengths(poses, figures)


def _half(poses: Poses, figures: Figures, sign: int) -> dict[str, Any]:
    turn = np.linspace(0, 2 * np.pi, 181)
    edge = figures.series("line", "rim", np.cos(turn), y=np.sin(turn), exact=True)
    chosen = poses.directions[:: max(1, len(poses.directions) // DRAWN)]
    x, y = _flat(chosen[chosen[:, 2] * sign >= 0], sign)
    dots = figures.series("points", "after", x, y=y, exact=True)
    cap = _cap(poses.empty, np.radians(poses.radius))
    cap_x, cap_y = _flat(np.where((cap[:, 2] * sign >= 0)[:, None], cap, np.nan), sign)
    outline = figures.series("line", "before", cap_x, y=cap_y, exact=True)
    drawn = [edge, dots] + ([outline] if np.isfinite(cap_x).any() else [])
    title = "z up" if sign > 0 else "z down"
    span = axis("direction [0]", "1", -1.04, 1.04), axis("direction [1]", "1", -1.04, 1.04)
    return panel(title, *span, drawn, height=330, square=True)


def _flat(v: Array, sign: int) -> tuple[Array, Array]:
    """Lambert's azimuthal projection of one half, its rim on the unit circle."""
    with np.errstate(invalid="ignore"):
        scale = 1 / np.sqrt(1 + np.abs(v[:, 2]))
    return v[:, 0] * scale, v[:, 1] * scale


def _cap(middle: Array, radius: float) -> Array:
    """The circle at `radius` around a direction, (k, 3)."""
    side = np.cross(middle, np.eye(3)[int(np.argmin(np.abs(middle)))])
    side = side / np.linalg.norm(side)
    other, turn = np.cross(middle, side), np.linspace(0, 2 * np.pi, 121)[:, None]
    around = np.cos(turn) * side + np.sin(turn) * other
    return np.asarray(np.cos(radius) * middle + np.sin(radius) * around)


def _lengths(poses: Poses, figures: Figures) -> str:
    step = max(1, len(poses.raw) // DRAWN)
    x = np.arange(1, len(poses.raw) + 1, dtype=float)[::step]
    raw, corrected = (100 * (v[::step] - 1) for v in (poses.raw, poses.corrected))
    far = float(max(np.abs(raw).max(), np.abs(corrected).max())) or 1.0
    drawn = [
        figures.series("points", "before", x, y=raw) | {"name": "reading"},
        figures.series("points", "after", x, y=corrected) | {"name": "corrected"},
    ]
    shown = panel(
        "length",
        axis("pose number", "1", 1.0, float(len(poses.raw)), room=0.02),
        axis("off its median", "%", -far, far, room=0.06),
        drawn,
        height=190,
    )
    caption = (
        "Length of every reading before and after.",
        "It is one in every pose, if all is right.",
    )
    return figures.add("lengths", caption, [shown])
