"""What `casest plan` prints of an experiment."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from casest.report.text.layout import WIDTH, item
from casest.results.experiment import (
    PlannedExperiment,
    experiment_headline,
    experiment_words,
    input_words,
)


def experiment_text(result: PlannedExperiment) -> str:
    """Inputs and times; what they bring; how good the plan is."""
    blocks = [
        textwrap.fill(experiment_headline(result), WIDTH),
        "\n".join(_what(result)),
        "\n".join(_unknowns(result)),
        "\n".join(item(words) for words in experiment_words(result)),
    ]
    return "\n\n".join(b for b in blocks if b)


def _what(result: PlannedExperiment) -> Iterator[str]:
    lines = [input_words(name, held) for name, held in result.inputs.items()]
    lines.append(f"read at t = {', '.join(f'{t:.5g}' for t in result.times)} s")
    for line in lines:
        yield textwrap.fill(line, WIDTH, initial_indent="  ", subsequent_indent="    ")


def _unknowns(result: PlannedExperiment) -> Iterator[str]:
    width = max(6, *map(len, result.unknowns))
    yield f"  {'std of' + ' ' * (width - 6):<{width}}  {'before':>9}  {'after':>9}  unit"
    for name, u in result.unknowns.items():
        unit = "" if u.unit == "1" else u.unit
        numbers = "  ".join(f"{'–':>9}" if x is None else f"{x:>9.2g}" for x in (u.before, u.after))
        yield f"  {name:<{width}}  {numbers}  {unit}".rstrip()
