"""`budget.html`: the budget as a table, and as one bar for each value."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from msgspec import UNSET

from casest.report.html.figures import Figures
from casest.report.html.frame import whole
from casest.report.html.numbers import printed, printed_unit
from casest.report.html.page import escaped, paragraph, section, table, tag
from casest.results.budget import Budget, sensitivities
from casest.results.result import Number
from casest.results.rounding import rounded
from casest.results.validation import rows, sentence

PAGE = "budget.html"
#: Okabe & Ito's colours, told apart by the colour-blind too.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999")
#: A bar, in pixels: its height with the gap, where it begins, how long it is.
HIGH, LEFT, LONG = 22, 150, 520


def budget_page(budget: Budget) -> str:
    """Inputs, shares of every value's variance, shares of a corrected reading's, correlations."""
    body = [_inputs(budget), _values(budget), _sensitivities(budget), _corrected(budget)]
    body += [_correlations(budget), _validation(budget)]
    said = f"Uncertainty budget: {len(budget.inputs)} inputs, {len(budget.values)} values"
    under = f"Made from {budget.result}. Shares are of variances, to first order."
    return whole(budget.model, said, under, body, Figures(), [])


def _inputs(budget: Budget) -> str:
    rows = [
        [
            f"`{i.name}`",
            i.kind,
            "" if i.value is None else printed(f"{i.value:.9g}"),
            "" if i.std is None else printed(f"{i.std:.2g}"),
            _unit(i.unit),
            "known" if i.degrees_of_freedom is None else f"{i.degrees_of_freedom:.3g}",
        ]
        for i in budget.inputs
    ]
    head = ["input", "kind", "value", "± std", "unit", "degrees of freedom"]
    return section("inputs", "Inputs", table(head, rows, [2, 3]))


def _values(budget: Budget) -> str:
    names = [i.name for i in budget.inputs]
    rows, bars = [], {}
    for v in budget.values:
        if v.value is None or v.std is None:
            continue
        shares = [i.share.get(v.name) for i in budget.inputs]
        shown, std = rounded(v.value, v.std)
        rows.append(
            [
                f"`{v.name}`",
                printed(shown),
                printed(std),
                _unit(v.unit),
                *map(_percent, shares),
            ]
        )
        bars[v.name] = shares
    head = ["value", "", "± std", "unit", *(f"{n}, %" for n in names)]
    return section(
        "values", "Values", _bars(bars, names), table(head, rows, [1, 2, *range(4, len(head))])
    )


def _sensitivities(budget: Budget) -> str:
    names, each = sensitivities(budget)
    if not names:
        return ""
    rows = [[f"`{name}`", *map(printed, cells)] for name, *cells in each]
    said = paragraph("The unit of the value over that of the input; noise has no one slope.")
    head = ["value", *names]
    body = table(head, rows, [*range(1, len(head))])
    return section("sensitivities", "Sensitivities", said, body)


def _corrected(budget: Budget) -> str:
    found = budget.corrected
    if found is None:
        return ""
    names, rows, bars = list(found.share), [], {}
    for k, (value, std) in enumerate(zip(found.value, found.std, strict=True)):
        if value is None or std is None:
            continue
        shares = [found.share[n][k] for n in names]
        shown, spread = rounded(value, std)
        name = found.name + (f"[{k}]" if len(found.value) > 1 else "")
        rows.append(
            [
                f"`{name}`",
                printed(shown),
                printed(spread),
                _unit(found.unit),
                *map(_percent, shares),
            ]
        )
        bars[name] = shares
    at = ", ".join(printed(f"{x:.4g}") for x in found.at)
    head = ["component", "", "± std", "unit", *(f"{n}, %" for n in names)]
    return section(
        "corrected",
        "A corrected reading",
        paragraph(f"At the reading {at}, a usual one of the fit."),
        _bars(bars, names),
        table(head, rows, [1, 2, *range(4, len(head))]),
    )


def _correlations(budget: Budget) -> str:
    rows = [
        [f"`{p.names[0]}`", f"`{p.names[1]}`", printed(f"{p.correlation:+.3f}")]
        for p in budget.correlations
    ]
    return section("correlations", "Correlations", table(["", "", "correlation"], rows, [2]))


def _validation(budget: Budget) -> str:
    found = budget.validation
    if found is UNSET:
        return ""
    head = ["95 % interval", "first order", "Monte Carlo", "apart", "may be", ""]
    each = [[f"`{name}`", *map(printed, cells), words] for name, *cells, words in rows(found)]
    said = paragraph(f"{sentence(found)}.")
    return section("validation", "Monte Carlo", said, table(head, each, [1, 2, 3, 4]))


def _unit(unit: str) -> str:
    return "" if unit == "1" else printed_unit(unit)


def _percent(share: Number) -> str:
    return "" if share is None else printed(f"{100 * share:.1f}")


def _bars(shares: Mapping[str, Sequence[Number]], names: Sequence[str]) -> str:
    """One bar for each value, cut by the shares of the inputs; negative ones are left out."""
    parts = []
    for row, (name, own) in enumerate(shares.items()):
        y, at = row * HIGH, 0.0
        parts.append(tag("text", escaped(name), x=str(LEFT - 8), y=str(y + 14), text_anchor="end"))
        whole_bar = sum(max(s or 0.0, 0.0) for s in own) or 1.0
        for k, share in enumerate(own):
            long = LONG * max(share or 0.0, 0.0) / whole_bar
            colour = COLOURS[k % len(COLOURS)]
            parts.append(
                _part(LEFT + at, y, long, colour, f"{name}: {names[k]} {_percent(share)} %")
            )
            at += long
    top = len(shares) * HIGH + 6
    for k, name in enumerate(names):
        y = top + k * HIGH
        parts.append(_part(LEFT, y, 14, COLOURS[k % len(COLOURS)], name))
        parts.append(tag("text", escaped(name), x=str(LEFT + 22), y=str(y + 14)))
    high, wide = top + len(names) * HIGH, LEFT + LONG + 10
    said = f"shares of {len(names)} inputs in {len(shares)} values; the table has the numbers"
    drawing = tag("svg", *parts, viewBox=f"0 0 {wide} {high}", role="img", aria_label=said,
                  fill="currentColor")  # fmt: skip
    drawing = re.sub("(text|aria)_", r"\1-", drawing)
    return tag("figure", tag("div", drawing, class_="drawn", tabindex="0", role="group",
                             aria_label="shares of each value"))  # fmt: skip


def _part(x: float, y: float, long: float, colour: str, said: str) -> str:
    title = tag("title", escaped(said))
    return tag(
        "rect", title, x=f"{x:.1f}", y=f"{y:.0f}", width=f"{long:.1f}", height="16", fill=colour
    )
