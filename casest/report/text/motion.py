"""What `casest close` prints of an estimator in motion: the verdict first, then the evidence."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casest.data.logs import file_name
from casest.report.next_command import following
from casest.report.text.calibration import WIDTH, item, rounded

#: Lists longer than this are left to result.json.
SHOWN = 4


def motion_text(content: Mapping[str, Any], output: Path | None) -> str:
    """Verdict, error before and after, effects, states at the end, what stays invisible."""
    files = ", ".join(file_name(name) for name in content["data"])
    head = f"{content['model']} on {files}: {sentence(content)}"
    blocks = [
        textwrap.fill(head, WIDTH),
        "\n".join(_errors(content)),
        "\n".join(_effects(content)),
        "\n".join(_parameters(content)),
        "\n".join(_intensities(content)),
        "\n".join(_left(content)),
    ]
    if output is not None:
        blocks.append(f"Written: {output}/report.html, result.json, residuals.csv")
    typed, trusted = content["reproduce"]["command"], content["trusted"]
    blocks.append(
        following(typed, output, trusted=trusted, applies=not content["effects"], moving=True)
    )
    return "\n\n".join(b for b in blocks if b)


def sentence(content: Mapping[str, Any]) -> str:
    """The verdict in one sentence."""
    names = [f"{e['name']} of {e['on']}" for e in content["effects"]]
    if content["verdict"] is None:
        return "no trustworthy estimate"
    if content["verdict"] == "adequate":
        return "adequate: nothing that this trajectory can show is missing"
    if content["verdict"] == "extended":
        verb = "was" if len(names) == 1 else "were"
        return f"extended: {', '.join(names)} {verb} missing; what is left is noise"
    beside = f" beside {', '.join(names)}" if names else ""
    return f"unexplained: the innovations are not white{beside}, and no candidate says why"


def _errors(content: Mapping[str, Any]) -> Iterator[str]:
    before, after = content["before"], content["after"]
    title = f"one-step innovations, rms {content['noise']['unit']}"
    yield f"  {title:<34}{'before':>10}{'after':>12}"
    for word, key in (("fit", "rmse_fit"), ("held-out", "rmse_holdout")):
        yield f"    {word:<30}{before[key]:>12.5g}{after[key]:>12.5g}"
    for axis, value in before["rmse_holdout_by_axis"].items():
        there = after["rmse_holdout_by_axis"][axis]
        yield f"    {'held-out, ' + axis:<30}{value:>12.5g}{there:>12.5g}"
    if content["effects"]:
        rise = after["log_likelihood"] - before["log_likelihood"]
        yield f"    log-likelihood: {rise:+.1f}"


def _effects(content: Mapping[str, Any]) -> Iterator[str]:
    if content["effects"]:
        yield "Added:"
    for e in content["effects"]:
        yield item(f"{e['name']} of {e['on']} (p = {e['p_value']:.1g}): {e['formula']}{found(e)}")
        if e["indistinguishable_from"]:
            yield item(f"not told apart from {', '.join(e['indistinguishable_from'])}")
            yield from (item(words) for words in e["would_separate"])


def found(effect: Mapping[str, Any]) -> str:
    """`; k = 0.1996 ± 0.0004 s`: the numbers of an effect."""
    said = []
    for name, p in effect["parameters"].items():
        values, stds = (np.atleast_1d(np.array(p[key], float)) for key in ("value", "std"))
        pairs = zip(values, np.broadcast_to(stds, values.shape), strict=True)
        shown = [" ± ".join(rounded(v, s)) if np.isfinite(s) else f"{v:.3g}" for v, s in pairs]
        text = ", ".join(shown)
        unit = "" if p["unit"] == "1" else f" {p['unit']}"
        said.append(f"{name} = {text}{unit}")
    return f"; {', '.join(said)}"


def _parameters(content: Mapping[str, Any]) -> Iterator[str]:
    yield "At the end of the record, and the numbers of what was added:"
    rows = [
        (name if len(p["value"]) == 1 else f"{name}[{k}]", *rounded(v, s), p["unit"])
        for name, p in content["after"]["parameters"].items()
        for k, (v, s) in enumerate(zip(p["value"], p["std"], strict=True))
    ]
    width, left, middle = (max(len(r[k]) for r in rows) for k in range(3))
    for name, value, std, unit in rows:
        shown = "" if unit == "1" else unit
        yield f"  {name:<{width}}  {value:>{left}} ± {std:<{middle}}  {shown}".rstrip()


def _intensities(content: Mapping[str, Any]) -> Iterator[str]:
    """What the record asks for; published ones may be far away."""
    declared, after = content["noise"]["declared"], content["noise"]["intensities"]["after"]
    said = [
        f"{name} {value:.2g}" + (f" (declared {declared[name]:.2g})" if name in declared else "")
        for name, value in after.items()
    ]
    yield item("noise intensities matched to the record: " + ", ".join(said))


def _left(content: Mapping[str, Any]) -> Iterator[str]:
    if content["verdict"] == "unexplained":
        left = content["unexplained"]
        yield item(f"Unexplained: {left['fraction']:.1%} of the variance, {left['where']}")
    if content["invisible"]:
        yield "Could be wrong without showing (shift by a typical size):"
    for i in content["invisible"][:SHOWN]:
        moves = ", ".join(f"{n} by {v:.2g}" for n, v in i["would_move"].items())
        size = i["typical"]["k"]
        yield item(f"{i['name']} of {i['on']} ({size:.2g}): {moves}; shown by {i['shown_by']}")
    yield from (item(f"{r['name']} was not added: {r['reason']}") for r in content["refused"])
    yield from (item(note) for note in content["notes"])
