"""The report of `casest close` of an estimator in motion."""

from __future__ import annotations

from typing import Any

from casest.report.html.calibration import error_picture
from casest.report.html.figures import Figures
from casest.report.html.fitted import reproduction
from casest.report.html.frame import whole
from casest.report.html.motion import conventions, innovation_figures, state_figures
from casest.report.html.numbers import alike, number, printed_unit, with_unit
from casest.report.html.page import paragraph, points, section, table
from casest.results.motion import MotionClosed, called, numbers_of, sentence


def closing_motion_page(result: MotionClosed) -> str:
    """`report.html` of a loop closed in motion."""
    figures, along = Figures(), result.trajectory
    refused = (f"{r.name} was not added: {r.reason}" for r in result.refused)
    innovations = innovation_figures(along, result.innovations, figures)
    body = [
        _errors(result, figures),
        _effects(result),
        section("states", "States", *state_figures(along, figures)),
        _parameters(result),
        section("innovations", "Innovations", *innovations),
        _invisible(result),
        conventions(along),
        reproduction(result.reproduce, [*result.notes, *refused]),
    ]
    said = sentence(result)
    after = with_unit(result.after.rmse_holdout, result.noise.unit, 4)
    under = f"One-step innovation on held-out time: {after} rms."
    verdict = f"{said[0].upper()}{said[1:]}."
    return whole(result.model, verdict, under, body, figures, result.data, trusted=result.trusted)


def _errors(result: MotionClosed, figures: Figures) -> str:
    before, after = result.before, result.after
    rows: list[tuple[str, Any, Any]] = [
        ("fit", before.rmse_fit, after.rmse_fit),
        ("held-out", before.rmse_holdout, after.rmse_holdout),
    ]
    for axis, value in before.rmse_holdout_by_axis.items():
        rows.append((f"held-out, {axis}", value, after.rmse_holdout_by_axis[axis]))
    texts = alike([v for _, *pair in rows for v in pair])
    unit = printed_unit(result.noise.unit)
    cells = [[name, texts[2 * k], texts[2 * k + 1], unit] for k, (name, _, _) in enumerate(rows)]
    said = paragraph(
        "One-step innovations: what each reading says beyond what all before it foretold. "
        "Held-out: every block of time with numbers of the effects from the others. Both sides "
        "with noise intensities matched to the record."
    )
    shown = table(["innovation, rms", "before", "after", "unit"], cells, [1, 2])
    gained = paragraph(f"Log-likelihood: {result.risen:+.1f}.") if result.effects else ""
    sides = [("before", [b for _, b, _ in rows]), ("after", [a for _, _, a in rows])]
    picture = error_picture(figures, [row[0] for row in rows], sides, result.noise.unit)
    return section("error", "Error before and after", said, shown, gained, picture)


def _effects(result: MotionClosed) -> str:
    if not result.effects:
        said = paragraph("None was needed: no candidate makes held-out time better predicted.")
        return section("effects", "Effects", said)
    texts = []
    for e in result.effects:
        text = f"{called(e)}: {e.formula}{numbers_of(e)} (p = {number(e.p_value, 1)})"
        if e.indistinguishable_from:
            text += f"; not told apart from {', '.join(e.indistinguishable_from)}"
        texts.append(text + ".")
    return section("effects", "Effects", points(texts))


def _parameters(result: MotionClosed) -> str:
    rows = []
    for name, p in result.after.parameters.items():
        for k, (value, std) in enumerate(zip(p.value, p.std, strict=True)):
            label = f"`{name}[{k}]`" if len(p.value) > 1 else f"`{name}`"
            rows.append([label, number(value, 5), number(std, 2), printed_unit(str(p.unit))])
    head = ["at the end of the record", "value", "± std", "unit"]
    declared, before = result.noise.declared, result.noise.intensities.before
    cells = [
        [f"`{name}`", number(declared.get(name)), number(before.get(name)), number(value)]
        for name, value in result.noise.intensities.after.items()
    ]
    titles = ["noise intensity of", "declared", "matched, before", "matched, after"]
    matched = table(titles, cells, [1, 2, 3])
    return section("parameters", "Numbers", table(head, rows, [1, 2]), matched)


def _invisible(result: MotionClosed) -> str:
    if not result.invisible:
        return ""
    texts = []
    for i in result.invisible:
        moves = ", ".join(f"{n} by {v:.2g}" for n, v in i.would_move.items())
        texts.append(f"{called(i)} would move {moves}; shown by {i.shown_by}.")
    return section("invisible", "What could be wrong without showing", points(texts))
