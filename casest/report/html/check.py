"""The report of `casest check`: the verdict, what changed, and the control chart."""

from __future__ import annotations

import numpy as np

from casest.data.logs import file_name
from casest.declaration.shapes import Array
from casest.report.html.figures import Figures, axis, panel
from casest.report.html.frame import whole
from casest.report.html.numbers import number, printed_unit
from casest.report.html.page import code_block, paragraph, points, section, table
from casest.results.check import Charted, Checked, changes_of
from casest.results.check_words import drift, reasons, repair


def check_page(result: Checked) -> str:
    """`report.html` of a check, valid or not."""
    figures = Figures()
    verdict = "Still valid." if result.valid else f"Not valid: {' and '.join(result.what)} changed."
    last = result.dates[-1]
    body = [
        section("test", "What was asked", points(map(printed_unit, reasons(last))),
                points(drift(result))),
        section("changed", "What changed", _changes(result), points(repair(last)), _again(result))
        if result.changed
        else "",
        section("chart", "Control chart", _chart(result, figures)),
        _dates(result),
        section("notes", "Noted while reading", points(result.notes)),
    ]  # fmt: skip
    alarms = f"{result.false_alarm_rate:.2g}"
    under = (
        f"By {result.result}; a valid calibration is called invalid with a chance of {alarms} at "
        "each date."
    )
    return whole(result.model, verdict, under, body, figures, result.data, trusted=result.valid,
                 look="good" if result.valid else "bad")  # fmt: skip


def _changes(result: Checked) -> str:
    rows = [
        [f"`{c.name}`", number(c.before), number(c.std_before), number(c.now), number(c.std),
         printed_unit(c.unit)]
        for c in result.changed
    ]  # fmt: skip
    return table(["parameter", "before", "± std", "now", "± std", "unit"], rows, range(1, 5))


def _again(result: Checked) -> str:
    again = result.recalibrate
    if again is None or not again.command:
        return ""
    return code_block(again.command)


def _chart(result: Checked, figures: Figures) -> str:
    lines = result.chart.lines
    if not lines:
        return paragraph("The record shows none of the shared parameters by itself.")
    if len(result.dates) == 1:
        return _one_date(result, figures)
    panels = [panel_of(line, figures) for line in lines]
    caption = (
        "Shift of each unknown from its old value over the dates:",
        "points by themselves, the line their exponentially weighted mean (weight "
        f"{result.chart.weight:g}), the ribbon its limits. Dates in the order given, from 1.",
    )
    return figures.add("control", caption, panels, two=True)


def panel_of(line: Charted, figures: Figures) -> dict[str, object]:
    """One unknown's chart."""
    mean, limit, shift = (_numbers(v) for v in (line.mean, line.limit, line.shift))
    dates = np.arange(1.0, len(mean) + 1)
    every = np.concatenate([mean, limit, -limit, shift[np.isfinite(shift)]])
    outside = f": out at {', '.join(str(k + 1) for k in line.out)}" if line.out else ""
    drawn = [
        figures.series("ribbon", "band", dates, exact=True, low=-limit, high=limit),
        figures.series("dots", "before", dates, exact=True, y=shift),
        figures.series("line", "after", dates, exact=True, y=mean),
    ]
    return panel(
        line.name + outside,
        axis("date", "1", 1.0, float(len(mean)), room=0.05),
        axis("shift", line.unit, float(every.min()), float(every.max()), room=0.08),
        drawn,
        height=160,
    )


def _one_date(result: Checked, figures: Figures) -> str:
    """Shifts of one date in their own standard deviation, the old value's error included."""
    lines = result.chart.lines
    names = [line.name for line in lines]
    std = np.array([
        np.hypot(_numbers(line.std)[0], line.std_before or 0.0) for line in lines
    ])  # fmt: skip
    shift = np.array([_numbers(line.shift)[0] for line in lines]) / std
    most = max(4.0, 1.15 * float(np.abs(shift[np.isfinite(shift)]).max(initial=0.0)))
    at = np.arange(len(names), dtype=float)[::-1]
    drawn = panel(
        "shift of each unknown, all fitted at once",
        axis("shift over its standard deviation", "1", -most, most),
        axis("", "1", -0.6, len(names) - 0.4),
        [figures.series("dots", "after", shift, y=at)],
        categories=names[::-1],
        marks=[{"x": -2.0, "name": "−2"}, {"x": 2.0, "name": "2"}],
        height=64 + 26 * len(names),
    )
    caption = ("Shifts since the calibration:", "unknowns that determine each other move together.")
    return figures.add("control", caption, [drawn])


def _dates(result: Checked) -> str:
    if len(result.dates) < 2:
        return ""
    rows = [
        [str(k + 1), file_name(d.data), "valid" if d.valid else " and ".join(changes_of(d)),
         number(d.p_value, 2), number(d.noise.ratio)]
        for k, d in enumerate(result.dates)
    ]  # fmt: skip
    head = ["date", "record", "verdict", "p", "noise over that of the calibration"]
    return section("dates", "Dates", table(head, rows, [3, 4]))


def _numbers(values: list[float | None]) -> Array:
    return np.array([np.nan if v is None else v for v in values], dtype=float)
