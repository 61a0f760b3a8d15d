"""What a command prints: plain text that fits 80 columns."""

from __future__ import annotations

import json
import os
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from casest.data.logs import file_name
from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array, in_digits
from casest.dynamics import Dynamics
from casest.estimate.calibrate import Estimate
from casest.report.next_command import following
from casest.results.units import entry_units, unit_table
from casest.solve.strategy import SOLVERS

WIDTH = 80


#: Verdicts and their colours (SGR codes): red, green, yellow.
_COLOURS = {
    r"NOT\s+TRUSTED|unexplained(?=:)|no\s+trustworthy\s+estimate": 31,
    r"trusted,\s+but\s+the\s+residual\s+is\s+not\s+noise|extended(?=:)": 33,
    r"trusted$|adequate(?=:)": 32,
}


def coloured(text: str, stream: TextIO) -> str:
    """The text with its verdict in colour on a terminal, where NO_COLOR does not forbid it."""
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    head, gap, rest = text.partition("\n\n")
    for verdict, code in _COLOURS.items():
        head, found = re.subn(verdict, f"\x1b[1;{code}m\\g<0>\x1b[0m", head, count=1)
        if found:
            break
    return head + gap + rest


def listing(
    models: Sequence[tuple[str, Model]],
    effects: Sequence[Effect] = (),
    moving: Sequence[tuple[str, Dynamics]] = (),
    motion_effects: Sequence[tuple[str, str, str]] = (),
    *,
    as_json: bool = False,
) -> str:
    """Shipped problems and estimators in motion, a paragraph each; a line for each effect.

    `motion_effects`: name of each effect in motion, what it is on, and what it does.
    """
    if as_json:
        problems = {name: _summary(m) for name, m in models}
        catalogue = [
            {"name": e.name, "about": _first_line(e.doc), "on": e.on, "formula": e.formula}
            for e in effects
        ]
        motion = {
            name: {
                "about": _about(d),
                "signals": [s.name for s in d.signals],
                "states": [s.name for s in d.states],
            }
            for name, d in moving
        }
        of_motion = [dict(zip(("name", "on", "formula"), e, strict=True)) for e in motion_effects]
        content = {"problems": problems, "motion": motion, "effects": catalogue}
        return json.dumps({**content, "motion_effects": of_motion}, indent=2)
    lines = ["Problems (casest calibrate NAME DATA):"]
    for name, m in models:
        lines += ["", f"  {name}", _under(_about(m), "")]
        for word, symbols in (
            ("signals", m.signals),
            ("unknowns", m.parameters),
            ("constants", m.constants),
        ):
            lines.append(_under(", ".join(s.name for s in symbols), f"{word + ':':<11}"))
        solvers = ", ".join([*SOLVERS, *(n for n, _ in m.estimators)])
        lines.append(_under(solvers, f"{'solvers:':<11}"))
    if moving:
        lines += ["", "In motion (casest observe NAME DATA, casest filter NAME DATA):"]
    for name, d in moving:
        lines += ["", f"  {name}", _under(_about(d), "")]
        lines.append(_under(", ".join(s.name for s in d.signals), "signals:   "))
        lines.append(_under(", ".join(s.name for s in d.states), "states:    "))
    lines += ["", "Your own: casest calibrate file.py[:name] DATA"]
    if effects:
        lines += ["", "Effects that `casest close` looks for:"]
    for e in effects:
        lines.append(
            textwrap.fill(f"  {e.name}: {_first_line(e.doc)}", WIDTH, subsequent_indent=" " * 6)
        )
    if motion_effects:
        lines += ["", "Effects that it looks for in motion, on every signal that they fit:"]
    for name, on, formula in motion_effects:
        words = f"  {name} of {on}: {formula}"
        lines.append(textwrap.fill(words, WIDTH, subsequent_indent=" " * 6))
    return "\n".join(lines)


def _about(declared: Model | Dynamics) -> str:
    return _first_line((declared.function.__doc__ or "").strip())


def _under(text: str, head: str) -> str:
    """A wrapped line under a problem's name, what it is in front."""
    indent = " " * 6
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=indent + head,
        subsequent_indent=indent + " " * len(head),
        break_on_hyphens=False,
    )


def _first_line(text: str) -> str:
    return text.partition("\n")[0]


def _summary(m: Model) -> dict[str, Any]:
    return {
        "about": _about(m),
        "signals": [s.name for s in m.signals],
        "parameters": [p.name for p in m.parameters],
        "constants": {c.name: c.array.tolist() for c in m.constants},
        "estimators": [n for n, _ in m.estimators],
    }


def calibration_text(found: Estimate, content: Mapping[str, Any], output: Path | None) -> str:
    """Verdict, values with uncertainty, what was not determined, why it is believed."""
    from casest.results.calibration import doubt_sentence

    doubt = content["misfit"]
    notes = [*([doubt_sentence(doubt)] if doubt else []), *content["notes"]]
    blocks = [_head(found, content), *_wrapped_notes(notes)]
    blocks.append("\n".join(value_table(found)))
    blocks.append("\n".join(held(found, content)))
    blocks.append("\n".join(_fit_lines(found, content)))
    blocks += _determined(found)
    title = "Believed because" if found.certificate.trusted else "Refused because"
    blocks.append("\n".join([f"{title}:", *(item(r) for r in found.certificate.reasons)]))
    blocks += _written(found, content, output)
    return "\n\n".join(b for b in blocks if b)


def _head(found: Estimate, content: Mapping[str, Any]) -> str:
    samples = sum(len(run) for run in found.problem.runs)
    what = "rest intervals" if found.problem.runs[0].spread else "samples"
    verdict = "trusted" if found.certificate.trusted else "NOT TRUSTED"
    if content["misfit"]:
        verdict += ", but the residual is not noise"
    files = ", ".join(file_name(name) for name in content["data"])
    line = (
        f"{found.model.name} on {files}: {samples} {what}, "
        f"{found.identifiability.unknowns} unknowns, rank {found.identifiability.rank}: {verdict}"
    )
    return textwrap.fill(line, WIDTH)


def _wrapped_notes(notes: Sequence[str]) -> Iterator[str]:
    if notes:
        yield "\n".join(item(note) for note in notes)


def item(text: str) -> str:
    """A point of a list, wrapped."""
    return textwrap.fill(text, WIDTH, initial_indent="  - ", subsequent_indent="    ")


def entry_rows(
    found: Estimate, *numbers: Mapping[str, Array]
) -> Iterator[tuple[str, str, list[float]]]:
    """Name (with its run, if there are several), unit and numbers of each entry of a parameter."""
    known = unit_table(found.model, found.problem.runs)
    known = {n: u for n, u in known.items() if "[" not in n}
    for p in found.model.parameters:
        units = entry_units(p, known)
        several = found.values[p.name].ndim > len(p.shape.dims)
        for r in range(len(found.values[p.name]) if several else 1):
            run = f" ({found.problem.runs[r].name})" if several else ""
            own = [of[p.name][r] if several else of[p.name] for of in numbers]
            for name, i, unit in zip(p.entry_names, p.shape.entries, units, strict=True):
                yield name + run, "" if unit == "1" else unit, [float(v[i]) for v in own]


def value_table(found: Estimate) -> Iterator[str]:
    """One line per value: name, value ± standard deviation, unit."""
    entries = entry_rows(found, found.values, found.std)
    rows = [(name, *rounded(v, s), unit) for name, unit, (v, s) in entries]
    width = max(len(r[0]) for r in rows)
    left = max(len(r[1]) for r in rows)
    middle = max(len(r[2]) for r in rows)
    yield f"  {'parameter':<{width}}  {'value':>{left}}   {'std':<{middle}}  unit"
    for name, value_text, std_text, unit in rows:
        yield f"  {name:<{width}}  {value_text:>{left}} ± {std_text:<{middle}}  {unit}".rstrip()


def held(found: Estimate, content: Mapping[str, Any]) -> Iterator[str]:
    """Constants, and parameters held at a value: as much a part of the answer as the unknowns."""
    fixed = False
    for c in found.model.constants:
        unit = content["units"].get(c.name, "")
        value = in_digits(c.array, 9)
        fixed = fixed or c.frozen is not None
        line = f"  {c.name} = {value} {'' if unit == '1' else unit}".rstrip() + " (held)"
        yield textwrap.fill(line, WIDTH, subsequent_indent="      ", break_on_hyphens=False)
    if fixed:
        yield "  (the uncertainty of held values is not in the standard deviations above)"


def rounded(value: float, std: float) -> tuple[str, str]:
    """Value and standard deviation to two digits of the latter, as a metrologist writes them."""
    if not np.isfinite(std):
        return "–", "not determined"
    if std <= 1e-15 * abs(value):  # below what a double holds
        return f"{value:.9g}", f"{std:.1g}"
    digits = 1 - int(np.floor(np.log10(std)))
    if -6 <= digits <= 9 and abs(value) < 1e7:
        places = max(digits, 0)
        return f"{value:.{places}f}", f"{std:.{places}f}"
    exponent = int(np.floor(np.log10(max(abs(value), std))))
    places = max(exponent + digits, 0)
    return f"{value:.{places}e}", f"{std:.1e}"


def _fit_lines(found: Estimate, content: Mapping[str, Any]) -> Iterator[str]:
    unit = content["noise"]["unit"]
    unit = "" if unit == "1" else f" {unit}"
    sigma = found.noise.sigma
    yield f"  residual rms {found.rmse:.3g}{unit}; noise of one residual {sigma:.3g}{unit}"
    if content["estimate"]["rmse_holdout"] is not None:
        yield f"  held-out residual rms {content['estimate']['rmse_holdout']:.3g}{unit}"
    repeats, residual = found.noise.repeats, found.noise.residual
    if repeats and np.isfinite(residual) and residual > 2 * repeats and not content["misfit"]:
        yield item(
            f"the residual is {residual / repeats:.1f} times what the scatter within the rest "
            f"intervals explains ({repeats:.2g}{unit}): the model lacks something; the standard "
            "deviations above include that misfit as if it were noise"
        )
    if "seconds" in found.extra:
        ratio = found.extra["least_squares_seconds"] / found.extra["seconds"]
        yield "  (standard deviations are those of the least-squares solution)"
        yield (
            f"  {found.extra['estimator']} took {1e3 * found.extra['seconds']:.2g} ms; the "
            f"least-squares solution {ratio:.0f} times as long"
        )


def _determined(found: Estimate) -> Iterator[str]:
    if found.identifiability.unobservable and found.certificate.trusted:
        lines = [item(words) for words in found.identifiability.unobservable]
        yield "\n".join(["These data do not determine:", *lines])
    if found.weak:
        worst = sorted(found.weak, key=lambda w: -w.inflation)[:3]
        lines = [item(f"{w.words}: {w.inflation:.0f} times worse than each alone") for w in worst]
        if len(found.weak) > 3:
            lines.append(f"  - and {len(found.weak) - 3} more, in result.json")
        yield "\n".join(["Weakly determined (one standard deviation of the combination):", *lines])
    if found.identifiability.rank == found.identifiability.unknowns and not found.weak:
        yield "The data determine every unknown; no weak combination."


def _written(found: Estimate, content: Mapping[str, Any], output: Path | None) -> Iterator[str]:
    """Files written, and what to type next."""
    if output is not None:
        yield f"Written: {output}/report.html, result.json, residuals.csv"
    yield following(
        content["reproduce"]["command"],
        output,
        trusted=found.certificate.trusted,
        doubtful=bool(content["misfit"]),
        applies=found.model.traced.corrected is not None,
    )
