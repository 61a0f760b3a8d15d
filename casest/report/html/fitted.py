"""Sections that every fit's report has: values, what belongs together, certificate, origin."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from casest.estimate.calibrate import Estimate
from casest.report.html.numbers import number, printed, printed_unit, with_unit
from casest.report.html.page import escaped, paragraph, points, section, table, tag
from casest.report.html.story import Story
from casest.report.next_command import typed_words
from casest.report.text.calibration import entry_rows, rounded

#: Correlation from which on a pair is spoken of, and how many pairs and directions are.
STRONG, SPOKEN = 0.9, 8


# -- values ----------------------------------------------------------------------------------------


def parameters(story: Story) -> str:
    """Values with uncertainty; beside each other and how far they moved, where there are two."""
    found = story.last
    rows = [
        [f"`{name}`", *map(printed, _cells(*numbers)), printed_unit(unit)]
        for name, unit, numbers in entry_rows(found, found.values, found.std, *found.interval_reach)
    ]
    head = ["parameter", "value", "± std", "95 % from", "to", "unit"]
    said = "± is one standard deviation; the interval holds 95 %."
    if len(story.sides) > 1:
        head = ["parameter", "before", "± std", "after", *head[2:5], "moved", "unit"]
        rows = list(_beside(rows, story))
        said += " Moved: in the value's own standard deviation before."
    shown = table(head, rows, range(1, len(head) - 1))
    return section("parameters", "Parameters", paragraph(said), shown, _held(story))


def _cells(value: float, std: float, below: float, above: float) -> list[str]:
    """Value, standard deviation and interval, as far as they are known."""
    shown, spread = rounded(value, std)
    ends = [value - below, value + above]
    known = math.isfinite(std) and std > 0
    return [shown, spread, *(_places(end, spread) if known else "–" for end in ends)]


def _beside(rows: Sequence[list[str]], story: Story) -> Iterator[list[str]]:
    """Rows with the values before in front and how far they moved at the end."""
    first, last = (side.estimate for side in story.sides)
    before = {name: v for name, _, v in entry_rows(first, first.values, first.std)}
    after = entry_rows(last, last.values)
    for (label, *cells, unit), (name, _, (value,)) in zip(rows, after, strict=True):
        if name not in before:
            yield [label, "", "", *cells, "added", unit]
            continue
        old, std = before[name]
        moved = (value - old) / std if std > 0 else math.nan
        there = printed(f"{moved:+.1f}") if math.isfinite(moved) else "–"
        yield [label, *map(printed, rounded(old, std)), *cells, there, unit]


def _places(value: float, spread: str) -> str:
    """The value with as many decimals as its standard deviation is written with."""
    if "e" in spread:
        return f"{value:.4g}"
    return f"{value:.{len(spread.partition('.')[2])}f}"


def _held(story: Story) -> str:
    """Constants: as much a part of the answer as the unknowns."""
    rows = []
    for c in story.last.model.constants:
        value = ", ".join(f"{v:.9g}" for v in np.ravel(c.array))
        rows.append(
            [f"`{c.name}`", printed(value), printed_unit(story.units.get(c.name, "")) or "1"]
        )
    if not rows:
        return ""
    said = "Held at these values; their own uncertainty is not in the standard deviations above."
    return tag("h3", "Constants") + paragraph(said) + table(["constant", "value", "unit"], rows)


# -- what is uncertain about them ------------------------------------------------------------------


def uncertain(story: Story, content: Mapping[str, Any]) -> str:
    """Rank, strong correlations and weak directions, in words."""
    found, identified = story.last, content["identifiability"]
    said = [
        paragraph(
            f"The data determine {identified['rank']} of {identified['unknowns']} unknowns."
            + ("" if identified["unobservable"] else " None is left undetermined.")
        ),
        points(identified["unobservable"]),
    ]
    weak = sorted(identified["weak"], key=lambda w: -(w["inflation"] or 0))
    if weak:
        units = dict(zip(found.names, found.problem.units, strict=True))
        said += [
            tag("h3", "Weak combinations"),
            paragraph(
                "These values can be wrong together by as much as is written (one standard "
                "deviation of the combination) with hardly a change of the residual:"
            ),
            points(_weak(w, units) for w in weak[:SPOKEN]),
        ]
    pairs = list(_pairs(found))
    if pairs:
        rest = len(pairs) - SPOKEN
        said += [
            tag("h3", "Correlation"),
            points(_pair(*p) for p in pairs[:SPOKEN]),
            paragraph(f"And {rest} more pairs beyond ±{STRONG}, in `result.json`.")
            if rest > 0
            else "",
        ]
    elif found.certificate.trusted:
        said.append(paragraph(f"No two unknowns are correlated beyond ±{STRONG}."))
    return section("uncertain", "What belongs together", *said)


def _weak(weak: Mapping[str, Any], units: Mapping[str, str]) -> str:
    parts = []
    for part in weak["direction"].split(", "):
        name, _, value = part.rpartition(" ")
        unit = printed_unit(units.get(name, ""))
        parts.append(f"`{name}` by {printed(value)} {unit}".removesuffix(" 1").strip())
    return f"{', '.join(parts)}: {weak['inflation']:.0f} times less certain than each alone."


def _pairs(found: Estimate) -> Iterator[tuple[str, str, float]]:
    """Pairs of strongly correlated unknowns, the strongest first."""
    std = np.sqrt(np.diag(found.covariance))
    with np.errstate(all="ignore"):
        matrix = np.nan_to_num(found.covariance / np.outer(std, std))
    first, second = np.nonzero(np.triu(np.abs(matrix) > STRONG, 1))
    order = np.argsort(-np.abs(matrix[first, second]))
    for i, j in zip(first[order], second[order], strict=True):
        yield found.names[i], found.names[j], float(matrix[i, j])


def _pair(one: str, other: str, correlation: float) -> str:
    how = "too high together" if correlation > 0 else "one too high while the other is too low"
    return f"`{one}` and `{other}` ({printed(f'{correlation:+.3f}')}): wrong, if at all, {how}."


# -- why it is believed ----------------------------------------------------------------------------


def certified(story: Story, content: Mapping[str, Any]) -> str:
    """The certificate of each fit, and how it was found."""
    said = []
    for side in story.sides:
        certificate = side.estimate.certificate
        if len(story.sides) > 1:
            said.append(tag("h3", f"Fit {escaped(side.name)}"))
        verb = "believed" if certificate.trusted else "refused"
        said.append(paragraph(f"The fit is {verb} because:"))
        said.append(points(certificate.reasons))
    solver = content["solver"]
    if solver.get("name"):
        said.append(
            paragraph(
                f"Solver: {solver['name']}, {solver.get('iterations', '–')} iterations, "
                f"{number(solver.get('seconds'))} s. A solver's own claim of success counts for "
                "nothing here."
            )
        )
    said.append(tag("h3", "Noise") + points(_noise(story, content)))
    return section("certificate", "How the fit was certified", *said)


def _noise(story: Story, content: Mapping[str, Any]) -> Iterator[str]:
    noise = content["noise"]
    each = ", ".join(
        f"{axis} {with_unit(s, story.unit)}" if len(story.axes) > 1 else with_unit(s, story.unit)
        for axis, s in zip(story.axes, story.sigma.tolist(), strict=True)
    )
    yield f"Standard deviation of one residual: {each}."
    if noise.get("from_repeats"):
        repeats, residual = (
            with_unit(noise[k], story.unit) for k in ("from_repeats", "from_residual")
        )
        yield f"From the scatter within rest intervals: {repeats}; from the residual: {residual}."
    if noise.get("colour"):
        near = noise.get("lag1_correlation")
        beside = "" if near is None else f"; correlation of neighbours {number(near)}"
        yield f"Colour: {noise['colour']}{beside}."
    if story.correlated_over > 1:
        yield (
            f"Residuals are correlated over {number(story.correlated_over)} samples; standard "
            "deviations come from batches of samples."
        )
    if noise.get("outlier_share"):
        yield f"Outliers: {noise['outlier_share']:.2%} of the samples."
    yield f"{noise['degrees_of_freedom']} degrees of freedom."


# -- how to get it again ---------------------------------------------------------------------------


def reproduction(content: Mapping[str, Any], notes: Sequence[str] = ()) -> str:
    """Command, versions, digests."""
    again = dict(content.get("reproduce") or {})
    command, digests = again.pop("command", ""), again.pop("sha256", {})
    said = []
    if command:
        words = typed_words(command)
        shown = textwrap.dedent(words.lines()) if words else command
        said.append(tag("pre", tag("code", escaped(shown))))
    versions = {"casest": content["casest"], **again}
    said.append(table(["software", "version"], [[k, str(v)] for k, v in versions.items()]))
    rows = [[f"`{name}`", f"`{digest}`"] for name, digest in digests.items()]
    declared = content.get("declared_in") or {}
    if declared:
        rows.append([f"`{declared['file']}` (the model)", f"`{declared['sha256']}`"])
    said.append(table(["file", "SHA-256"], rows))
    samples = content.get("samples")
    if isinstance(samples, list):
        shown = [[f"`{s['run']}`", str(s["samples"]), str(s["readings"])] for s in samples]
        said.append(table(["run", "samples", "readings"], shown, [1, 2]))
    if notes:
        said += [tag("h3", "Noted while reading and fitting"), points(notes)]
    return section("reproduce", "How to get it again", *said)
