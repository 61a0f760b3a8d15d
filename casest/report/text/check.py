"""What `casest check` prints."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path

from casest.data.logs import file_name
from casest.report.text.layout import WIDTH, item
from casest.results.check import Changed, Checked, changes_of
from casest.results.check_words import drift, reasons, repair
from casest.results.rounding import rounded


def check_text(result: Checked, output: Path | None) -> str:
    """Verdict, the test, what changed and what repairs it; all dates where there are several."""
    last = result.dates[-1]
    blocks = [
        textwrap.fill(sentence(result), WIDTH),
        "\n".join(item(note) for note in result.notes),
        "\n".join(_changed(result.changed)),
        "\n".join(item(line) for line in reasons(last)),
        "\n".join(_dates(result)),
        "\n".join(item(line) for line in drift(result)),
        "\n".join(item(line) for line in repair(last)),
        f"Next: the smallest recalibration that repairs it\n  {last.recalibrate.command}"
        if last.recalibrate and last.recalibrate.command
        else "",
        f"Written: {output}/report.html, check.json" if output else "",
    ]
    return "\n\n".join(b for b in blocks if b)


def sentence(result: Checked) -> str:
    """The verdict in one sentence."""
    files = ", ".join(file_name(name) for name in result.data)
    verdict = "valid" if result.valid else f"NOT VALID: {' and '.join(result.what)} changed"
    return f"{result.model} by {result.result} on {files}: {verdict}"


def _changed(changed: list[Changed]) -> Iterator[str]:
    if not changed:
        return
    rows = [(c.name, *_numbers(c), "" if c.unit == "1" else c.unit) for c in changed]
    widths = [max(len(r[k]) for r in (*rows, _HEAD)) for k in range(3)]
    for row in (_HEAD, *rows):
        name, before, now, unit = row
        yield f"  {name:<{widths[0]}}  {before:<{widths[1]}}  {now:<{widths[2]}}  {unit}".rstrip()


_HEAD = ("parameter", "before", "now", "unit")


def _numbers(c: Changed) -> tuple[str, str]:
    before = " ± ".join(rounded(_number(c.before), _number(c.std_before)))
    if not c.std_before:
        before = f"{c.before:.6g}"
    return before, " ± ".join(rounded(_number(c.now), _number(c.std)))


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _dates(result: Checked) -> Iterator[str]:
    if len(result.dates) < 2:
        return
    for date in result.dates:
        what = "valid" if date.valid else f"not valid: {' and '.join(changes_of(date))}"
        yield f"  {file_name(date.data)}: {what} (p = {date.p_value:.2g})"
