"""The report of `casest close`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from msgspec import UnsetType

from casest.data.logs import file_name
from casest.report.html.applied import application
from casest.report.html.calibration import by_axis, error_picture
from casest.report.html.figures import Figures
from casest.report.html.fitted import certified, parameters, reproduction, uncertain
from casest.report.html.frame import whole
from casest.report.html.numbers import alike, in_words, number, printed, printed_unit, with_unit
from casest.report.html.page import (
    code_block,
    details,
    escaped,
    paragraph,
    points,
    section,
    table,
    tag,
)
from casest.report.html.poses import poses_seen
from casest.report.html.residuals import convincing, residual_figures
from casest.results.closing import Closed, Effect
from casest.results.residuals import Residuals
from casest.results.result import Parameter
from casest.results.rounding import percent, rounded
from casest.results.verdict import consequence, instead, judged, sentence, sided, undecided


def closing_page(result: Closed, folder: str = "out") -> str:
    """`report.html` of a closed loop."""
    figures = Figures()
    refused = (f"{r.name} was not added: {r.reason}" for r in result.refused)
    notes = [*result.notes, *refused]
    residuals = result.residuals
    changed = [_effects(result), parameters(result)]
    body = [
        *(changed if result.effects else reversed(changed)),
        section("evidence", "The evidence", poses_seen(residuals.poses, figures),
                convincing(residuals, figures)),
        _errors(result, figures),
        section("residual", "Residual", residual_figures(residuals, figures)),
        uncertain(result),
        _invisible(result),
        certified(result),
        application(result, folder),
        reproduction(result.reproduce, notes, result.declared_in, result.samples),
    ]  # fmt: skip
    said = sentence(result)
    verdict = said[0].upper() + said[1:] + "."
    return whole(result.declared, verdict, _under(result), body, figures, result.data,
                 trusted=result.trusted, look=_LOOKS.get(result.verdict, "bad"))  # fmt: skip


_LOOKS: dict[str | None, str] = {"adequate": "good", "extended": "doubtful"}


def _under(result: Closed) -> str:
    """What the verdict is worth, in one line."""
    before, after = result.before.rmse_holdout, result.after.rmse_holdout
    unit = result.noise.unit
    if after is None:
        return "Nothing could be held out: what the fit says of new data is not known."
    if not result.effects:
        return f"Error on data that the fit never saw: {with_unit(after, unit)} rms."
    fell = f" ({_percent(after / before - 1)})" if before else ""
    return (
        f"{consequence(result)}Error on data that the fit never saw: "
        f"{with_unit(before, unit, 4)} rms before, {with_unit(after, unit, 4)} after{fell}."
    )


def _percent(change: float) -> str:
    return f"{100 * change:+.1f} %".replace("-", "−")


# -- error -----------------------------------------------------------------------------------------


def _errors(result: Closed, figures: Figures) -> str:
    rows = list(_error_rows(result))
    unit, two = result.noise.unit, bool(result.effects)
    head = ["residual, rms", "before", "after", "change", "unit"]
    texts = alike([v for _, *pair in rows for v in pair])
    cells = [
        [
            name,
            texts[2 * k],
            texts[2 * k + 1],
            _percent(a / b - 1) if b else "–",
            printed_unit(unit),
        ]
        for k, (name, b, a) in enumerate(rows)
    ]
    shown = table(head, cells, [1, 2, 3])
    sides = [("after", [a for _, _, a in rows])]
    if two:
        sides.insert(0, ("before", [b for _, b, _ in rows]))
    else:
        single = [[c[0], c[2], c[4]] for c in cells]
        shown = table(["residual, rms", "size", "unit"], single, [1])
    said = paragraph(
        "Held-out: every block of the record is predicted by a fit to the others."
        if isinstance(result.holdout, UnsetType)
        else f"Held-out: {', '.join(map(file_name, result.holdout))}, which no fit has seen."
    )
    picture = error_picture(figures, [r[0] for r in rows], sides, unit)
    return section("error", "Error before and after" if two else "Error", said, shown, picture)


def _error_rows(result: Closed) -> Iterator[tuple[str, Any, Any]]:
    before, after, residuals = result.before, result.after, result.residuals
    several = len(residuals.axes) > 1
    yield "fit", before.rmse_fit, after.rmse_fit
    if several:
        there = by_axis(residuals, len(residuals.sides) - 1)
        for axis, value in by_axis(residuals, 0).items():
            yield f"fit, {axis}", value, there[axis]
    if before.rmse_holdout is None:  # nothing could be held out
        return
    yield "held-out", before.rmse_holdout, after.rmse_holdout
    if several:
        for axis, error in before.rmse_holdout_by_axis.items():
            yield f"held-out, {axis}", error, after.rmse_holdout_by_axis[axis]


# -- effects ---------------------------------------------------------------------------------------


def _effects(result: Closed) -> str:
    said = [_effect(e, result) for e in result.effects]
    if not said and result.verdict is None:
        said = [paragraph("None was tried: there is nothing to judge it by.")]
    elif not said and result.unexplained.one_of:
        alike = "several explain the data alike, and the parameters hang on which it is"
        said = [paragraph(f"None was added: {alike}.")]
    elif not said:
        said = [paragraph("None was needed: no candidate makes held-out data better predicted.")]
    left = result.unexplained
    if result.verdict == "unexplained" and left.fraction is not None:
        words = undecided(left, result.after.parameters, result.reproduce.command)
        said += [
            tag("h3", "What is left unexplained"),
            paragraph(f"{percent(left.fraction)} of the held-out variance: {left.where}."),
            *(paragraph(in_words(f"{w[0].upper()}{w[1:]}.")) for w in words),
        ]
    return section("effects", "Effects found", *said)


def _effect(e: Effect, result: Closed) -> str:
    column, doc = f", of column {e.column}" if e.column else "", result.docs.get(e.name, "")
    rows = [
        [f"`{name}`", *_value(p), printed_unit(" ".join(_list(p.unit)))]
        for name, p in e.parameters.items()
    ]
    chance = f"p = {number(e.p_value, 2)}" if e.p_value else "below 1e-300"
    evidence = [f"Chance of as much by noise alone: {chance}."]
    if e.holdout_gain:
        own = result.noise.unit
        squared = f"{own}^2" if re.fullmatch(r"\w+", own) else f"({own})^2"
        unit = "" if own == "1" else f" {printed_unit(squared)}"
        evidence.append(judged(f"{number(e.holdout_gain)}{unit}"))
    evidence += [in_words(f"{w[0].upper()}{w[1:]}.") for w in sided(e)]
    if e.indistinguishable_from:
        names = ", ".join(f"`{n}`" for n in e.indistinguishable_from)
        more = ", ".join(f"`{n}`" for n in e.less_likely)
        more = f", nor, though they are less likely, from {more}" if more else ""
        evidence.append(f"These data do not tell it apart from {names}{more}.")
        evidence += [f"To tell them apart, {words}." for words in e.would_separate]
        words = instead(e, result.after.parameters)
        evidence += [in_words(f"{w[0].upper()}{w[1:]}.") for w in words]
    else:
        evidence.append("No other candidate explains the held-out data as well.")
    return "".join(
        [
            tag("h3", escaped(f"{e.name} on {e.on}{column}")),
            paragraph(doc.partition("\n\n")[0].replace("\n", " ")) if doc else "",
            code_block(f"{e.on} → {e.formula}"),
            table(["parameter", "value", "± std", "unit"], rows, [1, 2]),
            points(evidence),
        ]
    )


def _value(p: Parameter) -> tuple[str, str]:
    """Every number to two digits of its own standard deviation."""
    values, spreads = _list(p.value), _list(p.std)
    spreads = spreads if len(spreads) == len(values) else [None] * len(values)
    pairs = [
        (number(v), number(s)) if v is None or s is None else tuple(map(printed, rounded(v, s)))
        for v, s in zip(values, spreads, strict=True)
    ]
    return ", ".join(v for v, _ in pairs), ", ".join(s for _, s in pairs)


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        return [value]
    return [entry for part in value for entry in _list(part)]


# -- invisible -------------------------------------------------------------------------------------


def _invisible(result: Closed) -> str:
    """What would not have shown, what would from which size on, what could not be asked."""
    return section("invisible", "What stayed invisible", *_hidden(result), *_asked(result))


def _hidden(result: Closed) -> Iterator[str]:
    hidden = result.invisible
    if not hidden:
        said = "Every effect of the catalogue that applies here would have shown at a typical size."
        if not result.smallest_detectable and not result.effects:
            said = "No effect of the catalogue applies here: nobody knows what stays invisible."
        yield paragraph(said)
        return
    rows = [
        [
            i.name + (f" ({i.column})" if i.column else ""),
            ", ".join(f"`{n}` = {with_unit(v, i.units[n])}" for n, v in i.typical.items()),
            _moves(i.would_move, result.residuals),
            i.shown_by,
        ]
        for i in hidden
    ]
    yield paragraph(
        "Each of these, of a typical size, would be taken over by the declared parameters: nothing "
        "would show in the residual, and the parameters would be wrong by as much as is written."
    )
    head = ["effect", "typical size", "would move", "the measurement that shows it"]
    yield table(head, rows)


def _asked(result: Closed) -> Iterator[str]:
    """Each behind its heading: they are long."""
    rows = [
        [d.name, f"`{d.parameter}`", number(d.size), printed_unit(d.unit)]
        for d in result.smallest_detectable
    ]
    if rows:
        head = ["effect", "parameter", "smallest size", "unit"]
        yield details("The smallest effects that would have been seen", table(head, rows, [2]))
    skipped = [[s.name, s.reason] for s in result.not_tried]
    if skipped:
        summary = f"Candidates that do not apply to this model or these data ({len(skipped)})"
        yield details(summary, table(["candidate", "why"], skipped))


def _moves(would_move: Mapping[str, float], residuals: Residuals) -> str:
    sizes = {n: with_unit(v, residuals.unit_of(n)) for n, v in would_move.items()}
    return ", ".join(f"`{n}` by {size}" for n, size in sizes.items())
