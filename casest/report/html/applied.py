"""How to apply a result: what goes in, what is done in which order, what comes out, with units."""

from __future__ import annotations

import re
import textwrap

from casest.report.html.numbers import printed_unit
from casest.report.html.page import code_block, details, paragraph, points, section, tag
from casest.report.next_command import applying, typed_words
from casest.results.application import Steps
from casest.results.fitted import Fitted


def application(result: Fitted, folder: str) -> str:
    """What goes in, what is done to it in which order, what comes out, with units."""
    how, said = result.application, []
    if not result.trusted:
        said.append(paragraph("Do not apply it: the estimate was refused."))
    elif isinstance(how.steps, str):
        said.append(paragraph(how.steps))
    else:
        said += _steps(how.steps, result.reproduce.command, folder)
    said.append(tag("h3", "Conventions"))
    words = how.conventions or "The declaration says nothing beside its formulas."
    said += [paragraph(part.replace("\n", " ")) for part in words.split("\n\n")]
    if how.extended and result.trusted:
        said.append(
            paragraph("So the declaration has it, without the added effects, which are told above.")
        )
    if how.timed:
        said.append(
            paragraph("t = 0 is the first sample of each run unless the column said otherwise.")
        )
    if how.source:
        source = code_block(how.source)
        said.append(details("The model as it was declared", source))
    return section("apply", "How to apply the result", *said)


def _steps(how: Steps, typed: str, folder: str) -> list[str]:
    """The correction's order of operations, and the command."""
    name, size, unit = how.result
    into = ", ".join(f"`{n}` ({_size(count)}{_in(u)})" for n, count, u in how.signals)
    used = ", ".join(f"`{p}`" for p in how.parameters)
    steps = [f"Bring the readings to these units and this order of components: {into}."]
    if how.implicit:
        steps.append(f"Compute `{name}` from them with {used}.")
    else:
        steps.append(
            f"Go back from the reading to `{name}` with {used}: the model computes "
            f"{' → '.join(f'`{q}`' for q in how.chain)}; undo that from right to left."
        )
        if how.undone:
            effects = "; ".join(
                f"`{label}` makes `{on}` {formula.rstrip('.')}" for label, on, formula in how.undone
            )
            steps.append(f"On the way each added effect is undone where it acts: {effects}.")
    if how.left:
        steps.append(f"{how.left[0].upper()}{how.left[1:]}.")
    steps.append(f"The result is `{name}`, {_size(size)}{_in(unit)}.")
    if how.elsewhere:
        names = ", ".join(f"`{label}` on `{on}`" for label, on in how.elsewhere)
        before = "what it acts on lies before the correction"
        steps.append(f"Nothing is to be undone for {names}: {before}.")
    shown = code_block("\n".join(how.formulas)) if how.formulas else ""
    said = paragraph("In one command, with all digits of the values:")
    command = code_block(_command(typed, folder))
    return [shown, points(steps, "ol"), said, command]


def _command(typed: str, folder: str) -> str:
    words = typed_words(typed)
    line = applying(words, folder).lines() if words else f"casest apply {folder} DATA"
    return textwrap.dedent(line)


def _size(size: int) -> str:
    return "one number" if size == 1 else f"{size} numbers"


def _in(unit: str) -> str:
    unit = printed_unit(unit)
    unstated = f", the unit of {unit[1:-1]}" if re.fullmatch(r"\[[^\[\]]+\]", unit) else ""
    return f" in {unit}{unstated}" if unit and unit != "1" else ""
