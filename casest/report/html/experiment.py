"""`plan.html` of an experiment: inputs and times of readings, to print."""

from __future__ import annotations

from casest.report.html.figures import Figures
from casest.report.html.fitted import reproduction
from casest.report.html.frame import whole
from casest.report.html.numbers import printed_unit, two_digits
from casest.report.html.page import points, section, table
from casest.results.experiment import (
    PlannedExperiment,
    experiment_headline,
    experiment_words,
    input_words,
)


def experiment_page(result: PlannedExperiment) -> str:
    """What to do and when, with a box to tick; what it brings; how good it is."""
    said = points([input_words(name, held) for name, held in result.inputs.items()])
    body = [
        section("inputs", "Inputs", said) if result.inputs else "",
        _readings(result),
        _unknowns(result),
        section("how", "How good the plan is", points(experiment_words(result))),
        reproduction(result.reproduce),
    ]
    return whole(result.model, experiment_headline(result), "", body, Figures(), [])


def _readings(result: PlannedExperiment) -> str:
    """A row for each reading: when, and what is to be expected."""
    head, values = result.columns
    inputs = sum(len(held.value[0]) for held in result.inputs.values())
    due = values[~(values != values).any(axis=1)]
    rows = [
        ["☐", str(k + 1), f"{row[0]:.5g}", *(f"{x:.4g}" for x in row[1 + inputs :])]
        for k, row in enumerate(due)
    ]
    names = ["", "no.", "t, s", *(f"{name} expected" for name in head[1 + inputs :])]
    return section("sheet", "When to read", table(names, rows, list(range(1, len(names)))))


def _unknowns(result: PlannedExperiment) -> str:
    rows = [
        [f"`{n}`", two_digits(u.before), two_digits(u.after), printed_unit(u.unit)]
        for n, u in result.unknowns.items()
    ]
    head = ["unknown", "before", "after", "unit"]
    return section("unknowns", "What it brings", table(head, rows, [1, 2]))
