"""What `casest plan` prints of a motion."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from casest.report.text.layout import WIDTH, item
from casest.results.motion_plan import PlannedMotion, motion_headline, motion_words


def motion_text(result: PlannedMotion) -> str:
    """Limits and how much of them is taken; what the motion shows; how good it is."""
    blocks = [
        textwrap.fill(motion_headline(result), WIDTH),
        "\n".join(_limits(result)),
        "\n".join(_stds(result)),
        "\n".join(item(words) for words in motion_words(result)),
    ]
    return "\n\n".join(b for b in blocks if b)


def _limits(result: PlannedMotion) -> Iterator[str]:
    width = max((len(limit.words) for limit in result.limits), default=0)
    for limit in result.limits:
        yield f"  {limit.words:<{width}}  {100 * limit.share:>4.0f} % of it"


def _stds(result: PlannedMotion) -> Iterator[str]:
    width = max(map(len, result.std))
    head = "std at the start"
    yield f"  {head:<{max(width, len(head))}}  {'planned':>9}  {'random':>9}  unit"
    for name, seen in result.std.items():
        unit = "" if seen.unit == "1" else seen.unit
        numbers = f"{_std(seen.planned)}  {_std(seen.random)}"
        yield f"  {name:<{max(width, len(head))}}  {numbers}  {unit}".rstrip()


def _std(value: float | None) -> str:
    return f"{'–':>9}" if value is None else f"{value:>9.2g}"
