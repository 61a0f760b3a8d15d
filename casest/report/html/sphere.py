"""Directions on a sphere, as two discs of equal area: the half around z up, and the half below."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.page import escaped, tag

#: Radius of a disc, and the room around it, in pixels.
RADIUS, ROOM = 120, 22
#: A number is shown beside its point, of as many points as can be told apart.
NUMBERED = 60


def sphere(planned: Sequence[Sequence[float]], covered: Sequence[Sequence[float]]) -> str:
    """An SVG of planned directions with their numbers, and of those covered already."""
    width, height = 4 * (RADIUS + ROOM), 2 * (RADIUS + ROOM)
    parts = [_disc(k, sign) for k, sign in enumerate((1, -1))]
    for direction in covered:
        x, y = _place(np.asarray(direction))
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" class="there"/>')
    for (x, y), said in _numbered(planned):
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" class="after" fill="none"/>')
        if said:
            parts.append(
                f'<text x="{x + 6:.1f}" y="{y + 4:.1f}" class="label">{escaped(said)}</text>'
            )
    label = f"{len(planned)} planned directions and {len(covered)} covered ones on two half spheres"
    return tag(
        "svg", *parts, viewBox=f"0 0 {width} {height}", role="img", aria_label=label
    ).replace("aria_label", "aria-label")


def _numbered(planned: Sequence[Sequence[float]]) -> list[tuple[tuple[float, float], str]]:
    """Places with the numbers of all that are there."""
    places: dict[tuple[float, float], list[int]] = {}
    for k, direction in enumerate(planned):
        x, y = _place(np.asarray(direction))
        places.setdefault((round(x, 1), round(y, 1)), []).append(k + 1)
    few = len(planned) <= NUMBERED
    return [(place, ",".join(map(str, ks)) if few else "") for place, ks in places.items()]


def _disc(k: int, sign: int) -> str:
    x, y = (2 * k + 1) * (RADIUS + ROOM), RADIUS + ROOM
    name = "z" if sign > 0 else "−z"
    parts = [
        f'<circle cx="{x}" cy="{y}" r="{RADIUS}" class="frame"/>',
        f'<circle cx="{x}" cy="{y}" r="{RADIUS * np.sqrt(2) * np.sin(np.pi / 8):.1f}" class="grid" '
        'fill="none"/>',
        f'<path d="M{x - RADIUS} {y}H{x + RADIUS}M{x} {y - RADIUS}V{y + RADIUS}" class="grid"/>',
        f'<text x="{x}" y="{y - 4}" text-anchor="middle" class="title">{name}</text>',
    ]
    for dx, dy, text in ((1, 0, "x"), (-1, 0, "−x"), (0, -1, "y"), (0, 1, "−y")):
        at = RADIUS + 11
        parts.append(
            f'<text x="{x + dx * at}" y="{y + dy * at + 4}" text-anchor="middle">{text}</text>'
        )
    return "".join(parts)


def _place(direction: Array) -> tuple[float, float]:
    """Equal-area projection (Lambert 1772) of a unit vector, from +z or −z, in pixels."""
    x, y, z = direction / np.linalg.norm(direction)
    half = 0 if z >= -1e-9 else 1
    factor = RADIUS / np.sqrt(1 + abs(z))
    middle = (2 * half + 1) * (RADIUS + ROOM)
    return float(middle + factor * x), float(RADIUS + ROOM - factor * y)
