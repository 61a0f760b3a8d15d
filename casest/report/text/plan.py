"""What `casest plan` prints."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator

from msgspec import UNSET

from casest.report.text.layout import WIDTH, item
from casest.results.plan import Measurement, Plan, headline, plan_words

#: Measurements from which on those that are the same are counted.
LONG = 40


def plan_text(result: Plan) -> str:
    """What to measure next, in order; what it brings; how far from the best possible."""
    blocks = [
        textwrap.fill(headline(result), WIDTH),
        "\n".join(_measurements(result)),
        "\n".join(_unknowns(result)),
        "\n".join(item(words) for words in plan_words(result)),
    ]
    return "\n\n".join(b for b in blocks if b)


def _measurements(result: Plan) -> Iterator[str]:
    if not result.count:
        return
    if result.count > LONG and len({m.words for m in result.measurements}) <= result.count // 2:
        yield from _together(result)
        return
    costs = len({m.cost for m in result.measurements}) > 1
    said = "told apart" if result.separates else "std"
    yield f"    #  {said:>5}  {'cost  ' if costs else ''}{result.things[:-1]}"
    for m in result.measurements:
        ratio = _brings(m)
        cost = f"{m.cost:>4.3g}  " if costs else ""
        line = f"  {m.number:>3}  {ratio:>5}  {cost}{m.words}"
        yield textwrap.fill(line, WIDTH, subsequent_indent=" " * 15)


def _together(result: Plan) -> Iterator[str]:
    """How often each of the same measurements, those of the most first."""
    yield f"  times  {result.things[:-1]} (their order is in plan.csv)"
    for words, times in Counter(m.words for m in result.measurements).most_common():
        yield textwrap.fill(f"  {times:>5}  {words}", WIDTH, subsequent_indent=" " * 9)


def _brings(m: Measurement) -> str:
    """The factor of the standard deviations, or the chance to tell the causes apart."""
    if m.told_apart is not UNSET and m.told_apart is not None:
        return f"{100 * m.told_apart:>8.0f} %"
    return f"×{m.std_ratio:.2f}" if m.std_ratio is not None else "–"


def _unknowns(result: Plan) -> Iterator[str]:
    if not result.count or not result.unknowns:
        return
    width = max(map(len, result.unknowns))
    times = "" if result.noise.stated else " (in units of the noise)"
    yield f"  {'std of' + ' ' * (width - 6):<{width}}  {'before':>9}  {'after':>9}  unit{times}"
    for name, u in result.unknowns.items():
        unit = "" if u.unit == "1" else u.unit
        yield f"  {name:<{width}}  {_std(u.before)}  {_std(u.after)}  {unit}".rstrip()


def _std(value: float | None) -> str:
    return f"{'–':>9}" if value is None else f"{value:>9.2g}"
