"""Profiles of the likelihood beside the parabola that standard deviations suppose."""

from __future__ import annotations

from collections.abc import Sequence

from casest.report.html.figures import Figures, axis, panel
from casest.results.profiles import ProfileOf


def profile_figures(profiles: Sequence[ProfileOf], figures: Figures) -> str:
    """A panel for each unknown: twice the cost's rise over σ², all others fitted again."""
    panels = []
    for p in profiles:
        across = axis("value", p.unit, float(p.value[0]), float(p.value[-1]))
        upright = axis("rise", "1", 0.0, p.highest, room=0.04)
        lines = [
            figures.series("line", look, p.value, exact=False, y=y.clip(max=p.highest))
            for look, y in (("before", p.parabola), ("after", p.rise))
        ]
        inside = [{"low": 0.0, "high": p.inside}]
        panels.append(panel(p.name, across, upright, lines, bands=inside, height=185))
    caption = (
        "The likelihood's profile.",
        "How far the sum of squares rises, over the variance of one residual, as one unknown is "
        "held and all others are fitted again; the other line is the parabola that a standard "
        "deviation supposes. Shaded: the 95 % interval.",
    )
    return figures.add("profiles", caption, panels, two=len(panels) > 1)
