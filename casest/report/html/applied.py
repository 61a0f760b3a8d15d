"""How to apply a result: what goes in, what is done in which order, what comes out, with units."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca

from casest.correction.inverse import LEFT, Correction, invertible
from casest.declaration.model import Model
from casest.declaration.tracing import trace
from casest.errors import CasestError
from casest.report.html.numbers import printed_unit
from casest.report.html.page import details, escaped, paragraph, points, section, tag
from casest.report.html.story import Story
from casest.report.next_command import applying, typed_words
from casest.results.closing import formula_of

#: Longer formulas are left to the declaration.
READABLE = 240


def application(story: Story, content: Mapping[str, Any], folder: str) -> str:
    """What goes in, what is done to it in which order, what comes out, with units."""
    model = story.last.model
    said = []
    if not content["trusted"]:
        said.append(paragraph("Do not apply it: the estimate was refused."))
    said += (
        _steps(model, story.units, content["reproduce"]["command"], folder)
        if content["trusted"]
        else []
    )
    said.append(tag("h3", "Conventions"))
    words = inspect.getdoc(model.function) or "The declaration says nothing beside its formulas."
    said += [paragraph(part.replace("\n", " ")) for part in words.split("\n\n")]
    if model.effects and content["trusted"]:
        said.append(
            paragraph("So the declaration has it, without the added effects, which are told above.")
        )
    if any(s.name == "t" for s in model.signals):
        said.append(
            paragraph("t = 0 is the first sample of each run unless the column said otherwise.")
        )
    code = textwrap.dedent(inspect.getsource(model.function)) if _has_source(model) else ""
    if code:
        source = tag("pre", tag("code", escaped(code)))
        said.append(details("The model as it was declared", source))
    return section("apply", "How to apply the result", *said)


def _has_source(model: Model) -> bool:
    try:
        return bool(inspect.getsource(model.function))
    except (OSError, TypeError):
        return False


def _steps(model: Model, units: Mapping[str, str], typed: str, folder: str) -> list[str]:
    """The correction's order of operations, and the command."""
    try:
        model, left = invertible(model)
        correction = Correction(model)
        signals, needed, name = correction.signals, correction.parameters, correction.name
    except CasestError as error:
        return [paragraph(str(error))]
    into = ", ".join(f"`{s.name}` ({_size(s.size)}{_in(units, s.name)})" for s in signals)
    used = ", ".join(f"`{p.name}`" for p in model.parameters if p.name in needed)
    steps = [f"Bring the readings to these units and this order of components: {into}."]
    if model.implicit:
        chain = [name]
        steps.append(f"Compute `{name}` from them with {used}.")
    else:
        chain = _chain(model, name)
        steps.append(
            f"Go back from the reading to `{name}` with {used}: the model computes "
            f"{' → '.join(f'`{q}`' for q in chain)}; undo that from right to left."
        )
        inside = [a for a in model.effects if a.on in chain]
        if inside:
            effects = "; ".join(
                f"`{a.label}` makes `{a.on}` {formula_of(a).rstrip('.')}" for a in inside
            )
            steps.append(f"On the way each added effect is undone where it acts: {effects}.")
    if left:
        steps.append(f"{LEFT.capitalize()}{', '.join(f'`{label}`' for label in left)}.")
    steps.append(f"The result is `{name}`, {_size(correction.size)}{_in(units, name)}.")
    command = tag("pre", tag("code", escaped(_command(typed, folder))))
    lines = "\n".join(formulas(model, chain if model.implicit else chain[1:]))
    shown = tag("pre", tag("code", escaped(lines))) if lines else ""
    said = paragraph("In one command, with all digits of the values:")
    return [shown, points([*steps, *_elsewhere(model, chain)], "ol"), said, command]


def _command(typed: str, folder: str) -> str:
    words = typed_words(typed)
    line = applying(words, folder).lines() if words else f"casest apply {folder} DATA"
    return textwrap.dedent(line)


def _elsewhere(model: Model, chain: list[str]) -> Iterator[str]:
    """Effects that the correction need not undo."""
    other = [a for a in model.effects if a.on not in chain and a.on != model.traced.measured]
    if other and not model.implicit:
        names = ", ".join(f"`{a.label}` on `{a.on}`" for a in other)
        yield f"Nothing is to be undone for {names}: what it acts on lies before the correction."


def formulas(model: Model, names: list[str]) -> Iterator[str]:
    """Each component of the named quantities as the model computes it, where that is readable."""
    quantities = trace(model, naming=True).quantities
    entries = {
        f"{p.name}_{k}": name for p in model.parameters for k, name in enumerate(p.entry_names)
    }
    for name in names:
        found = quantities[name]
        value = ca.vec(ca.SX(found.value if model.implicit else found.declared))
        for k in range(value.numel()):
            text = re.sub(r"[A-Za-z_][\w.]*", lambda m: _entry(m[0], entries), str(value[k]))
            label = f"{name}[{k}]" if value.numel() > 1 else name
            if "@" not in text and len(text) <= READABLE:
                yield f"{label} = {_without_outer(text).replace('*', '·')}"


def _without_outer(text: str) -> str:
    """The formula without the parentheses that enclose all of it."""
    depth = 0
    for k, sign in enumerate(text):
        depth += (sign == "(") - (sign == ")")
        if depth == 0 and k < len(text) - 1:
            return text
    return text[1:-1] if text.startswith("(") else text


def _entry(word: str, entries: Mapping[str, str]) -> str:
    """A symbol as a person writes it: `v_0` as v[0]."""
    return entries.get(word) or re.sub(r"_(\d+)$", r"[\1]", word)


def _chain(model: Model, corrected: str) -> list[str]:
    """Quantities from the corrected one to the reading, in the order of the body."""
    names = list(model.quantities)
    return names[names.index(corrected) :] if corrected in names else [corrected]


def _size(size: int) -> str:
    return "one number" if size == 1 else f"{size} numbers"


def _in(units: Mapping[str, str], name: str) -> str:
    unit = printed_unit(units.get(name, ""))
    article = "the " if unit.startswith("unit of") else ""
    return f" in {article}{unit}" if unit and unit != "1" else ""
