"""Sections that every fit's report has: values, what belongs together, certificate, origin."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from casest.estimate import Estimate
from casest.report.numbers import number, printed, printed_unit, with_unit
from casest.report.page import escaped, paragraph, points, section, table, tag
from casest.report.story import Story
from casest.terminal import rounded, value_rows

#: Correlation from which on a pair is spoken of, and how many pairs and directions are.
STRONG, SPOKEN = 0.9, 8


# -- values ----------------------------------------------------------------------------------------


def parameters(story: Story) -> str:
    """Values with uncertainty; beside each other and how far they moved, where there are two."""
    found = story.last
    dof = found.noise.degrees_of_freedom / found.correlated_over
    below, above = (
        [reach for _, _, reach, _ in value_rows(replace(found, std=side))]
        for side in found.interval_reach
    )
    before = {}
    if len(story.sides) > 1:
        before = {n: (v, s) for n, v, s, _ in value_rows(story.sides[0].estimate)}
    compared = before if len(story.sides) > 1 else None
    rows = [
        _row(row, reach, compared)
        for row, *reach in zip(value_rows(found), below, above, strict=True)
    ]
    interval = ["95 % from", "to"]
    head, aligned = ["parameter", "value", "± std", *interval, "unit"], [1, 2, 3, 4]
    said = (
        "± is one standard deviation; the interval holds 95 % (Student's t with "
        f"{int(dof)} degrees of freedom)."
    )
    if found.certificate.profile is not None:
        said = (
            "± is one standard deviation; the interval holds 95 % and is that of the likelihood, "
            "each unknown profiled."
        )
    if before:
        head = [
            "parameter",
            "before",
            "± std",
            "after",
            "± std",
            "95 % from",
            "to",
            "moved",
            "unit",
        ]
        aligned = [1, 2, 3, 4, 5, 6, 7]
        said += " Moved: in the value's own standard deviation before."
    return section(
        "parameters", "Parameters", paragraph(said), table(head, rows, aligned), _held(story)
    )


def _row(
    row: tuple[str, float, float, str],
    reach: Sequence[float],
    before: Mapping[str, tuple[float, float]] | None,
) -> list[str]:
    name, value, std, unit = row
    shown, spread = rounded(value, std)
    known = math.isfinite(std) and std > 0
    limits = value - reach[0], value + reach[1]
    ends = [_places(limit, spread) if known else "–" for limit in limits]
    after = [shown, spread, *ends]
    label = f"`{name}`"
    if before is None:
        return [label, *map(printed, after), printed_unit(unit)]
    if name not in before:
        return [label, "", "", *map(printed, after), "added", printed_unit(unit)]
    old, old_std = before[name]
    moved = (value - old) / old_std if old_std > 0 else math.nan
    there = f"{moved:+.1f}" if math.isfinite(moved) else "–"
    return [label, *map(printed, [*rounded(old, old_std), *after, there]), printed_unit(unit)]


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
        said.append(tag("pre", tag("code", escaped(command))))
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
