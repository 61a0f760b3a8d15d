"""The page of `casest report`: parameters of several results with their intervals."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from casest.report.html.figures import Figures, axis, panel
from casest.report.html.frame import whole
from casest.report.html.numbers import number, printed, printed_unit, two_digits, with_unit
from casest.report.html.page import escaped, paragraph, prose, scrolled, section, table, tag
from casest.results.rounding import rounded
from casest.results.side_by_side import Across, SideBySide, name_of_data

#: Results that are drawn as rows with their names; more stand beside each other with numbers.
ROWS = 14
#: Results whose values stand in the table too.
TABLED = 3


def side_by_side_page(result: SideBySide, folder: Path) -> str:
    """What differs first, then every number with its intervals, then the results."""
    figures = Figures()
    found = result.differing
    several = len(result.results) > 1
    under = ""
    if several:
        under = (
            "Use one calibration for all only where they agree: what differs has changed between "
            "the results, or their standard deviations are too small."
            if found
            else "What differs between them is what their standard deviations foretell."
        )
    rest = [n for n in result.numbers if n not in found]
    body = [
        section("differs", "What differs", *(_figures(result, found, figures, "differs")))
        if found else "",
        section("numbers", "All numbers", _said(result), table(*_table(result))),
        section("intervals", "Intervals", *_figures(result, rest, figures, "all")),
        section("results", "The results", _results(result, folder)),
    ]  # fmt: skip
    return whole(result.model, f"{result.sentence}.", under, body, figures, [],
                 trusted=all(r.trusted for r in result.results),
                 look="doubtful" if found else "good")  # fmt: skip


def _said(result: SideBySide) -> str:
    if len(result.results) == 1:
        return paragraph("± is one standard deviation.")
    return paragraph(
        "Mean: weighted by the inverse variances. Spread: standard deviation between the results. "
        "p: the chance of so much difference if all were one number and the results independent "
        f"(Welch 1951); what lies below {result.level:g} divided by the count of numbers differs. "
        "Estimates that were refused are drawn and not counted."
    )


def _table(result: SideBySide) -> tuple[list[str], list[list[str]], range]:
    several = len(result.results) > 1
    each = [r.label for r in result.results] if len(result.results) <= TABLED else []
    pooled = ["mean", "± std", "spread", "p"] if several else []
    head = ["number", *each, *pooled, "unit"]
    rows = [
        [f"`{n.name}`", *_each(n, len(each)), *(_mean(n) if several else []),
         printed_unit(n.unit)]
        for n in result.numbers
    ]  # fmt: skip
    return head, rows, range(1, len(head) - 1)


def _each(n: Across, count: int) -> Iterator[str]:
    for v in n.values[:count]:
        if v is None or v.value is None:
            yield "–"
        elif v.std is None:
            yield number(v.value, 6)
        else:
            yield " ± ".join(map(printed, rounded(v.value, v.std)))


def _mean(n: Across) -> list[str]:
    if n.mean is None or n.mean_std is None:
        return ["–", "–", "–", "–"]
    value, std = map(printed, rounded(n.mean, n.mean_std))
    return [value, std, two_digits(n.spread), number(n.p_value, 2)]


def _figures(
    result: SideBySide, numbers: list[Across], figures: Figures, name: str
) -> Iterator[str]:
    """A panel for each number: rows with names, or points over what orders the results."""
    drawn = [n for n in numbers if any(v is not None and v.value is not None for v in n.values)]
    if not drawn:
        return
    rows = result.over is None and len(result.results) <= ROWS
    panels = [(_as_rows if rows else _as_points)(result, n, figures) for n in drawn]
    mean = "Dashed: the weighted mean." if rows else "Shaded: the weighted mean, 95 %."
    caption = ("Values and their 95 % intervals.", mean if len(result.results) > 1 else "")
    yield figures.add(f"intervals-{name}", caption, panels, two=True)


def _arrays(n: Across) -> dict[str, np.ndarray[Any, Any]]:
    def each(key: str) -> np.ndarray[Any, Any]:
        found = [getattr(v, key) if v is not None else None for v in n.values]
        return np.array([np.nan if x is None else x for x in found])

    x = each("value")
    low, high = each("low"), each("high")
    return {"value": x, "low": np.where(np.isnan(low), x, low),
            "high": np.where(np.isnan(high), x, high)}  # fmt: skip


def _title(n: Across) -> str:
    return n.name + (f" (p = {number(n.p_value, 2)})" if n.p_value is not None else "")


def _as_rows(result: SideBySide, n: Across, figures: Figures) -> dict[str, Any]:
    own, count = _arrays(n), len(result.results)
    place = np.arange(count, dtype=float)[::-1]
    series = figures.series("spans", "after", own["value"], y=place, low=own["low"],
                            high=own["high"], exact=True)  # fmt: skip
    across = axis(n.name, n.unit, np.nanmin(own["low"]), np.nanmax(own["high"]), room=0.06)
    labels = [r.label if r.trusted else f"{r.label} (refused)" for r in result.results]
    upright = axis("", "1", -0.6, count - 0.4)
    marks = [] if n.mean is None else [{"x": n.mean, "name": ""}]
    return panel(_title(n), across, upright, [series], marks=marks,
                 categories=labels[::-1], height=62 + 22 * count)  # fmt: skip


def _as_points(result: SideBySide, n: Across, figures: Figures) -> dict[str, Any]:
    own = _arrays(n)
    at = [r.at if r.at is not None else float(k) for k, r in enumerate(result.results, 1)]
    x = np.array(at)
    series = figures.series("bars", "after", x, y=own["value"], low=own["low"],
                            high=own["high"], exact=True)  # fmt: skip
    across = axis(result.over or "result", "1", x.min(), x.max(), room=0.05)
    upright = axis("value", n.unit, np.nanmin(own["low"]), np.nanmax(own["high"]), room=0.06)
    bands = []
    if n.mean is not None and n.mean_std:
        bands = [{"low": n.mean - 1.96 * n.mean_std, "high": n.mean + 1.96 * n.mean_std}]
    return panel(_title(n), across, upright, [series], bands=bands)


def _results(result: SideBySide, folder: Path) -> str:
    rows = []
    for r in result.results:
        page = (Path(r.path) if Path(r.path).is_dir() else Path(r.path).parent) / "report.html"
        name = escaped(r.label)
        if page.is_file():
            name = tag("a", name, href=Path(os.path.relpath(page, folder)).as_posix())
        cells = [name, *map(prose, [r.said, name_of_data(r), with_unit(r.noise, r.unit)])]
        rows.append(tag("tr", *(tag("td", cell) for cell in cells)))
    head = "".join(tag("th", h) for h in ("result", "verdict", "data", "noise of one residual"))
    body = tag("table", tag("thead", tag("tr", head)), tag("tbody", *rows))
    return scrolled(body, "results")
