"""`plan.html` of a motion: inputs to fly and the states over time."""

from __future__ import annotations

import numpy as np

from casest.report.html.figures import Figures, axis, panel
from casest.report.html.fitted import reproduction
from casest.report.html.frame import whole
from casest.report.html.numbers import printed_unit, two_digits
from casest.report.html.page import paragraph, points, section, table
from casest.results.motion_plan import PlannedMotion, motion_headline, motion_words


def motion_page(result: PlannedMotion) -> str:
    """Limits, the motion over time, what it shows, how good it is."""
    figures = Figures()
    body = [
        _limits(result),
        section("motion", "The motion", _drawn(result, figures)),
        _stds(result),
        section("how", "How good the motion is", points(motion_words(result))),
        reproduction(result.reproduce),
    ]
    look = "good" if result.rank == result.unknowns else "bad"
    return whole(result.model, motion_headline(result), "", body, figures, [], look=look)


def _limits(result: PlannedMotion) -> str:
    rows = [[limit.words, f"{100 * limit.share:.0f} %"] for limit in result.limits]
    return section("limits", "Within which limits", table(["limit", "taken"], rows, [1]))


def _drawn(result: PlannedMotion, figures: Figures) -> str:
    """Every signal over time, one panel each."""
    time = np.asarray(result.run.time)
    t = axis("time", "s", float(time[0]), float(time[-1]))
    panels = []
    for name, values in result.run.signals.items():
        for k, column in enumerate(values.T if name != "t" else ()):
            one = name if values.shape[1] == 1 else f"{name}[{k}]"
            low, high = float(column.min()), float(column.max())
            y = axis(one, result.run.units.get(name) or "1", low, high, room=0.08)
            panels.append(panel(one, t, y, [figures.series("line", "after", time, y=column)]))
    caption = (
        "Inputs to fly, and the readings to expect.",
        "plan.csv holds them sample by sample.",
    )
    return figures.add("inputs", caption, panels, two=True, zoom=True)


def _stds(result: PlannedMotion) -> str:
    rows = [
        [f"`{name}`", two_digits(s.planned), two_digits(s.random), printed_unit(s.unit)]
        for name, s in result.std.items()
    ]
    said = paragraph(
        "One standard deviation of each state at the beginning, as the readings alone allow; "
        "beside it that of a random motion with inputs in the same limits."
    )
    head = ["state", "planned", "random", "unit"]
    return section("shown", "What it shows", said, table(head, rows, [1, 2]))
