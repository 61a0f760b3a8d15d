"""The report of `casest close`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from casest.diagnose.closing import Closing
from casest.diagnose.selection.cross_validation import FAR
from casest.report.html.applied import application
from casest.report.html.calibration import by_axis, error_picture
from casest.report.html.figures import Figures
from casest.report.html.fitted import certified, parameters, reproduction, uncertain
from casest.report.html.frame import whole
from casest.report.html.numbers import alike, number, printed, printed_unit, with_unit
from casest.report.html.page import details, escaped, paragraph, points, section, table, tag
from casest.report.html.residuals import residual_figures
from casest.report.html.story import Story, of_closing
from casest.report.text.closing import instead, sentence, undecided


def closing_page(closing: Closing, content: Mapping[str, Any], folder: str = "out") -> str:
    """`report.html` of a closed loop."""
    story, figures = of_closing(closing, content), Figures()
    refused = (f"{r['name']} was not added: {r['reason']}" for r in content["refused"])
    body = [
        _errors(story, content, figures),
        section("residual", "Residual", residual_figures(story, figures)),
        parameters(story),
        uncertain(story, content),
        _effects(closing, story, content),
        _invisible(story, content),
        certified(story, content),
        application(story, content, folder),
        reproduction(content, [*content["notes"], *refused]),
    ]
    said = sentence(content)
    verdict = said[0].upper() + said[1:] + "."
    return whole(story.last.model.name, verdict, _under(content), body, content, figures)


def _under(content: Mapping[str, Any]) -> str:
    """What the verdict is worth, in one line."""
    before, after = content["before"]["rmse_holdout"], content["after"]["rmse_holdout"]
    unit = content["noise"]["unit"]
    if after is None:
        return "Nothing could be held out: what the fit says of new data is not known."
    if not content["effects"]:
        return f"Error on data that the fit never saw: {with_unit(after, unit)} rms."
    fell = f" ({_percent(after / before - 1)})" if before else ""
    return (
        f"Error on data that the fit never saw: {with_unit(before, unit, 4)} rms before, "
        f"{with_unit(after, unit, 4)} after{fell}."
    )


def _percent(change: float) -> str:
    return f"{100 * change:+.1f} %".replace("-", "−")


# -- error -----------------------------------------------------------------------------------------


def _errors(story: Story, content: Mapping[str, Any], figures: Figures) -> str:
    rows = list(_error_rows(story, content))
    unit, two = story.unit, bool(content["effects"])
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
        "Held-out: every block of the record is predicted by a fit to the others, or a record of "
        "its own was given with --holdout."
    )
    picture = error_picture(figures, [r[0] for r in rows], sides, unit)
    return section("error", "Error before and after" if two else "Error", said, shown, picture)


def _error_rows(story: Story, content: Mapping[str, Any]) -> Iterator[tuple[str, float, float]]:
    before, after = content["before"], content["after"]
    several = len(story.axes) > 1
    yield "fit", before["rmse_fit"], after["rmse_fit"]
    if several:
        there = by_axis(story, len(story.sides) - 1)
        for axis, value in by_axis(story, 0).items():
            yield f"fit, {axis}", value, there[axis]
    if before["rmse_holdout"] is None:  # nothing could be held out
        return
    yield "held-out", before["rmse_holdout"], after["rmse_holdout"]
    if several:
        for axis, value in before["rmse_holdout_by_axis"].items():
            yield f"held-out, {axis}", value, after["rmse_holdout_by_axis"][axis]


# -- effects ---------------------------------------------------------------------------------------


def _effects(closing: Closing, story: Story, content: Mapping[str, Any]) -> str:
    docs = {f.candidate.name: getattr(f.candidate.effect, "doc", "") for f in closing.effects}
    said = [_effect(e, docs.get(e["name"], ""), story, content) for e in content["effects"]]
    if not said and content["verdict"] is None:
        said = [paragraph("None was tried: there is nothing to judge it by.")]
    elif not said and content["unexplained"]["one_of"]:
        alike = "several explain the data alike, and the parameters hang on which it is"
        said = [paragraph(f"None was added: {alike}.")]
    elif not said:
        said = [paragraph("None was needed: no candidate makes held-out data better predicted.")]
    left = content["unexplained"]
    if content["verdict"] == "unexplained":
        said += [
            tag("h3", "What is left unexplained"),
            paragraph(f"{100 * left['fraction']:.2g} % of the held-out variance: {left['where']}."),
            *(paragraph(f"{words[0].upper()}{words[1:]}.") for words in undecided(content)),
        ]
    rows = [
        [d["name"], f"`{d['parameter']}`", number(d["size"]), printed_unit(d["unit"])]
        for d in content["smallest_detectable"]
    ]
    if rows:
        head = ["effect", "parameter", "smallest size", "unit"]
        said.append(
            details("The smallest effects that would have been seen", table(head, rows, [2]))
        )
    skipped = [[s["name"], s["reason"]] for s in content["not_tried"]]
    if skipped:
        summary = f"Candidates that do not apply to this model or these data ({len(skipped)})"
        said.append(details(summary, table(["candidate", "why"], skipped)))
    return section("effects", "Effects found", *said)


def _effect(e: Mapping[str, Any], doc: str, story: Story, content: Mapping[str, Any]) -> str:
    column = f", of column {e['column']}" if e["column"] else ""
    gain = e["holdout_gain"]
    rows = [
        [f"`{name}`", *_value(p), printed_unit(" ".join(_list(p["unit"])))]
        for name, p in e["parameters"].items()
    ]
    evidence = [f"Chance of as much by noise alone: p = {number(e['p_value'], 2)}."]
    if gain:
        alone = re.fullmatch(r"\w+", story.unit)
        squared = f"{story.unit}^2" if alone else f"({story.unit})^2"
        unit = "" if story.unit == "1" else f" {printed_unit(squared)}"
        evidence.append(
            f"The mean square error on held-out data falls by {number(gain)}{unit}, residuals "
            f"beyond {FAR:g} standard deviations of the noise counted as {FAR:g}."
        )
    if e["indistinguishable_from"]:
        names = ", ".join(f"`{n}`" for n in e["indistinguishable_from"])
        more = ", ".join(f"`{n}`" for n in e["less_likely"])
        more = f", nor, though they are less likely, from {more}" if more else ""
        evidence.append(f"These data do not tell it apart from {names}{more}.")
        evidence += [f"To tell them apart, {words}." for words in e["would_separate"]]
        evidence += [f"{words[0].upper()}{words[1:]}." for words in instead(e, content)]
    else:
        evidence.append("No other candidate explains the held-out data as well.")
    return "".join(
        [
            tag("h3", escaped(f"{e['name']} on {e['on']}{column}")),
            paragraph(doc.partition("\n\n")[0].replace("\n", " ")) if doc else "",
            tag("pre", tag("code", escaped(f"{e['on']} → {e['formula']}"))),
            table(["parameter", "value", "± std", "unit"], rows, [1, 2]),
            points(evidence),
        ]
    )


def _value(p: Mapping[str, Any]) -> tuple[str, str]:
    from casest.report.text.calibration import rounded

    values, spreads = _list(p["value"]), _list(p["std"])
    if len(values) == 1 and values[0] is not None and spreads[0] is not None:
        value, std = rounded(values[0], spreads[0])
        return printed(value), printed(std)
    return ", ".join(map(number, values)), ", ".join(map(number, spreads))


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        return [value]
    return [entry for part in value for entry in _list(part)]


# -- invisible -------------------------------------------------------------------------------------


def _invisible(story: Story, content: Mapping[str, Any]) -> str:
    hidden = content["invisible"]
    if not hidden:
        said = "Every effect of the catalogue that applies here would have shown at a typical size."
        if not content["smallest_detectable"] and not content["effects"]:
            said = "No effect of the catalogue applies here: nobody knows what stays invisible."
        return section("invisible", "What stayed invisible", paragraph(said))
    rows = [
        [
            i["name"] + (f" ({i['column']})" if i["column"] else ""),
            ", ".join(f"`{n}` = {with_unit(v, i['units'][n])}" for n, v in i["typical"].items()),
            _moves(i["would_move"], story),
            i["shown_by"],
        ]
        for i in hidden
    ]
    said = paragraph(
        "Each of these, of a typical size, would be taken over by the declared parameters: nothing "
        "would show in the residual, and the parameters would be wrong by as much as is written."
    )
    head = ["effect", "typical size", "would move", "the measurement that shows it"]
    return section("invisible", "What stayed invisible", said, table(head, rows))


def _moves(would_move: Mapping[str, float], story: Story) -> str:
    sizes = {n: with_unit(v, story.unit_of(n)) for n, v in would_move.items()}
    return ", ".join(f"`{n}` by {size}" for n, size in sizes.items())
