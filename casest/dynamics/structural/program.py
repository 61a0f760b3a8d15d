"""A model as a program of rational steps: what power series modulo a prime can follow.

Sums, products and quotients are steps themselves. Another function c of w becomes a state of its
own, ċ = s·ẇ, whose slope s is rational in it and the others: exp' = exp, sin' = cos, log' = 1/w.
Where such a function begins says `Begin`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from casest.engine.graph import Graph
from casest.engine.operations import operation_of


class Inexact(Exception):
    """Why exact arithmetic does not apply to a model, for people."""


@dataclass
class Step:
    """A value: `do` is "constant", "state", "input", "add", "sub", "mul", "div" or "path".

    `operands` are numbers of other steps; of a path its slope and what it is a function of. `index`
    is that of a state or an input.
    """

    do: str
    operands: tuple[int, ...] = ()
    index: int = 0
    constant: Fraction | None = None


@dataclass(frozen=True)
class Begin:
    """Where paths begin: `kind` is "exp", "log", "circle", "angle" or "root".

    `paths` of a circle are cosine and sine of `of`; of an angle, `of` are what its cosine and sine
    are in proportion to; a root is `of` to the power `exponent`.
    """

    kind: str
    paths: tuple[int, ...]
    of: tuple[int, ...]
    exponent: Fraction = Fraction(1)


@dataclass
class Program:
    """`outputs[i]` are the steps of the i-th output of the function; `begins` by path."""

    steps: list[Step] = field(default_factory=list)
    begins: dict[int, Begin] = field(default_factory=dict)
    outputs: list[list[int]] = field(default_factory=list)
    #: The step of π: of no polynomial with rational coefficients a root, so any residue will do.
    pi: int | None = None
    _known: dict[Any, int] = field(default_factory=dict)

    # -- rational steps ------------------------------------------------------------------------

    def step(self, do: str, *operands: int, index: int = 0) -> int:
        """The number of a step, which is added where there is no equal one."""
        if do in ("add", "mul"):
            operands = tuple(sorted(operands))
        return self._once((do, operands, index), Step(do, operands, index))

    def constant(self, value: Fraction | int) -> int:
        """The number of a constant."""
        return self._once(("constant", value), Step("constant", constant=Fraction(value)))

    def number(self, value: float) -> int:
        """A constant of CasADi: as it was written, or a short fraction of π or of 1/π."""
        exact = written(value)
        if exact is not None:
            return self.constant(exact)
        for do, turns in (("mul", short(value / math.pi)), ("div", short(value * math.pi))):
            if turns is not None:
                if self.pi is None:
                    self.pi = self._add(Step("pi"))
                return self.step(do, self.constant(turns), self.pi)
        raise Inexact(f"the constant {value!r} is rounded")

    def _once(self, key: Any, step: Step) -> int:
        if key not in self._known:
            self._known[key] = self._add(step)
        return self._known[key]

    def _add(self, step: Step) -> int:
        self.steps.append(step)
        return len(self.steps) - 1

    # -- functions that are states of their own -------------------------------------------------

    def _begun(self, begin: Begin) -> None:
        for path in begin.paths:
            self.begins[path] = begin

    def _path(self, of: int) -> int:
        return self._add(Step("path", (-1, of)))

    def _sloped(self, path: int, slope: int) -> None:
        self.steps[path].operands = (slope, self.steps[path].operands[1])

    def exp(self, w: int) -> int:
        """exp(w)."""
        if ("exp", w) not in self._known:
            c = self._known["exp", w] = self._path(w)
            self._sloped(c, c)
            self._begun(Begin("exp", (c,), (w,)))
        return self._known["exp", w]

    def log(self, v: int) -> int:
        """log(v)."""
        if ("log", v) not in self._known:
            c = self._known["log", v] = self._path(v)
            self._sloped(c, self.step("div", self.constant(1), v))
            self._begun(Begin("log", (c,), (v,)))
        return self._known["log", v]

    def root(self, v: int, exponent: Fraction) -> int:
        """`v` to a constant power."""
        if exponent.denominator == 1 and 0 < exponent <= 3:
            found = v
            for _ in range(int(exponent) - 1):
                found = self.step("mul", found, v)
            return found
        key = ("root", v, exponent)
        if key not in self._known:
            c = self._known[key] = self._path(v)
            growth = self.step("div", self.constant(exponent), v)
            self._sloped(c, self.step("mul", growth, c))
            self._begun(Begin("root", (c,), (v,), exponent))
        return self._known[key]

    def circle(self, w: int) -> tuple[int, int]:
        """cos(w) and sin(w)."""
        if ("cos", w) not in self._known:
            cos, sin = self._path(w), self._path(w)
            self._known["cos", w], self._known["sin", w] = cos, sin
            self._sloped(sin, cos)
            self._sloped(cos, self.step("sub", self.constant(0), sin))
            self._begun(Begin("circle", (cos, sin), (w,)))
        return self._known["cos", w], self._known["sin", w]

    def angle(self, cos: int, sin: int) -> int:
        """The angle whose cosine and sine are in proportion to these: that of their quotient,
        and where it begins is free but for π."""
        quotient = self.step("div", sin, cos)
        if ("angle", quotient) not in self._known:
            c = self._known["angle", quotient] = self._path(quotient)
            one = self.constant(1)
            square = self.step("add", one, self.step("mul", quotient, quotient))
            self._sloped(c, self.step("div", one, square))
            self._begun(Begin("angle", (c,), (one, quotient)))
        return self._known["angle", quotient]


#: A number is taken for a fraction if numerator times denominator is at most this: one that is none
#: is as near to such a fraction as rounding about once in 10⁵ times.
HEIGHT = 1e10


def short(value: float) -> Fraction | None:
    """The fraction of small numbers that a value is but for rounding; None: it is none."""
    if not math.isfinite(value):
        return None
    largest = math.sqrt(HEIGHT / abs(value)) if value else 1.0
    found = Fraction(value).limit_denominator(max(1, int(min(largest, 1e12))))
    return found if math.isclose(float(found), value, rel_tol=4e-16) else None


def written(value: float) -> Fraction | None:
    """The fraction that a number of the model was written as; None: it must have been rounded.

    1/3 and 0.021/1440 and 9.80665 are exact, 0.8660254037844386 and 3.141592653589793 are not.
    """
    found = short(value)
    if found is not None or not math.isfinite(value):
        return found
    text = repr(value)
    digits = text.partition("e")[0].replace(".", "").replace("-", "").strip("0")
    return Fraction(text) if len(digits) <= 12 else None


def program_of(function: Any) -> Program:
    """The steps of a CasADi function of states and inputs.

    Raises Inexact where an operation or a constant is not exact.
    """
    try:
        graph = Graph(function)
    except Exception as error:
        raise Inexact(str(error)) from None
    program, place = Program(), dict[int, int]()
    for i, value in enumerate(graph.values):
        if value.kind == "constant":
            place[i] = program.number(value.constant)
        elif value.kind == "operation":
            place[i] = _rewritten(program, value.code, [place[k] for k in value.operands])
        else:
            kind = "state" if value.kind == "parameter" else "input"
            place[i] = program.step(kind, index=value.code)
    program.outputs = [
        [place[k] if k >= 0 else program.constant(0) for k in entries] for entries in graph.outputs
    ]
    return program


def _rewritten(p: Program, code: int, operands: Sequence[int]) -> int:
    a, b, name = operands[0], operands[-1], operation_of(code, "a model").name
    one = p.constant(1)
    if name in ("add", "sub", "mul", "div"):
        return p.step(name, a, b)
    found = {
        "pow": lambda: _power(p, a, b),
        "neg": lambda: p.step("sub", p.constant(0), a),
        "twice": lambda: p.step("add", a, a),
        "square": lambda: p.step("mul", a, a),
        "inverse": lambda: p.step("div", one, a),
        "sqrt": lambda: p.root(a, Fraction(1, 2)),
        "exp": lambda: p.exp(a),
        "expm1": lambda: p.step("sub", p.exp(a), one),
        "log": lambda: p.log(a),
        "log1p": lambda: p.log(p.step("add", one, a)),
        "cos": lambda: p.circle(a)[0],
        "sin": lambda: p.circle(a)[1],
        "tan": lambda: p.step("div", *p.circle(a)[::-1]),
        "atan": lambda: p.angle(one, a),
        "atan2": lambda: p.angle(b, a),
        "asin": lambda: p.angle(_other_leg(p, a), a),
        "acos": lambda: p.angle(a, _other_leg(p, a)),
        "hypot": lambda: _hypotenuse(p, a, b),
        "sinh": lambda: p.step("div", _odd(p, a), p.constant(2)),
        "cosh": lambda: p.step("div", _even(p, a), p.constant(2)),
        "tanh": lambda: p.step("div", _odd(p, a), _even(p, a)),
    }.get(name)
    if found is None:
        raise Inexact(f"{name} has no power series that arithmetic modulo a prime can follow")
    return found()


def _power(p: Program, a: int, b: int) -> int:
    exponent = p.steps[b].constant
    if exponent is None:
        return p.exp(p.step("mul", b, p.log(a)))
    if exponent == 0:
        return p.constant(1)
    return p.root(a, exponent)


def _other_leg(p: Program, a: int) -> int:
    """√(1 - a²)."""
    left = p.step("sub", p.constant(1), p.step("mul", a, a))
    return p.root(left, Fraction(1, 2))


def _hypotenuse(p: Program, a: int, b: int) -> int:
    both = p.step("add", p.step("mul", a, a), p.step("mul", b, b))
    return p.root(both, Fraction(1, 2))


def _odd(p: Program, a: int) -> int:
    """exp(a) - exp(-a)."""
    e = p.exp(a)
    return p.step("sub", e, p.step("div", p.constant(1), e))


def _even(p: Program, a: int) -> int:
    e = p.exp(a)
    return p.step("add", e, p.step("div", p.constant(1), e))
