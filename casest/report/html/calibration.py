"""The report of `casest calibrate`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.estimate.calibrate import Estimate
from casest.report.html.applied import application
from casest.report.html.figures import Figures, axis, panel
from casest.report.html.fitted import certified, parameters, reproduction, uncertain
from casest.report.html.frame import whole
from casest.report.html.numbers import alike, printed_unit, with_unit
from casest.report.html.page import paragraph, points, section, table
from casest.report.html.residuals import residual_figures
from casest.report.html.story import Story, of_calibration
from casest.results.calibration import doubt_sentence


def calibration_page(estimate: Estimate, content: Mapping[str, Any], folder: str = "out") -> str:
    """`report.html` of a calibration, trusted or refused."""
    story, figures = of_calibration(estimate, content), Figures()
    doubt, trusted = content.get("misfit"), estimate.certificate.trusted
    body = [
        _first(doubt) if doubt else "",
        error_section(story, content, figures),
        section("residual", "Residual", residual_figures(story, figures)) if _finite(story) else "",
        parameters(story),
        uncertain(story, content),
        section("invisible", "What stayed invisible", paragraph(_asked(content)), paragraph(
            "A calibration looks for no effect. `casest close` with the same arguments does, and "
            "names what these data could not show."
        )),
        certified(story, content),
        application(story, content, folder),
        reproduction(content, content["notes"]),
    ]  # fmt: skip
    asked = "" if doubt is None else ", and nothing in the residual speaks against the model"
    proved = f"The optimum is proved{asked}; what the model may lack is what `casest close` asks."
    under = proved if trusted and not doubt else ""
    return whole(story.last.model.name, sentence(estimate, content), under, body, content, figures)


def _first(doubt: Sequence[Mapping[str, Any]]) -> str:
    return paragraph(f"Before you use these values: {doubt_sentence(doubt)}.", "doubt")


def sentence(estimate: Estimate, content: Mapping[str, Any]) -> str:
    """The verdict: what was determined and how well it fits, or why nothing is."""
    if not estimate.certificate.trusted:
        return f"No trustworthy estimate: {estimate.certificate.reasons[0]}."
    count = sum(len(run) for run in estimate.problem.runs)
    what = "rest intervals" if estimate.problem.runs[0].spread else "samples"
    rms = with_unit(estimate.rmse, content["noise"]["unit"])
    but = ", but the residual is not noise" if content.get("misfit") else ""
    return (
        f"Trusted{but}: {estimate.identifiability.unknowns} unknowns determined from {count} "
        f"{what}, with a residual of {rms} rms."
    )


def _asked(content: Mapping[str, Any]) -> str:
    """What the residual says of the model."""
    found = content.get("misfit")
    if found is None:
        return "Nobody asked whether the residual is noise."
    if found:
        return "Something did not: the residual is no noise, as is said above."
    return (
        "Nothing in the residual speaks against the model: it does not depend on any column, "
        "quantity or time, holds no line, and is as large as repeats say. What the values have "
        "swallowed would not show there."
    )


def error_section(story: Story, content: Mapping[str, Any], figures: Figures) -> str:
    """Residual of the fit on each axis, and on a held-out record where there is one."""
    (side,) = story.sides
    rows = [("fit", rms(side.residuals))]
    rows += [(f"fit, {a}", v) for a, v in by_axis(story, 0).items()] if len(story.axes) > 1 else []
    if content["estimate"]["rmse_holdout"] is not None:
        rows.append(("held-out", content["estimate"]["rmse_holdout"]))
    unit = story.unit
    sizes = alike([value for _, value in rows])
    cells = [[name, s, printed_unit(unit)] for (name, _), s in zip(rows, sizes, strict=True)]
    shown = table(["residual, rms", "size", "unit"], cells, [1])
    notes = points([_repeats(content, unit)] if _repeats(content, unit) else [])
    sides = [("after", [value for _, value in rows])]
    several = len(rows) > 1  # one number needs no picture
    picture = error_picture(figures, [name for name, _ in rows], sides, unit) if several else ""
    return section("error", "Error", shown, notes, picture)


def _repeats(content: Mapping[str, Any], unit: str) -> str:
    noise = content["noise"]
    repeats, residual = noise["from_repeats"], noise["from_residual"]
    if repeats and residual and residual > 2 * repeats:
        return (
            f"The residual is {residual / repeats:.1f} times what the scatter within the rest "
            f"intervals explains ({with_unit(repeats, unit)}): the model lacks something; the "
            "standard deviations include that misfit as if it were noise."
        )
    return ""


def error_picture(
    figures: Figures, names: list[str], sides: list[tuple[str, list[float]]], unit: str
) -> str:
    """Root mean square errors as dots on one scale from zero."""
    count = len(names)
    at = np.arange(count, dtype=float)[::-1]
    drawn = [figures.series("dots", look, np.array(values), y=at) for look, values in sides]
    most = max(max(values) for _, values in sides)
    title = "before (open) and after (filled)" if len(sides) > 1 else "root mean square"
    shown = panel(
        title,
        axis("residual, rms", unit, 0.0, 1.12 * most),
        axis("", "1", -0.6, count - 0.4),
        drawn,
        categories=names[::-1],
        height=64 + 26 * count,
    )
    return figures.add("errors", ("Error", "on one scale that begins at zero."), [shown])


def rms(residuals: tuple[Array, ...]) -> float:
    """Root mean square over all runs and axes."""
    return float(np.sqrt(np.mean(np.concatenate([r.ravel() for r in residuals]) ** 2)))


def by_axis(story: Story, side: int) -> dict[str, float]:
    """Root mean square of the fit on each axis."""
    whole = np.concatenate(story.sides[side].residuals)
    return {a: float(np.sqrt(np.mean(whole[:, k] ** 2))) for k, a in enumerate(story.axes)}


def _finite(story: Story) -> bool:
    """A refused fit may have residuals that no picture can show."""
    return all(np.isfinite(r).all() for side in story.sides for r in side.residuals)
