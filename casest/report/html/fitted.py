"""Sections that every fit's report has: values, what belongs together, certificate, origin."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files

import numpy as np

from casest import __version__
from casest.report.html.numbers import number, printed, printed_unit, with_unit
from casest.report.html.page import code_block, escaped, paragraph, points, section, table, tag
from casest.report.next_command import typed_words
from casest.results.fitted import (
    Correlation,
    DeclaredIn,
    Fitted,
    NoiseModel,
    Samples,
    WeakCombination,
)
from casest.results.result import Reproduced
from casest.results.rounding import percent, rounded
from casest.results.values import Entry, Held

#: Correlation from which on a pair is spoken of, and how many pairs and directions are.
STRONG, SPOKEN = 0.9, 8


# -- values ----------------------------------------------------------------------------------------


def parameters(result: Fitted) -> str:
    """Values with uncertainty; beside each other and how far they moved, where there are two."""
    sides = result.residuals.sides
    rows = parameter_rows(result)
    head = ["parameter", "value", "± std", "95 % from", "to", "unit"]
    said = "± is one standard deviation; the interval holds 95 %."
    if len(sides) > 1:
        head = ["parameter", "before", "± std", "after", *head[2:5], "moved", "unit"]
        rows = list(_beside(rows, sides[0].entries, result.entries))
        said += " Moved: in the value's own standard deviation before."
    names = (name for e in result.entries for name in re.findall(r"\[(.+?)\]", e.unit))
    unstated = [f" [{name}] is the unit of {name}, which nobody stated." for name in names]
    said += "".join(dict.fromkeys(unstated))
    shown = table(head, rows, range(1, len(head) - 1))
    return section("parameters", "Parameters", paragraph(said), shown, _held(result.held))


def parameter_rows(result: Fitted) -> list[list[str]]:
    """Name, value, standard deviation, interval and unit of every number."""
    return [[f"`{e.name}`", *map(printed, _cells(e)), printed_unit(e.unit)] for e in result.entries]


def _cells(e: Entry) -> list[str]:
    """Value, standard deviation and interval, as far as they are known."""
    if e.on_bound:
        reached = (f"{end:.4g}" for end in (e.value - e.below, e.value + e.above))
        return [f"{e.value:.6g}", "on its bound", *reached]
    shown, spread = e.shown
    ends = [e.value - e.below, e.value + e.above]
    known = math.isfinite(e.std) and e.std > 0
    return [shown, spread, *(_places(end, spread) if known else "–" for end in ends)]


def _beside(
    rows: Sequence[list[str]], first: Sequence[Entry], last: Sequence[Entry]
) -> Iterator[list[str]]:
    """Rows with the values before in front and how far they moved at the end."""
    before = {e.name: e for e in first}
    for (label, *cells, unit), e in zip(rows, last, strict=True):
        if e.name not in before:
            yield [label, "", "", *cells, "added", unit]
            continue
        old, std = before[e.name].value, before[e.name].std
        moved = (e.value - old) / std if std > 0 else math.nan
        there = printed(f"{moved:+.1f}") if math.isfinite(moved) else "–"
        yield [label, *map(printed, rounded(old, std)), *cells, there, unit]


def _places(value: float, spread: str) -> str:
    """The value with as many decimals as its standard deviation is written with."""
    if "e" in spread:
        return f"{value:.4g}"
    return f"{value:z.{len(spread.partition('.')[2])}f}"  # no -0.00


def _held(held: Sequence[Held]) -> str:
    """Constants: as much a part of the answer as the unknowns."""
    rows, uncertain = [], any(c.std is not None for c in held)
    for c in held:
        value = ", ".join(f"{v:.9g}" for v in np.ravel(c.value))
        row = [f"`{c.name}`", printed(value), printed_unit(c.unit) or "1"]
        rows.append([*row, *(_known(c) if uncertain else [])])
    if not rows:
        return ""
    head = ["constant", "value", "unit", *(["± std", "largest share"] if uncertain else [])]
    said = "Held at these values; their own uncertainty is not in the standard deviations above."
    if uncertain:
        said = (
            "Held at these values. A standard uncertainty beside one is in the standard deviations "
            "above; the share is the largest that it has of a variance there."
        )
    return tag("h3", "Constants") + paragraph(said) + table(head, rows)


def _known(c: Held) -> list[str]:
    """A constant's standard uncertainty, and the largest share that it has of a variance."""
    if c.std is None:
        return ["not stated" if c.frozen else "exact", ""]
    std = ", ".join(f"{s:.2g}" for s in np.ravel(c.std))
    return [printed(std), f"{printed(percent(c.share))} of `{c.most}`"]


# -- what is uncertain about them ------------------------------------------------------------------


def uncertain(result: Fitted) -> str:
    """Rank, strong correlations and weak directions, in words."""
    identified = result.identifiability
    said = [
        paragraph(
            f"The data determine {identified.rank} of {identified.unknowns} unknowns."
            + ("" if identified.unobservable else " None is left undetermined.")
        ),
        points(identified.unobservable),
    ]
    weak = sorted(identified.weak, key=lambda w: -w.inflation)
    if weak:
        said += [
            tag("h3", "Weak combinations"),
            paragraph(
                "These values can be wrong together by as much as is written (one standard "
                "deviation of the combination) with hardly a change of the residual:"
            ),
            points(_weak(w, result.unknown_units) for w in weak[:SPOKEN]),
        ]
    pairs = list(_pairs(result.correlation))
    if pairs:
        rest = len(pairs) - SPOKEN
        said += [
            tag("h3", "Correlation"),
            points(_pair(*p) for p in pairs[:SPOKEN]),
            paragraph(f"And {rest} more pairs beyond ±{STRONG}, in `result.json`.")
            if rest > 0
            else "",
        ]
    elif result.trusted:
        said.append(paragraph(f"No two unknowns are correlated beyond ±{STRONG}."))
    return section("uncertain", "What belongs together", *said)


def _weak(weak: WeakCombination, units: Mapping[str, str]) -> str:
    parts = []
    for part in weak.direction.split(", "):
        name, _, value = part.rpartition(" ")
        unit = printed_unit(units.get(name, ""))
        parts.append(f"`{name}` by {printed(value)} {unit}".removesuffix(" 1").strip())
    return f"{', '.join(parts)}: {weak.inflation:.0f} times less certain than each alone."


def _pairs(found: Correlation) -> Iterator[tuple[str, str, float]]:
    """Pairs of strongly correlated unknowns, the strongest first."""
    size = len(found.names)
    matrix = np.nan_to_num(np.array(found.matrix, dtype=float).reshape(size, size))
    first, second = np.nonzero(np.triu(np.abs(matrix) > STRONG, 1))
    order = np.argsort(-np.abs(matrix[first, second]))
    for i, j in zip(first[order], second[order], strict=True):
        yield found.names[i], found.names[j], float(matrix[i, j])


def _pair(one: str, other: str, correlation: float) -> str:
    how = "too high together" if correlation > 0 else "one too high while the other is too low"
    return f"`{one}` and `{other}` ({printed(f'{correlation:+.3f}')}): wrong, if at all, {how}."


# -- why it is believed ----------------------------------------------------------------------------


def _meaning(name: str) -> str:
    """What the page of refusals, which the package carries, says of one."""
    page = files("casest.report").joinpath("refusals.md").read_text("utf-8")
    sections = re.split(r"^## (\S+)$", page, flags=re.MULTILINE)
    return " ".join(dict(zip(sections[1::2], sections[2::2], strict=True))[name].split())


def certified(result: Fitted) -> str:
    """The certificate of each fit, and how it was found."""
    said = []
    for side in result.residuals.sides:
        if len(result.residuals.sides) > 1:
            said.append(tag("h3", f"Fit {escaped(side.name)}"))
        verb = "believed" if side.trusted else "refused"
        said.append(paragraph(f"The fit is {verb} because:"))
        said.append(points(side.reasons))
    if result.refusals:
        said.append(tag("h3", "What that means and what to do"))
        said += [paragraph(f"{_meaning(n)} (`docs/refusals.md#{n}`)") for n in result.refusals]
    solver = result.solver
    seconds = solver.seconds if isinstance(solver.seconds, float) else None
    if solver.name:
        said.append(
            paragraph(
                f"Solver: {solver.name}, {solver.iterations} iterations, "
                f"{number(seconds)} s. A solver's own claim of success counts for "
                "nothing here."
            )
        )
    said.append(tag("h3", "Noise") + points(_noise(result)))
    return section("certificate", "How the fit was certified", *said)


def _noise(result: Fitted) -> Iterator[str]:
    noise, residuals = result.noise, result.residuals
    axes, unit = residuals.axes, residuals.unit
    each = ", ".join(
        f"{axis} {with_unit(s, unit)}" if len(axes) > 1 else with_unit(s, unit)
        for axis, s in zip(axes, residuals.sigma.tolist(), strict=True)
    )
    yield f"Standard deviation of one residual: {each}."
    if noise.from_repeats:
        repeats, residual = (with_unit(v, unit) for v in (noise.from_repeats, noise.from_residual))
        yield f"From the scatter within rest intervals: {repeats}; from the residual: {residual}."
    if isinstance(noise, NoiseModel) and noise.colour:
        near = noise.lag1_correlation
        beside = "" if near is None else f"; correlation of neighbours {number(near)}"
        yield f"Colour: {noise.colour}{beside}."
    if residuals.correlated_over > 1:
        yield (
            f"Residuals are correlated over {number(residuals.correlated_over)} samples; standard "
            "deviations allow for that."
        )
    if isinstance(noise, NoiseModel) and noise.outlier_share:
        yield f"Outliers: {noise.outlier_share:.2%} of the samples."
    yield f"{noise.degrees_of_freedom} degrees of freedom."


# -- how to get it again ---------------------------------------------------------------------------


def reproduction(
    again: Reproduced,
    notes: Sequence[str] = (),
    declared: DeclaredIn | None = None,
    samples: Sequence[Samples] = (),
) -> str:
    """Command, versions, digests."""
    said = []
    if again.command:
        words = typed_words(again.command)
        shown = textwrap.dedent(words.lines()) if words else again.command
        said.append(code_block(shown))
    versions = [["casest", __version__], ["python", again.python], ["casadi", again.casadi],
                ["numpy", again.numpy], ["scipy", again.scipy]]  # fmt: skip
    said.append(table(["software", "version"], versions))
    rows = [[f"`{name}`", f"`{digest}`"] for name, digest in again.sha256.items()]
    if declared and declared.file:
        rows.append([f"`{declared.file}` (the model)", f"`{declared.sha256}`"])
    said.append(table(["file", "SHA-256"], rows))
    counts = [[f"`{s.run}`", str(s.samples), str(s.readings)] for s in samples]
    said.append(table(["run", "samples", "readings"], counts, [1, 2]))
    if notes:
        said += [tag("h3", "Noted while reading and fitting"), points(notes)]
    return section("reproduce", "How to get it again", *said)
