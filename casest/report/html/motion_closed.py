"""The report of `casest close` of an estimator in motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from casest.diagnose.motion.loop import MotionClosing
from casest.report.html.calibration import error_picture
from casest.report.html.figures import Figures
from casest.report.html.fitted import reproduction
from casest.report.html.frame import whole
from casest.report.html.motion import conventions, innovation_figures, state_figures
from casest.report.html.numbers import alike, number, printed_unit, with_unit
from casest.report.html.page import paragraph, points, section, table
from casest.report.text.motion import found, sentence


def closing_motion_page(closing: MotionClosing, content: Mapping[str, Any]) -> str:
    """`report.html` of a loop closed in motion."""
    figures, found = Figures(), closing.after.found
    body = [
        _errors(content, figures),
        _effects(content),
        section("states", "States", *state_figures(found, figures)),
        _parameters(content),
        section("innovations", "Innovations", *innovation_figures(found, content, figures)),
        _invisible(content),
        conventions(closing.after.model),
        reproduction(
            content,
            [*content["notes"],
             *(f"{r['name']} was not added: {r['reason']}" for r in content["refused"])],
        ),
    ]  # fmt: skip
    said = sentence(content)
    unit = content["noise"]["unit"]
    after = with_unit(content["after"]["rmse_holdout"], unit, 4)
    under = f"One-step innovation on held-out time: {after} rms."
    return whole(content["model"], f"{said[0].upper()}{said[1:]}.", under, body, content, figures)


def _errors(content: Mapping[str, Any], figures: Figures) -> str:
    before, after = content["before"], content["after"]
    rows = [("fit", before["rmse_fit"], after["rmse_fit"]),
            ("held-out", before["rmse_holdout"], after["rmse_holdout"])]  # fmt: skip
    for axis, value in before["rmse_holdout_by_axis"].items():
        rows.append((f"held-out, {axis}", value, after["rmse_holdout_by_axis"][axis]))
    texts = alike([v for _, *pair in rows for v in pair])
    unit = printed_unit(content["noise"]["unit"])
    cells = [[name, texts[2 * k], texts[2 * k + 1], unit] for k, (name, _, _) in enumerate(rows)]
    said = paragraph(
        "One-step innovations: what each reading says beyond what all before it foretold. "
        "Held-out: every block of time with numbers of the effects from the others. Both sides "
        "with noise intensities matched to the record."
    )
    shown = table(["innovation, rms", "before", "after", "unit"], cells, [1, 2])
    rise = after["log_likelihood"] - before["log_likelihood"]
    gained = paragraph(f"Log-likelihood: {rise:+.1f}.") if content["effects"] else ""
    sides = [("before", [b for _, b, _ in rows]), ("after", [a for _, _, a in rows])]
    picture = error_picture(figures, [row[0] for row in rows], sides, content["noise"]["unit"])
    return section("error", "Error before and after", said, shown, gained, picture)


def _effects(content: Mapping[str, Any]) -> str:
    if not content["effects"]:
        said = paragraph("None was needed: no candidate makes held-out time better predicted.")
        return section("effects", "Effects", said)
    texts = []
    for e in content["effects"]:
        text = f"{e['name']} of {e['on']}: {e['formula']}{found(e)} (p = {number(e['p_value'], 1)})"
        if e["indistinguishable_from"]:
            text += f"; not told apart from {', '.join(e['indistinguishable_from'])}"
        texts.append(text + ".")
    return section("effects", "Effects", points(texts))


def _parameters(content: Mapping[str, Any]) -> str:
    rows = []
    for name, p in content["after"]["parameters"].items():
        for k, (value, std) in enumerate(zip(p["value"], p["std"], strict=True)):
            label = f"`{name}[{k}]`" if len(p["value"]) > 1 else f"`{name}`"
            rows.append([label, number(value, 5), number(std, 2), printed_unit(p["unit"])])
    head = ["at the end of the record", "value", "± std", "unit"]
    noise = content["noise"]
    cells = [
        [f"`{name}`", number(noise["declared"].get(name)) if name in noise["declared"] else "–",
         number(noise["intensities"]["before"].get(name)), number(value)]
        for name, value in noise["intensities"]["after"].items()
    ]  # fmt: skip
    titles = ["noise intensity of", "declared", "matched, before", "matched, after"]
    matched = table(titles, cells, [1, 2, 3])
    return section("parameters", "Numbers", table(head, rows, [1, 2]), matched)


def _invisible(content: Mapping[str, Any]) -> str:
    if not content["invisible"]:
        return ""
    texts = []
    for i in content["invisible"]:
        moves = ", ".join(f"{n} by {v:.2g}" for n, v in i["would_move"].items())
        texts.append(f"{i['name']} of {i['on']} would move {moves}; shown by {i['shown_by']}.")
    return section("invisible", "What could be wrong without showing", points(texts))
