"""Terms that a formula may have: simple functions of what is recorded, written as an effect."""

from __future__ import annotations

import keyword
import linecache
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, count
from typing import Any

import casadi as ca

from casest.declaring.physics import SX
from casest.modelling.effect import Effect

#: Names that the text of an effect uses itself.
_TAKEN = frozenset("y vertcat cos sin fabs effect param signal formula".split())
_FILES = count(1)


@dataclass(frozen=True)
class Variable:
    """What a term reads: a column, time, or a component (`index`, if it has several) of a quantity.

    Powers and products are of (x − centre)/half, which lies in [−1, 1]. `angle`: x is in rad;
    `winding`: it goes round more than once, and is then nothing but a clock, except for its sine.
    """

    name: str
    index: int | None
    unit: str
    centre: float
    half: float
    angle: bool = False
    winding: bool = False

    @property
    def label(self) -> str:
        """As in the formula: `force[0]`."""
        return self.name if self.index is None else f"{self.name}[{self.index}]"

    def scaled(self, x: Any) -> Any:
        """(x − centre)/half."""
        return (x - self.centre) / self.half


@dataclass(frozen=True)
class Shape:
    """One function of one or two variables: `kind` power (of degree `order`), abs, sin, cos
    (of `order` times the angle) or product."""

    kind: str
    variables: tuple[Variable, ...]
    order: int = 1

    def expression(self, values: Sequence[SX]) -> SX:
        """In symbols."""
        if self.kind in ("sin", "cos"):
            return getattr(ca, self.kind)(self.order * values[0])
        scaled = [v.scaled(x) for v, x in zip(self.variables, values, strict=True)]
        if self.kind == "abs":
            return ca.fabs(scaled[0])
        return scaled[0] * scaled[1] if self.kind == "product" else scaled[0] ** self.order

    def code(self, names: Mapping[str, str]) -> str:
        """In Python, `names` giving each variable's argument."""
        if self.kind in ("sin", "cos"):
            return f"{self.kind}({self.order} * {_argument(self.variables[0], names)})"
        parts = [_scaled_code(v, names) for v in self.variables]
        if self.kind == "abs":
            return f"fabs({parts[0]})"
        return " * ".join(parts) + (f"**{self.order}" if self.order > 1 else "")

    @property
    def text(self) -> str:
        """For a reader, with units."""
        if self.kind in ("sin", "cos"):
            return f"{self.kind}({self.order}·{self.variables[0].label})"
        parts = [_scaled_text(v) for v in self.variables]
        if self.kind == "abs":
            return f"|{parts[0]}|"
        return "·".join(f"({p})" for p in parts) + (f"^{self.order}" if self.order > 1 else "")


@dataclass(frozen=True)
class Term:
    """A shape on one axis of the output (None: the output is a scalar)."""

    shape: Shape
    axis: int | None

    @property
    def reads(self) -> frozenset[str]:
        """Labels of what it reads."""
        return frozenset(v.label for v in self.shape.variables)


def library(variables: Sequence[Variable]) -> list[Shape]:
    """Powers 1 to 3 and the size, sines of 3 to 8 times an angle, products of two variables."""
    straight = [v for v in variables if not v.winding]
    found = [Shape("power", (v,), k) for v in straight for k in (1, 2, 3)]
    found += [Shape("abs", (v,)) for v in straight]
    found += [
        Shape(kind, (v,), k)
        for v in variables
        if v.angle
        for k in range(3, 9)
        for kind in ("sin", "cos")
    ]
    return found + [Shape("product", pair) for pair in combinations(straight, 2)]


def _argument(v: Variable, names: Mapping[str, str]) -> str:
    return names[v.name] if v.index is None else f"{names[v.name]}[{v.index}]"


def _off(centre: float) -> str:
    return f" {'-' if centre > 0 else '+'} {abs(centre)!r}" if centre else ""


def _scaled_code(v: Variable, names: Mapping[str, str]) -> str:
    off = _off(v.centre)
    argument = _argument(v, names)
    return f"(({argument}{off}) / {v.half!r})" if off else f"({argument} / {v.half!r})"


def _scaled_text(v: Variable) -> str:
    unit = f" {v.unit}" if v.unit else ""
    if not v.centre:
        return f"{v.label}/{v.half:g}{unit}"
    sign = "−" if v.centre > 0 else "+"
    return f"({v.label} {sign} {abs(v.centre):g}{unit})/{v.half:g}{unit}"


# -- the effect --------------------------------------------------------------------------------


def formula_effect(terms: Sequence[Term], size: int, on: str, unit: str) -> Effect:
    """The effect that adds k1·(first term) + k2·… to the quantity `on` of `size` numbers.

    It is run from the very text that `source` gives.
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
    made.function.source = text  # type: ignore[attr-defined]
    return replace(made, extras=extras, formula=formula_text(terms, on, unit))


def formula_text(
    terms: Sequence[Term], on: str, unit: str, sizes: Sequence[float] | None = None
) -> str:
    """`reading[1] += 0.0131 m/s^2·((temperature − 25.1 degC)/8.2 degC)^2`; k1 … without sizes."""
    unit = f" {unit}" if unit else ""
    lines = []
    for k, term in enumerate(terms):
        axis = "" if term.axis is None else f"[{term.axis}]"
        factor = f"k{k + 1}" if sizes is None else f"{sizes[k]:.3g}{unit}"
        lines.append(f"{on}{axis} += {factor}·{term.shape.text}")
    return "; ".join(lines)


def source(effect: Effect) -> str:
    """Python text that defines the same effect: to be put into a file for `--effects`."""
    text: str = effect.function.source  # type: ignore[attr-defined]
    head, tail = text.split('formula=""', 1)
    return f"{head}formula={effect.formula!r}{tail}"


def _arguments(terms: Sequence[Term], on: str) -> dict[str, str]:
    """The argument for each name that is read, in order; the output itself is y."""
    names: dict[str, str] = {on: "y"}
    for term in terms:
        for v in term.shape.variables:
            if v.name not in names:
                names[v.name] = _identifier(v.name, set(names.values()) | _TAKEN)
    return names


def _identifier(name: str, taken: set[str]) -> str:
    """The name as Python can have it."""
    found = re.sub(r"\W", "_", name)
    found = found if found.isidentifier() else f"_{found}"
    while found in taken or keyword.iskeyword(found) or re.fullmatch(r"k\d", found):
        found += "_"
    return found


def _text(
    terms: Sequence[Term], size: int, on: str, unit: str, names: Mapping[str, str]
) -> str:
    rows: list[list[str]] = [[] for _ in range(size)]
    for k, term in enumerate(terms):
        rows[term.axis or 0].append(f"k{k + 1} * {term.shape.code(names)}")
    sums = [" + ".join(row) or "0" for row in rows]
    column = ",\n        ".join(sums)
    added = f"vertcat(\n        {column},\n    )" if size > 1 else sums[0]
    read = [a for n, a in names.items() if n not in (on, "t")]
    read += [f'{names["t"]}=signal("s")'] if "t" in names else []
    unknowns = [f"k{k + 1}=param({unit!r})" for k in range(len(terms))]
    arguments = ",\n    ".join(["y", *read, "*", *unknowns])
    renamed = [
        f"# {a} stands for the column {n!r}: give the column this name\n"
        for n, a in names.items()
        if n not in (on, a)
    ]
    return (
        "from casest import cos, effect, fabs, param, signal, sin, vertcat\n\n\n"
        + "".join(renamed)
        + f'@effect(on={on!r}, formula="")\n'
        f"def formula(\n    {arguments},\n):\n"
        '    """Terms outside the catalogue, found in the residual."""\n'
        f"    return y + {added}\n"
    )
