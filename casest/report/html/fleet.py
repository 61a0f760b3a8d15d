"""`fleet.html`: yield, distributions, drift over production, outlying sensors."""

from __future__ import annotations

import math

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.figures import BAND, Figures, axis, panel
from casest.report.html.frame import whole
from casest.report.html.numbers import number, printed, printed_unit, two_digits
from casest.report.html.page import paragraph, section, table
from casest.results.fleet import AGAINST, FleetResult, Spread
from casest.results.fleet_rows import MISREAD, NAMED, OUTLYING, Drawn
from casest.results.rounding import rounded

PAGE = "fleet.html"
#: Bars of a histogram, and how many standard deviations of the fleet it reaches.
BARS, REACH = 60, 5.0
#: Groups of sensors that follow each other in production, of which means are drawn.
GROUPS = 60

#: What is rejected, as the page calls it.
REJECTED = {
    "file": "files that cannot be read",
    "nameless": "rows without a name",
    "twice": "rows of sensors that are there twice",
    "readings": "sensors whose readings cannot be used",
    "refused": "sensors whose fit is refused",
}


def fleet_page(result: FleetResult, drawn: Drawn) -> str:
    """The page of a data set of many sensors."""
    figures = Figures()
    body = [
        _yield(result, drawn, figures),
        _distributions(result, drawn, figures),
        _drift(result, drawn, figures),
        _outlying(drawn),
        _versions(result),
    ]
    said = f"{result.trusted:,} of {result.sensors:,} sensors trusted."
    parts = "partition" if result.partitions == 1 else "partitions"
    under = f"{result.partitions:,} {parts}; rejected.parquet names every sensor without numbers."
    look = "good" if result.trusted == result.sensors else "doubtful" if result.trusted else "bad"
    return whole(result.model, said, under, body, figures, [result.dataset],
                 trusted=result.trusted > 0, look=look)  # fmt: skip


def _yield(result: FleetResult, drawn: Drawn, figures: Figures) -> str:
    rejected = [[REJECTED[kind], f"{n:,}"] for kind, n in result.rejected.items()]
    reasons = [[AGAINST.get(code, code), f"{n:,}"] for code, n in result.reasons.items()]
    share = 100 * result.trusted / max(result.sensors, 1)
    return section(
        "yield",
        "Yield",
        paragraph(f"{share:.4g} % of the sensors are trusted."),
        table(["Rejected", "how many"], rejected, [1]),
        table(["First reason against", "sensors"], reasons, [1]),
        _misfit(drawn, figures),
    )


def _misfit(drawn: Drawn, figures: Figures) -> str:
    """Chances of the largest residual: of sound sensors nearly even, but for those that are one."""
    chance = drawn.misfit[np.isfinite(drawn.misfit)]
    if not chance.size:
        return ""
    counts, edges = np.histogram(chance, 20, (0, 1))
    x, y = _steps(edges, counts / len(chance) * 20)
    drawn_panel = panel(
        "largest residual",
        axis("chance that noise makes one as large", "1", 0, 1),
        axis("density", "1", 0, float(y.max()), room=0.06),
        [figures.series("line", "after", x, y=y)],
    )
    few = 100 * float(np.mean(chance < 0.001))
    text = (
        "Of sound sensors nearly even but for the last bar: a chance shared among all residuals of "
        f"a sensor is one at most. {few:.2g} % lie below 0.001, where noise puts 0.1 %. "
        "A peak at the left: poses that were knocked, levels misread, an effect that is missing."
    )
    return figures.add("misfit", ("The largest residual of each sensor.", text), [drawn_panel])


def _distributions(result: FleetResult, drawn: Drawn, figures: Figures) -> str:
    if not result.trusted:
        return ""
    spreads = result.parameters
    rows = [[f"`{name}`", *_over(p), _unit(p.unit)] for name, p in spreads.items()]
    head = ["unknown", "mean", "spread", "least", "largest", "std of one sensor", "unit"]
    panels = [_histogram(drawn, k, spreads[name].unit, figures)
              for k, name in enumerate(drawn.names)]  # fmt: skip
    text = f"{len(drawn.at):,} sensors, as far as {REACH:g} standard deviations from their median."
    return section(
        "distributions",
        "Over the fleet",
        table(head, rows, [1, 2, 3, 4, 5]),
        figures.add("histograms", ("Each unknown.", text), panels, two=True),
    )


def _over(p: Spread) -> list[str]:
    """Mean, spread, least and largest to two digits of the spread; what one sensor's is worth."""
    spread = math.nan if p.std is None else p.std
    shown = [rounded(math.nan if v is None else v, spread) for v in (p.mean, p.least, p.largest)]
    (mean, std), (least, _), (largest, _) = shown
    return [*map(printed, (mean, std, least, largest)), two_digits(p.typical_std)]


def _unit(unit: str) -> str:
    return "" if unit == "1" else printed_unit(unit)


def _histogram(drawn: Drawn, k: int, unit: str, figures: Figures) -> dict[str, object]:
    values = drawn.values[k][drawn.trusted]
    half = REACH * float(drawn.scale[k]) or abs(float(drawn.centre[k])) or 1.0
    low, high = float(drawn.centre[k]) - half, float(drawn.centre[k]) + half
    counts, edges = np.histogram(values, BARS, (low, high))
    x, y = _steps(edges, counts / max(len(values), 1) * 100)
    return panel(
        drawn.names[k],
        axis(drawn.names[k], unit or "1", low, high),
        axis("sensors", "%", 0, float(y.max()), room=0.06),
        [figures.series("line", "after", x, y=y)],
    )


def _steps(edges: Array, heights: Array) -> tuple[Array, Array]:
    """The outline of a histogram."""
    x = np.repeat(edges, 2)
    return x, np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])


def _drift(result: FleetResult, drawn: Drawn, figures: Figures) -> str:
    """Means of sensors that follow each other, with what chance makes of them."""
    count = min(GROUPS, int(drawn.trusted.sum()) // 20)
    if count < 3:
        return ""
    groups = np.array_split(np.arange(len(drawn.at)), count)
    at = np.array([drawn.at[g].mean() for g in groups])
    days = drawn.over and float(np.ptp(drawn.at)) > 3 * 86400
    unit = ("d" if days else "s") if drawn.over else "1"
    at = at / 86400 if days else at
    label = f"{drawn.over} since {drawn.since}" if drawn.over else "place in the data set"
    x = axis(label, unit, float(at.min()), float(at.max()))
    good = np.array([100 * drawn.trusted[g].mean() for g in groups])
    panels = [panel("yield", x, axis("trusted", "%", float(good.min()), 100, room=0.1),
                    [figures.series("line", "after", at, y=good)])]  # fmt: skip
    for k, name in enumerate(drawn.names):
        own = [drawn.values[k][g][drawn.trusted[g]] for g in groups]
        mean = np.array([v.mean() if v.size else np.nan for v in own])
        half = np.array([BAND * v.std() / np.sqrt(v.size) if v.size else np.nan for v in own])
        low, high = float(np.nanmin(mean - half)), float(np.nanmax(mean + half))
        series = [
            figures.series("ribbon", "after", at, low=mean - half, high=mean + half),
            figures.series("line", "after", at, y=mean),
        ]
        unit = result.parameters[name].unit or "1"
        panels.append(panel(name, x, axis(name, unit, low, high, room=0.06), series))
    text = f"Means of {len(groups[0]):,} sensors that follow each other, with their 95 % bands."
    return section(
        "drift",
        "Over production",
        figures.add("drift-figure", ("Yield and unknowns.", text), panels, two=True),
    )


def _outlying(drawn: Drawn) -> str:
    """Sensors that are unlike the others, and those of which one reading is far off."""
    if not drawn.looked_at and len(drawn.at):
        text = f"Not looked for among so many: drawn are {len(drawn.at):,} sensors."
        return section("outlying", "Outlying sensors", paragraph(text))
    far = paragraph(f"No trusted sensor lies {OUTLYING:g} standard deviations of the fleet away.")
    if drawn.outlying:
        rows = [
            [o.sensor, f"`{o.unknown}`", number(o.value, 5), number(o.away, 3)]
            for o in drawn.outlying
        ]
        head = ["sensor", "unknown", "value", "standard deviations of the fleet"]
        far = table(head, rows, [2, 3])
    misread = ""
    if drawn.misread.count:
        first = f", the first {NAMED}" if drawn.misread.count > NAMED else ""
        misread = paragraph(
            f"Of {drawn.misread.count:,} trusted sensors one reading is further off than any of so "
            f"many sound ones would be, but for one fleet in {1 / MISREAD:.0f}{first}:"
        )
        rows = [[sensor, number(chance, 2)] for sensor, chance in drawn.misread.named]
        misread += table(["sensor", "chance of its largest residual"], rows, [1])
    return section("outlying", "Outlying sensors", far, misread)


def _versions(result: FleetResult) -> str:
    rows = [[name, version] for name, version in result.versions.items()]
    rows += [["model", f"{result.model} {result.model_hash[:16]}"]]
    return section("again", "Computed with", table(["what", "version"], rows))
