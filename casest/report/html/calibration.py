"""The report of `casest calibrate`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.applied import application
from casest.report.html.figures import Figures, axis, panel
from casest.report.html.fitted import certified, parameters, reproduction, uncertain
from casest.report.html.frame import whole
from casest.report.html.numbers import alike, printed_unit, with_unit
from casest.report.html.page import paragraph, points, section, table
from casest.report.html.poses import poses_seen
from casest.report.html.profiles import profile_figures
from casest.report.html.residuals import convincing, residual_figures
from casest.results.calibration import Calibration, doubt_sentence
from casest.results.fitted import worse_elsewhere
from casest.results.profiles import ProfileOf
from casest.results.residuals import Residuals


def calibration_page(
    result: Calibration, folder: str = "out", profiles: Sequence[ProfileOf] = ()
) -> str:
    """`report.html` of a calibration, trusted or refused; with `profiles` that were asked for."""
    residuals, figures = result.residuals, Figures()
    finite = _finite(residuals)
    body = [
        _first(result) if result.misfit else "",
        parameters(result),
        section("evidence", "The evidence", poses_seen(residuals.poses, figures),
                convincing(residuals, figures)) if finite else "",
        section("profiles", "Where the cost is no parabola",
                profile_figures(profiles, figures)) if profiles else "",
        error_section(result, figures),
        section("residual", "Residual", residual_figures(residuals, figures)) if finite else "",
        uncertain(result),
        section("invisible", "What stayed invisible", paragraph(_asked(result)), paragraph(
            _looked_for()
        )),
        certified(result),
        application(result, folder),
        reproduction(result.reproduce, result.notes, result.declared_in, result.samples),
    ]  # fmt: skip
    asked = (
        "" if result.misfit is None else ", and nothing in the residual speaks against the model"
    )
    lacks = "; what the model may lack is what `casest close` asks"
    proved = f"The optimum is proved{asked}{lacks}."
    under = proved if result.trusted and not result.doubtful else ""
    look = "bad" if not result.trusted else "doubtful" if result.doubtful else "good"
    return whole(result.declared, sentence(result), under, body, figures, result.data,
                 trusted=result.trusted, look=look)  # fmt: skip


def _first(result: Calibration) -> str:
    return paragraph(f"Before you use these values: {doubt_sentence(result)}.", "doubt")


def sentence(result: Calibration) -> str:
    """The verdict: what was determined and how well it fits, or why nothing is."""
    if not result.trusted:
        return f"No trustworthy estimate: {result.estimate.certificate.reasons[0]}."
    count = sum(run.samples for run in result.samples)
    rms = with_unit(result.estimate.rmse_fit, result.noise.unit)
    but = ", but the residual is not noise" if result.doubtful else ""
    return (
        f"Trusted{but}: {result.identifiability.unknowns} unknowns determined from {count} "
        f"{result.kind}, with a residual of {rms} rms"
        f"{worse_elsewhere(result.holdout, result.holdout_over_fit)}."
    )


def _asked(result: Calibration) -> str:
    """What the residual says of the model."""
    if result.misfit is None:
        return "Nobody asked whether the residual is noise."
    if result.doubtful:
        return "Something did not: the residual is no noise, as is said above."
    return (
        "Nothing in the residual speaks against the model. It was asked whether it depends on a "
        "column or quantity; of a record in time, whether on that, and for lines; and how large it "
        "is, where repeats say so. What the values have swallowed would not show there."
    )


def _looked_for() -> str:
    return (
        "A calibration looks for no effect. `casest close` with the same arguments does, and names "
        "what these data could not show."
    )


def error_section(result: Calibration, figures: Figures) -> str:
    """Residual of the fit on each axis, and on a held-out record where there is one."""
    residuals, unit = result.residuals, result.noise.unit
    (side,) = residuals.sides
    rows = [("fit", rms(side.residuals))]
    if len(residuals.axes) > 1:
        rows += [(f"fit, {a}", v) for a, v in by_axis(residuals, 0).items()]
    if result.estimate.rmse_holdout is not None:
        rows.append(("held-out", result.estimate.rmse_holdout))
    sizes = alike([value for _, value in rows])
    cells = [[name, s, printed_unit(unit)] for (name, _), s in zip(rows, sizes, strict=True)]
    shown = table(["residual, rms", "size", "unit"], cells, [1])
    notes = points([_repeats(result, result.over_repeats)] if result.over_repeats else [])
    sides = [("after", [value for _, value in rows])]
    several = len(rows) > 1  # one number needs no picture
    picture = error_picture(figures, [name for name, _ in rows], sides, unit) if several else ""
    return section("error", "Error", shown, notes, picture)


def _repeats(result: Calibration, times: float) -> str:
    noise = result.noise
    return (
        f"The residual is {times:.1f} times what the scatter within the rest "
        f"intervals explains ({with_unit(noise.from_repeats, noise.unit)}): the model lacks "
        "something; the standard deviations include that misfit as if it were noise."
    )


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


def by_axis(residuals: Residuals, side: int) -> dict[str, float]:
    """Root mean square of the fit on each axis."""
    whole = np.concatenate(residuals.sides[side].residuals)
    return {a: float(np.sqrt(np.mean(whole[:, k] ** 2))) for k, a in enumerate(residuals.axes)}


def _finite(residuals: Residuals) -> bool:
    """A refused fit may have residuals that no picture can show."""
    return all(np.isfinite(r).all() for side in residuals.sides for r in side.residuals)
