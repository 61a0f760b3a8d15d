"""The sphere of poses: which directions a record has seen, and lengths before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.figures import Figures, axis, panel
from casest.report.html.numbers import number
from casest.results.poses import NEAR, Poses, cap, flat

#: Poses that are drawn: of each half as dots, of the lengths as a line.
DOTS, DRAWN = 400, 4000


def poses_seen(poses: Poses | None, figures: Figures) -> str:
    """Two halves of the sphere of equal area, and the length of each reading; nothing elsewhere."""
    if poses is None:
        return ""
    halves = [_half(poses, figures, sign) for sign in (1, -1)]
    where = ", ".join(number(v, 2) for v in poses.empty)
    seen = figures.add(
        "sphere",
        (
            "Directions of the poses, before and after.",
            f"The sphere from above and below, equal areas as they are. "
            f"{100 * poses.covered:.0f} % of all directions have a pose within {NEAR:g}°; the "
            f"widest empty cap (dashed) has a half angle of {poses.radius:.0f}° around "
            f"({where}).",
        ),
        halves,
        two=True,
    )
    return seen + _lengths(poses, figures)


def _half(poses: Poses, figures: Figures, sign: int) -> dict[str, Any]:
    turn = np.linspace(0, 2 * np.pi, 181)
    edge = figures.series("line", "rim", np.cos(turn), y=np.sin(turn), exact=True)
    dots = []
    for vectors, look, name in (
        (poses.before, "before", "reading"),
        (poses.directions, "after", "corrected"),
    ):
        x, y = _told_apart(*flat(vectors[vectors[:, 2] * sign >= 0]))
        dots.append(figures.series("points", look, x, y=y, exact=True) | {"name": name})
    rim = cap(poses.empty, np.radians(poses.radius))
    cap_x, cap_y = flat(np.where((rim[:, 2] * sign >= 0)[:, None], rim, np.nan))
    outline = figures.series("line", "edge", cap_x, y=cap_y, exact=True) | {"bare": True}
    drawn = [edge, *dots] + ([outline] if np.isfinite(cap_x).any() else [])
    title = "z up" if sign > 0 else "z down"
    span = axis("direction [0]", "1", -1.04, 1.04), axis("direction [1]", "1", -1.04, 1.04)
    return panel(title, *span, drawn, height=330, square=True)


def _told_apart(x: Array, y: Array) -> tuple[Array, Array]:
    """Points that an eye can tell apart: one of each place, and places as wide as it takes."""
    for apart in (0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1):
        if len(x) <= DOTS:
            break
        places = np.floor(np.column_stack([x, y]) / apart) if apart else np.column_stack([x, y])
        kept = np.sort(np.unique(places, axis=0, return_index=True)[1])
        x, y = x[kept], y[kept]
    return x, y


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
