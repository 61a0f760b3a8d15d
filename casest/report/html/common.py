"""`common.html`: what the sensors of a fleet have in common, before and after."""

from __future__ import annotations

from casest.report.html.figures import Figures
from casest.report.html.frame import whole
from casest.report.html.numbers import number, printed
from casest.report.html.page import details, paragraph, points, section, table
from casest.results.fleet import CommonEffect, FleetClosed, OwnEffect
from casest.results.rounding import rounded

PAGE = "common.html"
#: Chance below which a size differs along a column.
DIFFERS = 0.001


def common_page(result: FleetClosed) -> str:
    """The page of what a fleet was asked."""
    under = (
        "Error before and after is that of sensors that had no part in the size of the effect."
        if result.effects
        else "No effect that poses can show has a mean over the sensors that chance would not make."
    )
    own = [] if result.own is None else [_own(result.own)]
    body = [*map(_effect, result.effects), *own, _tried(result)]
    verdict = f"{result.sensors:,} sensors have {result.said}."
    return whole(result.model, verdict, under, body, Figures(), [result.dataset],
                 trusted=True, look="doubtful" if result.effects or own else "good")  # fmt: skip


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


def _own(e: OwnEffect) -> str:
    sizes = [
        [f"`{name}`", *map(printed, rounded(value, error))]
        for name, (value, error) in e.parameters.items()
    ]
    sigmas = [[number(e.sigma_before, 5), number(e.sigma_after, 5)]]
    said = [f"Chance of as much where no effect has a spread: {number(e.chance, 2)}."]
    if e.indistinguishable_from:
        rivals = ", ".join(f"`{name}`" for name in e.indistinguishable_from)
        said.append(f"As much is explained by {rivals}.")
    return section(
        "own",
        f"{e.name}, each in a size of its own",
        paragraph(f"Asked of {e.sensors:,} sensors."),
        table(["parameter", "root mean square", "± error"], sizes, [1, 2]),
        table(["sigma over degrees of freedom", "with it in each"], sigmas, [0, 1]),
        points(said),
    )


def _tried(result: FleetClosed) -> str:
    both = result.tried, result.own_tried
    rows = [
        [f"`{name}`", *(number(said[name], 2) if name in said else "–" for said in both)]
        for name in dict.fromkeys([*result.tried, *result.own_tried])
    ]
    heads = ["effect", "chance of its mean where there is none", "of its spread"]
    parts = [table(heads, rows, [1, 2])]
    if result.invisible:
        names = ", ".join(f"`{name}`" for name in result.invisible)
        parts.append(paragraph(f"No pose could show {names}."))
    if result.not_asked:
        parts.append(paragraph(f"{result.not_asked[0].upper()}{result.not_asked[1:]}."))
    return section("tried", "What else was asked", details("Every effect", *parts))
