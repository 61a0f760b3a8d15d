"""What `casest close` prints: the verdict first, then the evidence."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from casest.data.logs import file_name
from casest.diagnose.closing import Closing
from casest.diagnose.selection.found import HELD_OUT_DATA
from casest.effects import CATALOGUE
from casest.report.next_command import following
from casest.report.text.calibration import WIDTH, held, item, value_table

#: Lists longer than this are left to result.json.
SHOWN = 4
#: Samples that resemble each other from which on noise may as well be a lag or a hysteresis.
COLOURED = 20


def closing_text(closing: Closing, content: Mapping[str, Any], output: Path | None) -> str:
    """Verdict, error before and after, effects, parameters, what stays invisible."""
    blocks = [
        _head(closing, content),
        "\n".join(_errors(content)),
        "\n".join(_effects(content)),
        "\n".join(value_table(closing.after)),
        "\n".join(held(closing.after, content)),
        "\n".join(_moved(content)),
        "\n".join(_invisible(content)),
        "\n".join(_unexplained(content)),
        "\n".join(_detectable(content)),
        "\n".join(_notes(content)),
    ]
    if output is not None:
        blocks.append(f"Written: {output}/report.html, result.json, residuals.csv")
    applies = closing.after.model.traced.corrected is not None
    blocks.append(following(content["reproduce"]["command"], output, applies=applies))
    return "\n\n".join(b for b in blocks if b)


def sentence(content: Mapping[str, Any]) -> str:
    """The verdict in one sentence."""
    names = [e["name"] + (f" ({e['column']})" if e["column"] else "") for e in content["effects"]]
    if content["verdict"] is None:
        return (
            "no verdict: nothing can be held out"
            if content["trusted"]
            else ("no trustworthy estimate")
        )
    untried = _untried(content)
    if content["verdict"] == "adequate":
        said = "nothing that these data can show is missing"
        if not names and not content["smallest_detectable"]:
            said = f"nothing is found; {len(content['not_tried'])} effects do not apply here"
        noise = f"; {', '.join(names)} belong to the noise" if names else ""
        return f"adequate: {said}{noise}{untried}"
    if content["verdict"] == "extended":
        verb = "was" if len(names) == 1 else "were"
        over = content["noise"].get("correlated_over_samples") or 1
        coloured = f"coloured noise (alike over {over:.0f} samples), or a lag"
        left = "noise" if over < COLOURED else coloured
        return f"extended: {', '.join(names)} {verb} missing; what is left is {left}{untried}"
    found = f"beside {', '.join(names)} " if names else ""
    causes = content["unexplained"]["one_of"]
    if causes:
        several = " or ".join(causes) if 1 < len(causes) < 4 else "several causes"
        return f"unexplained: {found}a misfit remains that {several} explain alike"
    return f"unexplained: {found}a misfit remains that no candidate explains"


def _untried(content: Mapping[str, Any]) -> str:
    """The user's own effects that could not be tried."""
    own = _own(content["not_tried"])
    names = [s["name"] for s in own if not s["reason"].startswith("column ")]
    return f"; {', '.join(names)} could not be tried" if names else ""


def _own(named: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Those that are not shipped: what the user gave."""
    shipped = {e.name for e in CATALOGUE}
    return [n for n in named if n["name"].partition("(")[0] not in shipped]


def _head(closing: Closing, content: Mapping[str, Any]) -> str:
    files = ", ".join(file_name(name) for name in content["data"])
    return textwrap.fill(f"{closing.before.model.name} on {files}: {sentence(content)}", WIDTH)


def _errors(content: Mapping[str, Any]) -> Iterator[str]:
    unit = content["noise"]["unit"]
    unit = "" if unit == "1" else f" {unit}"
    before, after = content["before"], content["after"]
    yield f"  residual rms{unit:<12} {'before':>12} {'after':>12}"
    rows = [("fit", "rmse_fit"), ("held-out", "rmse_holdout")]
    for word, key in rows:
        yield f"    {word:<22} {_figure(before[key])} {_figure(after[key])}"
    axes = before["rmse_holdout_by_axis"]
    if len(axes) > 1 and before["rmse_holdout"] is not None:
        for axis, value in axes.items():
            there = after["rmse_holdout_by_axis"][axis]
            yield f"    held-out, {axis:<12} {_figure(value)} {_figure(there)}"


def _figure(value: float | None) -> str:
    return f"{'-' if value is None else format(value, '#.5g'):>12}"


def _effects(content: Mapping[str, Any]) -> Iterator[str]:
    if content["effects"]:
        yield "Added:"
    for e in content["effects"]:
        column = f" of column {e['column']}" if e["column"] else ""
        yield item(f"{e['name']} on {e['on']}{column} (p = {e['p_value']:.1g}): {e['formula']}")
        if e["indistinguishable_from"]:
            also = f" (less likely: {', '.join(e['less_likely'])})" if e["less_likely"] else ""
            yield item(f"not told apart from {', '.join(e['indistinguishable_from'])}{also}")
            yield from (item(f"to tell it from {w}") for w in e["would_separate"][:SHOWN])
            yield from (item(words) for words in instead(e, content))


def instead(effect: Mapping[str, Any], content: Mapping[str, Any]) -> Iterator[str]:
    """What hangs on which of the causes it is."""
    for label, shifts in effect["instead_would_move"].items():
        if shifts:
            words = moved_by(shifts, content)
            yield f"were it {label} instead, the parameters would move: {words}"


def moved_by(shifts: Mapping[str, float], content: Mapping[str, Any]) -> str:
    """`offset by 0.05 m/s^2, …`."""
    parameters = content["after"]["parameters"]
    return ", ".join(
        f"{name} by {size:.2g} {_first(parameters[name]['unit'])}".removesuffix(" 1").rstrip()
        for name, size in shifts.items()
    )


def undecided(content: Mapping[str, Any]) -> Iterator[str]:
    """Causes of which none was added: what each would do, what would tell them apart."""
    left = content["unexplained"]
    for label, shifts in left["would_move"].items():
        if shifts:
            yield f"{label} would move the parameters: {moved_by(shifts, content)}"
    yield from (f"to tell {words}" for words in left["would_separate"][:SHOWN])
    shipped = {e.name for e in CATALOGUE}
    names = [label.partition("(")[0] for label in left["would_move"]]
    if name := next((n for n in names if n in shipped), ""):
        yield f"who knows which of them is there says so, as --effects {name}"


def _first(unit: Any) -> str:
    return _first(unit[0]) if isinstance(unit, list) else str(unit)


def _moved(content: Mapping[str, Any]) -> Iterator[str]:
    if not content["effects"]:
        return
    moved = {n: _largest(z) for n, z in content["moved"].items()}
    far = sorted(((z, n) for n, z in moved.items() if z is not None and z >= 1), reverse=True)
    if far:
        words = ", ".join(f"{n} by {z:.1f}" for z, n in far)
        yield item(f"Moved by the addition, in standard deviations before it: {words}")


def _largest(z: Any) -> float | None:
    if isinstance(z, list):
        found = [x for x in map(_largest, z) if x is not None]
        return max(found, default=None)
    return None if z is None else abs(z)


def _invisible(content: Mapping[str, Any]) -> Iterator[str]:
    hidden = content["invisible"]
    if hidden:
        yield "Could be wrong without showing (shift by a typical size):"
    for i in hidden[:SHOWN]:
        moves = ", ".join(f"{n} by {v:.2g}" for n, v in i["would_move"].items())
        units = {n: "" if u == "1" else f" {u}" for n, u in i["units"].items()}
        size = ", ".join(f"{n} = {v:.3g}{units[n]}" for n, v in i["typical"].items())
        yield item(f"{i['name']} ({size}): {moves}; shown by {i['shown_by']}")
    if len(hidden) > SHOWN:
        yield f"  - and {len(hidden) - SHOWN} more, in result.json"


def _unexplained(content: Mapping[str, Any]) -> Iterator[str]:
    left = content["unexplained"]
    if content["verdict"] == "unexplained":
        yield item(
            f"Unexplained: {100 * left['fraction']:.2g} % of the held-out variance, {left['where']}"
        )
        yield from (item(words) for words in undecided(content))


def _detectable(content: Mapping[str, Any]) -> Iterator[str]:
    """How small an effect would have been seen, where none was."""
    sizes: dict[str, str] = {}
    own = _own(content["smallest_detectable"])
    for d in [*own, *content["smallest_detectable"]]:
        unit = "" if d["unit"] == "1" else f" {d['unit']}"
        sizes.setdefault(d["name"], f"{d['parameter']} = {d['size']:.2g}{unit}")
    if content["verdict"] == "adequate" and sizes:
        yield "Would have been seen, from this size on:"
        yield from (item(words) for words in list(sizes.values())[:SHOWN])
        if len(sizes) > SHOWN:
            yield f"  - and {len(sizes) - SHOWN} more, in result.json"


def _notes(content: Mapping[str, Any]) -> Iterator[str]:
    yield from (item(note) for note in content["notes"])
    for refused in content["refused"][:SHOWN]:
        everything = refused["name"] == HELD_OUT_DATA
        what = "nothing was" if everything else f"{refused['name']} was not"
        yield item(f"{what} added: {refused['reason']}")
    for skipped in _own(content["not_tried"]):
        yield item(f"{skipped['name']} was not tried: {skipped['reason']}")
