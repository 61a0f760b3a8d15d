"""`common.html`: what the sensors of a fleet have in common, before and after."""

from __future__ import annotations

from casest.report.html.figures import Figures
from casest.report.html.frame import whole
from casest.report.html.numbers import number, printed
from casest.report.html.page import details, paragraph, points, section, table
from casest.results.fleet import CommonEffect, FleetClosed
from casest.results.rounding import rounded

PAGE = "common.html"
#: Chance below which a size differs along a column.
DIFFERS = 0.001


def common_page(result: FleetClosed) -> str:
    """The page of what a fleet was asked."""
    names = ", ".join(e.name for e in result.effects)
    said = f"{names} in common" if names else "nothing in common that their model lacks"
    under = (
        "Error before and after is that of sensors that had no part in the size of the effect."
        if names
        else "No effect that poses can show has a mean over the sensors that chance would not make."
    )
    body = [*map(_effect, result.effects), _tried(result)]
    verdict = f"{result.sensors:,} sensors have {said}."
    return whole(result.model, verdict, under, body, Figures(), [result.dataset],
                 trusted=True, look="doubtful" if names else "good")  # fmt: skip


def _effect(e: CommonEffect) -> str:
    sizes = [
        [f"`{name}`", *map(printed, rounded(value, std))]
        for name, (value, std) in e.parameters.items()
    ]
    fallen = 100 * (1 - e.sigma_after / e.sigma_before)
    errors = [[number(e.sigma_before, 5), number(e.sigma_after, 5), f"{fallen:.2g} %"]]
    moved = [[f"`{name}`", number(by, 2)] for name, by in e.moved.items()]
    said = [f"Chance of as much where sensors have nothing in common: {number(e.chance, 2)}."]
    if e.indistinguishable_from:
        rivals = ", ".join(f"`{name}`" for name in e.indistinguishable_from)
        said.append(f"As much is explained by {rivals}.")
    for column, chance in e.follows.items():
        differs = "differs with" if chance < DIFFERS else "does not differ with"
        said.append(f"Its size {differs} `{column}` (chance {number(chance, 2)}).")
    return section(
        e.name,
        e.name,
        table(["parameter", "common size", "± std"], sizes, [1, 2]),
        table(["sigma before", "after", "less"], errors, [0, 1, 2]),
        points(said),
        table(["declared unknown", "moves on average, in its own std"], moved, [1]),
    )


def _tried(result: FleetClosed) -> str:
    rows = [[f"`{name}`", number(chance, 2)] for name, chance in result.tried.items()]
    parts = [table(["effect", "chance of its mean where there is none"], rows, [1])]
    if result.invisible:
        names = ", ".join(f"`{name}`" for name in result.invisible)
        parts.append(paragraph(f"No pose could show {names}."))
    return section("tried", "What else was asked", details("Every effect", *parts))
