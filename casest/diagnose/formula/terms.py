"""Terms that a formula may have: simple functions of what is recorded, written as an effect."""

from __future__ import annotations

import keyword
import linecache
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, count
from typing import Any

import numpy as np

from casest.declaration.effect import Effect

#: Names that the text of an effect uses itself.
_TAKEN = frozenset(
    [
        "vertcat",
        "cos",
        "sin",
        "exp",
        "tanh",
        "fabs",
        "effect",
        "param",
        "signal",
        "constant",
        "formula",
    ]
)
_FILES = count(1)
#: Multiples of an angle, and shapes of one variable: kind and order.
MULTIPLES = range(1, 9)
SHAPES = (("power", 1), ("power", 2), ("power", 3), ("abs", 1), ("exp", 2), ("exp", -2),
          ("tanh", 1), ("tanh", 3))  # fmt: skip


@dataclass(frozen=True)
class Variable:
    """What a term reads: a column, time, or a component (`index`, if it has several) of a quantity.

    Shapes are of z = (x − centre)/half, which lies in [−1, 1]. `own`: every axis of the output
    reads its own component. `angle`: x is in rad, and goes round more than once: nothing but a
    clock, except for its sine.
    """

    name: str
    index: int | None
    unit: str
    centre: float
    half: float
    angle: bool = False
    own: bool = False

    @property
    def label(self) -> str:
        """As in the formula: `force[0]`."""
        return self.name if self.index is None else f"{self.name}[{self.index}]"

    def at(self, axis: int | None) -> Variable:
        """The component that an axis of the output reads."""
        return replace(self, index=axis, own=False) if self.own else self


@dataclass(frozen=True)
class Shape:
    """One function of one or two variables: `kind` power (of degree `order`), abs, exp, tanh (of
    `order` times z), sin, cos (of `order` quarter cycles over the range, or times the angle), or
    product. Nil at z = 0, but for the cosine of an angle."""

    kind: str
    variables: tuple[Variable, ...]
    order: int = 1

    def values(self, values: Sequence[Any], m: Any = np) -> Any:
        """Of the variables' values, with the functions of `m`."""
        v, x = self.variables, list(values)
        if self.kind in ("sin", "cos") and v[0].angle:
            return getattr(m, self.kind)(self.order * x[0])
        z = [(a - b.centre) / b.half for a, b in zip(x, v, strict=True)]
        if self.kind == "product":
            return z[0] * z[1]
        if self.kind == "power":
            return z[0] ** self.order
        found = getattr(m, "fabs" if self.kind == "abs" else self.kind)(self._factor * z[0])
        return found - 1 if self._raised else found

    @property
    def _raised(self) -> bool:
        """Is the function 1 where z is 0?

        It is lowered then: declared parameters are what they are at the centre of a column, as
        beside every effect of the catalogue, and a term does not stand for an offset.
        """
        return self.kind == "exp" or (self.kind == "cos" and not self.variables[0].angle)

    @property
    def _factor(self) -> float:
        """Of z, in the function's argument."""
        wave = self.kind in ("sin", "cos") and not self.variables[0].angle
        return round(self.order * np.pi / 4, 6) if wave else float(self.order)

    def written(self, words: Sequence[str], python: bool) -> str:
        """Of the words for x of the angle, else for z."""
        if self.kind == "product":
            return (" * " if python else "·").join(words)
        if self.kind == "power":
            power = "**" if python else "^"
            return words[0] + (f"{power}{self.order}" if self.order > 1 else "")
        inner = words[0][1:-1] if words[0].startswith("(") else words[0]
        if self.kind == "abs":
            return f"fabs({inner})" if python else f"|{inner}|"
        text = f"{self.kind}({self._factor:g}{' * ' if python else '·'}{words[0]})"
        if self._factor == 1:
            text = f"{self.kind}({inner})"
        return f"({text} {'-' if python else '−'} 1)" if self._raised else text


@dataclass(frozen=True)
class Term:
    """A shape on one axis of the output (None: the output is a scalar)."""

    shape: Shape
    axis: int | None

    @property
    def variables(self) -> tuple[Variable, ...]:
        """What it reads on this axis."""
        return tuple(v.at(self.axis) for v in self.shape.variables)


def library(variables: Sequence[Variable]) -> list[Shape]:
    """Powers 1 to 3, size, exponentials, saturation of each; sines of angles; products of two."""
    straight = [v for v in variables if not v.angle]
    found = [Shape(kind, (v,), k) for v in straight for kind, k in SHAPES]
    found += [
        Shape(kind, (v,), k)
        for v in variables
        if v.angle
        for k in MULTIPLES
        for kind in ("sin", "cos")
    ]
    return found + [Shape("product", pair) for pair in combinations(straight, 2)]


# -- the effect --------------------------------------------------------------------------------


def formula_effect(terms: Sequence[Term], size: int, on: str, unit: str) -> Effect:
    """The effect that adds k1·(first term) + k2·… to the quantity `on` of `size` numbers.

    It is run from the very text that `source` gives; `unit` is that of the quantity.
    """
    names = _arguments(terms, on)
    text = _text(terms, size, on, unit, names)
    file = f"<formula {next(_FILES)}>"
    scope: dict[str, Any] = {"__name__": file}
    exec(compile(text, file, "exec"), scope)
    # Reports print the body of an effect: so let it be found.
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    made: Effect = scope["formula"]
    by_argument = {argument: name for name, argument in names.items()}
    extras = tuple(replace(s, name=by_argument[s.name]) for s in made.extras)
    return replace(made, extras=extras, formula=formula_text(terms, on, unit), source=text)


def formula_text(
    terms: Sequence[Term], on: str, unit: str, sizes: Sequence[float] | None = None
) -> str:
    """`reading[1] += 0.0131 m/s^2·((temperature − 25.1 degC)/8.2 degC)^2`; k1 … without sizes."""
    unit = f" {unit}" if unit else ""
    lines = []
    for k, term in enumerate(terms):
        axis = "" if term.axis is None else f"[{term.axis}]"
        factor = f"k{k + 1}" if sizes is None else f"{sizes[k]:.3g}{unit}"
        words = [v.label if v.angle else _scaled_text(v) for v in term.variables]
        lines.append(f"{on}{axis} += {factor}·{term.shape.written(words, python=False)}")
    return "; ".join(lines)


def source(effect: Effect) -> str:
    """Python text that defines the same effect: to be put into a file for `--effects`.

    Empty for an effect that is no formula.
    """
    if not effect.source:
        return ""
    head, tail = effect.source.split('formula=""', 1)
    return f"{head}formula={effect.formula!r}{tail}"


def _scaled_text(v: Variable) -> str:
    unit = f" {v.unit}" if v.unit else ""
    if not v.centre:
        return f"({v.label}/{v.half:g}{unit})"
    sign = "−" if v.centre > 0 else "+"
    return f"(({v.label} {sign} {abs(v.centre):g}{unit})/{v.half:g}{unit})"


def _arguments(terms: Sequence[Term], on: str) -> dict[str, str]:
    """The argument for each name that is read, in order; the output itself first."""
    names: dict[str, str] = {}
    for name in (on, *(v.name for term in terms for v in term.variables)):
        if name not in names:
            names[name] = _identifier(name, set(names.values()) | _TAKEN)
    return names


def _identifier(name: str, taken: set[str]) -> str:
    """The name as Python can have it, and reads it back: m² and µ are no part of one."""
    found = re.sub(r"\W", "_", name, flags=re.ASCII)
    found = found if found.isidentifier() else f"_{found}"
    while found in taken or keyword.iskeyword(found) or re.fullmatch(r"k\d+", found):
        found += "_"
    return found


def _text(terms: Sequence[Term], size: int, on: str, unit: str, names: Mapping[str, str]) -> str:
    rows: list[list[str]] = [[] for _ in range(size)]
    numbers: dict[str, str] = {}
    for k, term in enumerate(terms):
        words = [_z(v, names, numbers) for v in term.variables]
        rows[term.axis or 0].append(f"k{k + 1} * {term.shape.written(words, python=True)}")
    sums = [" + ".join(row) or "0" for row in rows]
    column = ",\n        ".join(sums)
    added = f"vertcat(\n        {column},\n    )" if size > 1 else sums[0]
    units = {v.name: v.unit for term in terms for v in term.variables}
    extras = [(n, a) for n, a in names.items() if n != on]
    read = [names[on], *(a for n, a in extras if not units[n])]
    read += [f"{a}=signal({units[n]!r})" for n, a in extras if units[n]]
    unknowns = [f"k{k + 1}=param({unit!r})" for k in range(len(terms))]
    numbered = [f"{n}={value}" for n, value in numbers.items()]
    arguments = ",\n    ".join([*read, "*", *unknowns, *numbered])
    renamed = [
        f"# {a} stands for the column {n!r}: give the column this name, or --columns {a}=…\n"
        for n, a in names.items()
        if n not in (on, a)
    ]
    once = ', once="stayed"' if "t" in units else ""
    return (
        "from casest import constant, cos, effect, exp, fabs, param, signal, sin, tanh, vertcat\n"
        "\n\n" + "".join(renamed) + f'@effect(on={on!r}, formula=""{once})\n'
        f"def formula(\n    {arguments},\n):\n"
        '    """Terms outside the catalogue, found in the residual."""\n'
        f"    return {names[on]} + {added}\n"
    )


def _z(v: Variable, names: Mapping[str, str], numbers: dict[str, str]) -> str:
    """The variable in Python, scaled; its centre and half width are added to the numbers."""
    own = "" if v.index is None else f"_{v.index}"
    name, x = names[v.name] + own, names[v.name] + ("" if v.index is None else f"[{v.index}]")
    if v.angle:
        return x
    unit = f", {v.unit!r}" if v.unit else ""
    numbers[f"{name}_half"] = f"constant({v.half!r}{unit})"
    if not v.centre:
        return f"({x} / {name}_half)"
    numbers[f"{name}_centre"] = f"constant({v.centre!r}{unit})"
    return f"(({x} - {name}_centre) / {name}_half)"


__all__ = [
    "Shape",
    "Term",
    "Variable",
    "formula_effect",
    "formula_text",
    "library",
    "source",
]
