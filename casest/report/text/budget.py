"""What `casest budget` prints: inputs, their shares of every value's variance, correlations."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence

from msgspec import UNSET

from casest.report.text.layout import WIDTH, item, wrapped
from casest.results.budget import Budget, sensitivities
from casest.results.result import Number
from casest.results.rounding import rounded
from casest.results.uncertainty import Input
from casest.results.validation import rows, sentence

#: Correlations that are printed.
STRONGEST = 6
#: Columns of a table that is too wide are at least so wide.
NARROW = 10


def budget_text(budget: Budget) -> str:
    """Inputs, values with shares, the corrected reading, correlations."""
    blocks = [
        f"uncertainty budget of {budget.model} ({budget.result})",
        "\n".join(_inputs(budget.inputs)),
        "\n".join(_values(budget)),
        "\n".join(_sensitivities(budget)),
        "\n".join(_corrected(budget)),
        "\n".join(_correlations(budget)),
        "\n".join(_validation(budget)),
    ]
    return "\n\n".join(b for b in blocks if b)


def _inputs(inputs: Sequence[Input]) -> Iterator[str]:
    rows = [("input", "value", "std", "unit", "freedom")]
    for i in inputs:
        value = "" if i.value is None else f"{i.value:.9g}"
        std = "" if i.std is None else f"{i.std:.2g}"
        rows.append((i.name, value, std, "" if i.unit == "1" else i.unit, _freedom(i)))
    yield from _table(rows)


def _freedom(i: Input) -> str:
    return "known" if i.degrees_of_freedom is None else f"{i.degrees_of_freedom:.3g}"


def _values(budget: Budget) -> Iterator[str]:
    """Each value with the share in percent that every input has of its variance."""
    names = [i.name for i in budget.inputs]
    yield "Of the variance of each value, in percent:"
    rows = [("value", "", "std", *names, "freedom")]
    for v in budget.values:
        if v.value is None or v.std is None:
            rows.append((v.name, "", "not determined", *("" for _ in names), ""))
            continue
        shown, std = rounded(v.value, v.std)
        freedom = "known" if v.degrees_of_freedom is None else f"{v.degrees_of_freedom:.3g}"
        shares = (_percent(i.share.get(v.name)) for i in budget.inputs)
        rows.append((v.name, shown, f"± {std}", *shares, freedom))
    yield from _table(rows)


def _sensitivities(budget: Budget) -> Iterator[str]:
    """How each value follows the known numbers; noise has no one slope."""
    names, each = sensitivities(budget)
    if names:
        yield "Sensitivity of each value, its unit over that of the input:"
        yield from _table([("value", *names), *each])


def _corrected(budget: Budget) -> Iterator[str]:
    """The same of one corrected reading."""
    found = budget.corrected
    if found is None:
        return
    unit = "" if found.unit in ("", "1") else f" {found.unit}"
    at = ", ".join(f"{x:.4g}" for x in found.at)
    yield from wrapped([f"Of a corrected reading, {found.name} at the reading {at}, in percent:"])
    rows = [("component", "", "std", *found.share, "freedom")]
    for k, (value, std) in enumerate(zip(found.value, found.std, strict=True)):
        name = found.name + (f"[{k}]" if len(found.value) > 1 else "")
        if value is None or std is None:
            continue
        shown, spread = rounded(value, std)
        freedom = found.degrees_of_freedom[k]
        own = _of(found.share, k)
        said = "known" if freedom is None else f"{freedom:.3g}"
        rows.append((name, shown, f"± {spread}{unit}", *own, said))
    yield from _table(rows)


def _of(shares: Mapping[str, Sequence[Number]], k: int) -> list[str]:
    return [_percent(values[k]) for values in shares.values()]


def _percent(share: Number) -> str:
    return "" if share is None else f"{100 * share:.1f}"


def _correlations(budget: Budget) -> Iterator[str]:
    if not budget.correlations:
        return
    shown = budget.correlations[:STRONGEST]
    said = "; ".join(f"{p.names[0]} and {p.names[1]} {p.correlation:+.2f}" for p in shown)
    more = len(budget.correlations) - len(shown)
    yield item(f"correlated: {said}" + (f"; and {more} more, in budget.json" if more else ""))


def _validation(budget: Budget) -> Iterator[str]:
    """What Monte Carlo says of each interval."""
    found = budget.validation
    if found is UNSET:
        return
    yield from wrapped([sentence(found) + "."])
    yield ""
    head = ("95 % interval", "first order", "Monte Carlo", "apart", "may be", "")
    yield from _table([head, *rows(found)])


def _table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    if 2 * len(widths) + sum(widths) > WIDTH:
        rows = [*_stacked(rows[0], rows[1:]), *rows[1:]]
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for row in rows:
        first, *rest = row
        cells = [first.ljust(widths[0])]
        cells += [cell.rjust(w) for cell, w in zip(rest, widths[1:], strict=True)]
        yield ("  " + "  ".join(cells)).rstrip()


def _stacked(head: Sequence[str], body: Sequence[Sequence[str]]) -> Iterator[tuple[str, ...]]:
    """The words of a head above each other, as far as the cells below are narrower."""
    columns = [
        textwrap.wrap(name, max([NARROW, *(len(row[k]) for row in body)])) or [""]
        for k, name in enumerate(head)
    ]
    tallest = max(map(len, columns))
    yield from zip(*([""] * (tallest - len(c)) + c for c in columns), strict=True)
