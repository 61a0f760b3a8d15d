"""How a model's correction is applied: what goes in, what is undone in which order, what comes out.

It is read from the model's formulas as they are traced, and from its declaration's own words.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from casest.correction.inverse import LEFT, Correction, invertible
from casest.declaration.effect import Attached
from casest.declaration.model import Model
from casest.declaration.symbols import Constant
from casest.declaration.tracing import trace
from casest.errors import CasestError

#: Longer formulas are left to the declaration.
READABLE = 240


@dataclass(frozen=True)
class Steps:
    """The correction: signals and result with their sizes and units, and the way from one to the
    other.

    `chain`: quantities from the corrected one to the reading (it alone, where an implicit model
    computes it); `undone`: effects within it with what they act on and do; `elsewhere`: those that
    lie before it; `left`: what is said of those that it leaves; `formulas`: of the chain.
    """

    signals: tuple[tuple[str, int, str], ...]
    parameters: tuple[str, ...]
    result: tuple[str, int, str]
    implicit: bool
    chain: tuple[str, ...]
    undone: tuple[tuple[str, str, str], ...]
    elsewhere: tuple[tuple[str, str], ...]
    left: str
    formulas: tuple[str, ...]


@dataclass(frozen=True)
class Application:
    """`steps` are text where there is no correction: why. `source` is empty where nobody has it."""

    steps: Steps | str
    conventions: str
    source: str
    extended: bool
    timed: bool


def application_of(model: Model, units: Mapping[str, str], *, trusted: bool) -> Application:
    """How to apply a fitted model; no steps where it is not trusted."""
    return Application(
        _steps(model, units) if trusted else "",
        inspect.getdoc(model.function) or "",
        _source(model),
        bool(model.effects),
        any(s.name == "t" for s in model.signals),
    )


def _source(model: Model) -> str:
    try:
        return textwrap.dedent(inspect.getsource(model.function))
    except (OSError, TypeError):
        return ""


def _steps(model: Model, units: Mapping[str, str]) -> Steps | str:
    try:
        model, left = invertible(model)
        correction = Correction(model)
        signals, needed, name = correction.signals, correction.parameters, correction.name
    except CasestError as error:
        return str(error)
    chain = [name] if model.implicit else _chain(model, name)
    inside = [] if model.implicit else [a for a in model.effects if a.on in chain]
    return Steps(
        tuple((s.name, s.size, units.get(s.name, "")) for s in signals),
        tuple(p.name for p in model.parameters if p.name in needed),
        (name, correction.size, units.get(name, "")),
        model.implicit,
        tuple(chain),
        tuple((a.label, str(a.on), formula_of(a)) for a in inside),
        tuple(_elsewhere(model, chain)),
        f"{LEFT}{', '.join(f'`{label}`' for label in left)}" if left else "",
        tuple(_formulas(model, chain if model.implicit else chain[1:])),
    )


def _chain(model: Model, corrected: str) -> list[str]:
    """Quantities from the corrected one to the reading, in the order of the body."""
    names = list(model.quantities)
    return names[names.index(corrected) :] if corrected in names else [corrected]


def _elsewhere(model: Model, chain: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Effects that the correction need not undo."""
    for a in () if model.implicit else model.effects:
        if a.on not in chain and a.on != model.traced.measured:
            yield a.label, str(a.on)


def formula_of(attached: Attached) -> str:
    """What the effect does where it is attached, its columns and numbers put in."""
    formula = attached.effect.formula or attached.effect.doc.partition("\n")[0]
    for name, column in attached.columns:
        formula = formula.replace(name, column)
    for name, declared in attached.effect.declarations:
        if isinstance(declared, Constant) and not declared.dims:
            formula = re.sub(rf"\b{name}\b", f"{float(declared.array):.6g}", formula)
    return re.sub(r"\((\w+) − 0\)|\b(\w+) − 0\b(?!\.)", r"\1\2", formula)


def _formulas(model: Model, names: Sequence[str]) -> Iterator[str]:
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
