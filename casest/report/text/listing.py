"""What `casest list` prints: a paragraph for each problem, a line for each effect."""

from __future__ import annotations

import json
import textwrap

from msgspec import to_builtins

from casest.report.text.layout import WIDTH
from casest.results.listing import Listing


def listing_text(listed: Listing, *, as_json: bool = False) -> str:
    """Shipped problems and estimators in motion, a paragraph each; a line for each effect."""
    if as_json:
        return json.dumps(to_builtins(listed), indent=2)
    lines = ["Problems (casest calibrate NAME DATA):"]
    for name, m in listed.problems.items():
        lines += ["", f"  {name}", _under([m.about], "")]
        lines.append(_under(m.signals, "signals:   "))
        lines.append(_under(m.parameters, "unknowns:  "))
        if m.constants:
            lines.append(_under(list(m.constants), "constants: "))
        lines.append(_under(m.solvers, "solvers:   "))
    lines += ["", "In motion (casest observe NAME DATA, casest filter NAME DATA):"]
    for name, d in listed.motion.items():
        lines += ["", f"  {name}", _under([d.about], "")]
        lines.append(_under(d.signals, "signals:   "))
        lines.append(_under(d.states, "states:    "))
    lines += ["", "Your own: casest calibrate file.py[:name] DATA"]
    lines += ["", "Effects that `casest close` looks for:"]
    lines += [_line(f"{e.name}: {e.about}") for e in listed.effects]
    lines += ["", "Effects that it looks for in motion, on every signal that they fit:"]
    lines += [_line(f"{e.name} of {e.on}: {e.formula}") for e in listed.motion_effects]
    return "\n".join(lines)


def _line(text: str) -> str:
    return textwrap.fill(f"  {text}", WIDTH, subsequent_indent=" " * 6)


def _under(names: list[str], head: str) -> str:
    """A wrapped line under a problem's name, what it is in front."""
    indent = " " * 6
    return textwrap.fill(
        ", ".join(names),
        WIDTH,
        initial_indent=indent + head,
        subsequent_indent=indent + " " * len(head),
        break_on_hyphens=False,
    )
