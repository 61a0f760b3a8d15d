"""What `casest list` prints: shipped models, estimators in motion, the catalogue of effects."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from typing import Any

from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.dynamics import Dynamics
from casest.report.text.layout import WIDTH
from casest.solve.strategy import SOLVERS


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
