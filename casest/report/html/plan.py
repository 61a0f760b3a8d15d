"""`plan.html` of `casest plan`: a sheet to measure by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from casest.report.html.figures import Figures
from casest.report.html.fitted import reproduction
from casest.report.html.frame import whole
from casest.report.html.numbers import number, printed_unit, two_digits
from casest.report.html.page import escaped, paragraph, points, section, table, tag
from casest.report.html.sphere import sphere
from casest.results.plan import Plan, headline, plan_words


def plan_page(result: Plan) -> str:
    """What to measure, in order, with a box to tick; the sphere; what it brings; how good it is."""
    body = [
        _sheet(result),
        _sphere(result),
        _unknowns(result),
        section("how", "How good the plan is", points(plan_words(result))),
        reproduction(result.reproduce),
    ]
    return whole(result.declared, headline(result), "", body, Figures(), [])


def _sheet(result: Plan) -> str:
    """One line for each measurement."""
    if not result.measurements:
        return ""
    rows = [
        [
            "☐",
            str(m.number),
            m.words,
            _expected(m.signals),
            f"{100 * m.told_apart:.0f} %" if m.told_apart else number(m.std_ratio),
        ]
        for m in result.measurements
    ]
    brings = "told apart" if result.separates else "std becomes ×"
    units = ", ".join(
        f"{n} in {printed_unit(u)}" for n, u in result.units.items() if u and u != "1"
    )
    head = ["", "no.", result.things[:-1], "expected", brings]
    said = f"Expected readings: {units}." if units else ""
    return section(
        "sheet", "What to measure", paragraph(said) if said else "", table(head, rows, [1, 4])
    )


def _expected(signals: dict[str, Any]) -> str:
    said = []
    for name, value in signals.items():
        values = value if isinstance(value, list) else [value]
        if len(values) <= 3:
            said.append(f"{name} {', '.join(number(float(v)) for v in values)}")
    return "; ".join(said)


def _sphere(result: Plan) -> str:
    up = [m.up for m in result.measurements if m.up]
    if not up:
        return ""
    caption = tag(
        "figcaption",
        tag("b", "Which axis is up."),
        " ",
        escaped(
            "Circles with numbers: planned. Small dots: measured already. Left the half with z up, "
            "right the half with z down; areas are true. The inner circle is 45° from z."
        ),
    )
    empty = paragraph(result.emptiest) if result.emptiest else ""
    return section("sphere", "Where they lie", tag("figure", caption, _drawn(up, result)), empty)


def _drawn(up: Sequence[Sequence[float]], result: Plan) -> str:
    return tag("div", sphere(up, result.covered), class_="drawn", tabindex="0", role="group",
               aria_label="sphere of directions")  # fmt: skip


def _unknowns(result: Plan) -> str:
    if not result.unknowns:
        return ""
    rows = [
        [
            f"`{n}`",
            two_digits(u.before),
            two_digits(u.after),
            printed_unit(u.unit).removeprefix("1"),
        ]
        for n, u in result.unknowns.items()
    ]  # fmt: skip
    times = "" if result.noise.stated else " In units of the noise, which nobody stated."
    said = paragraph(f"One standard deviation of each unknown.{times}")
    return section(
        "unknowns",
        "What it brings",
        said,
        table(["unknown", "before", "after", "unit"], rows, [1, 2]),
    )
