"""What `casest report` prints: do the results agree, and in what not."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from casest.report.text.layout import WIDTH, item
from casest.results.rounding import rounded
from casest.results.side_by_side import Across, SideBySide, name_of_data


def side_by_side_text(result: SideBySide) -> str:
    """The sentence, each result, and a table of the numbers."""
    head = textwrap.fill(f"{result.sentence}.", WIDTH)
    each = "\n".join(_results(result))
    return "\n\n".join([head, each, "\n".join(_table(result))])


def _results(result: SideBySide) -> Iterator[str]:
    for r in result.results:
        yield item(f"{r.label}: {r.said}; {name_of_data(r)}")


def _table(result: SideBySide) -> Iterator[str]:
    several = len(result.results) > 1
    width = max(len(n.name) for n in result.numbers)
    spread = "spread" if several else ""
    yield f"  {'number':<{width}} {'mean' if several else 'value':>12}   {'std':<10} " + (
        f"{spread:<10} {'p':<8} furthest" if several else "unit"
    )
    for n in result.numbers:
        value, std = (n.mean, n.mean_std) if several else _only(n)
        if value is None or std is None:
            yield f"  {n.name:<{width}} {'–':>12}"
            continue
        shown, sigma = rounded(value, std)
        line = f"  {n.name:<{width}} {shown:>12} ± {sigma:<10} "
        if several:
            p = "–" if n.p_value is None else f"{n.p_value:.2g}"
            between = "" if n.spread is None else f"{n.spread:#.2g}"
            line += f"{between:<10} {p:<8} {n.furthest}"
        else:
            line += n.unit
        yield line.rstrip()


def _only(n: Across) -> tuple[float | None, float | None]:
    """Value and standard deviation in the only result."""
    first = n.values[0]
    return (None, None) if first is None else (first.value, first.std)
