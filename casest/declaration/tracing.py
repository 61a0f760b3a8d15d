"""A model's body written out in CasADi symbols, with every effect in its place."""

from __future__ import annotations

import ast
import inspect
import math
import sys
import textwrap
import warnings
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, Protocol

import casadi as ca

from casest.declaration.effect import Attached
from casest.declaration.flow import Flow, with_inputs
from casest.declaration.physics import SX, Quantity, Residual, Trace, chart, current_trace
from casest.declaration.shapes import in_digits
from casest.declaration.symbols import Constant, Parameter, Signal, Symbol
from casest.errors import CasestError, DeclarationError, last_line

#: Name of a prediction that the body does not name.
PREDICTED = "predicted"


class Declared(Protocol):
    """What is asked of a model here: its symbols, its body, and what has been added to it."""

    @property
    def name(self) -> str:
        """As it is called."""

    @property
    def function(self) -> Callable[..., Residual]:
        """The body."""

    @property
    def declared(self) -> tuple[Symbol, ...]:
        """Symbols of the signature."""

    @property
    def effects(self) -> tuple[Attached, ...]:
        """What was added, in order."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured, also by what the effects read."""

    @property
    def columns(self) -> tuple[Signal, ...]:
        """What a sample holds: the signals, then what is stated of their noise."""

    @property
    def readings(self) -> tuple[Signal, ...]:
        """Those of the body's signals that carry noise."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Unknowns, also of the effects."""

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Known numbers."""

    @property
    def traced(self) -> Traced:
        """The body in symbols."""

    def __getitem__(self, name: str) -> Any:
        """A symbol by name."""

    def __hash__(self) -> int:
        """Equal ones have the same: what is built of one is kept for all."""


@dataclass(frozen=True)
class Traced:
    """What a model's body computes.

    `coordinates` are the solver's unknowns and `references` the numbers that describe the charts
    of directions and rotations; `expression` is the residual column, `predicted` the reading of
    an explicit model and `reading` what it is compared with; `measured` and `corrected` name a
    signal and a quantity, `readings` every signal that is measured, where there are several as
    well. `integrates`: it follows differential equations.
    """

    symbols: Mapping[str, SX]
    coordinates: SX
    references: SX
    quantities: Mapping[str, Quantity]
    residual: Residual
    expression: SX
    predicted: SX
    reading: SX
    measured: str | None
    corrected: str | None
    steps: tuple[tuple[SX, SX], ...] = ()
    stages: tuple[Stage | Flow, ...] = ()
    readings: tuple[str, ...] = ()
    integrates: bool = False


#: Words of a body that look at the rest before.
Word = Literal["", "before", "turned", "carried"]
#: Those of them that are followed over the raw record between two rests.
ON_THE_WAY: tuple[Word, ...] = ("turned", "carried")


@dataclass(frozen=True)
class Stage:
    """What looks at other samples, where it acts: an effect, or a word of the body.

    `taken` is what it takes at a sample, one column: the value acted on, then what else it reads;
    `given` the symbol that stands for what it gives, a column as long as the value; `shape` is the
    value's, and `read` the names and shapes of what else it reads.
    """

    attached: Attached | None
    taken: SX
    given: SX
    shape: tuple[int, int] = (1, 1)
    read: tuple[tuple[str, tuple[int, int]], ...] = ()
    word: Word = ""

    @property
    def entered(self) -> SX:
        """All by which parameters enter."""
        return self.taken


@lru_cache(maxsize=512)
def trace(
    model: Declared,
    cut: str | None = None,
    naming: bool = False,
    straight: bool = False,
    staged: bool = False,
) -> Traced:
    """Run the model's body on symbols.

    `cut` replaces a quantity (before its effects) by a free symbol; `naming` replaces every
    quantity by a symbol of its name after it is computed, for printing; `straight` puts a free
    symbol in the place of what each effect adds, listed in `steps` with what it stands for;
    `staged` one in the place of what each effect that looks at other samples gives, listed in
    `stages`. Without it those effects are left out.

    Kept, for every fit has a model of its own (noise, effects), and most equal one before.
    """
    symbols, coordinates, references = _symbols(model)
    running = Trace(
        cut=cut, naming=naming, straight=straight, reserved=frozenset(symbols), staged=staged
    )
    running.reach = _staged_word if staged else _as_if_at_rest
    for attached in model.effects:
        if attached.kind == "quantity":
            running.effects.setdefault(attached.on, []).append(_applied(attached, symbols, running))
        if attached.kind == "sequence" and staged:
            running.effects.setdefault(attached.on, []).append(_staged(attached, symbols, running))
    residual = _run_body(model, running, symbols)
    running.stages = _with_inputs(model, running, symbols, [*coordinates, *references])
    readings = tuple(_name_of(s, symbols) or "" for s in residual.signals if s is not None)
    if "" in readings:
        raise DeclarationError(
            f"model {model.name}: measured= must be one of the model's signals; what is computed "
            "from one, a logarithm say, is a column of its own"
        )
    if readings:
        units = {model[name].unit or "" for name in readings}
        residual = _with_named_prediction(residual, running, units.pop() if len(units) == 1 else "")
    measured = readings[0] if len(readings) == 1 else None
    traced = Traced(
        symbols,
        ca.vertcat(*coordinates),
        ca.vertcat(*references),
        running.quantities,
        residual,
        ca.densify(_in_deviations(model, residual, symbols)),
        None if residual.predicted is None else ca.vec(ca.SX(residual.predicted)),
        None if residual.measured is None else ca.vec(residual.measured),
        measured,
        _corrected(model, residual, running, symbols),
        stages=tuple(running.stages),
        readings=readings,
        integrates=running.integrates,
    )
    on_signals = [a for a in model.effects if a.kind == "signal"]
    for attached in on_signals:
        if attached.on in traced.readings:
            traced = _with_changed_reading(traced, attached)
    # What is substituted last acts first: so that the first effect added does, go backwards.
    for attached in reversed(on_signals):
        if attached.on not in traced.readings:
            traced = _with_signal_effect(traced, attached, running)
    for attached in model.effects if staged else ():
        if attached.kind == "time":
            traced = _with_other_time(traced, attached)
    return replace(traced, steps=tuple(running.steps))


def _symbols(model: Declared) -> tuple[dict[str, SX], list[SX], list[SX]]:
    symbols: dict[str, SX] = {}
    for s in model.columns:
        flat = ca.SX.sym(s.name, s.size)
        symbols[s.name] = ca.reshape(flat, 3, 3).T if s.kind == "rotation" else flat
    coordinates, references = [], []
    for p in model.parameters:
        c = ca.SX.sym(p.name, p.shape.coordinates)
        coordinates.append(c)
        if p.shape.curved:
            r = ca.SX.sym(f"{p.name}_ref", len(p.shape.reference(p.shape.default())))
            references.append(r)
            symbols[p.name] = chart(p.shape.kind, c, r)
        elif len(p.shape.dims) == 2:
            matrix = ca.SX(*p.shape.dims)
            for k, index in enumerate(p.shape.entries):
                matrix[index] = c[k]
            symbols[p.name] = matrix
        else:
            symbols[p.name] = c
    for fixed in model.constants:
        symbols[fixed.name] = float(fixed.array) if not fixed.dims else ca.SX(ca.DM(fixed.array))
    return symbols, coordinates, references


def _applied(attached: Attached, symbols: Mapping[str, SX], running: Trace) -> Callable[[SX], SX]:
    def apply(value: SX) -> SX:
        return attached.apply(value, {**running.handed, **symbols})

    return apply


def _staged(attached: Attached, symbols: Mapping[str, SX], running: Trace) -> Callable[[SX], SX]:
    def apply(value: SX) -> SX:
        there = {s.name: {**running.handed, **symbols}[s.name] for s in attached.reads}
        taken = ca.vertcat(ca.vec(value), *map(flat, there.values()))
        given = ca.SX.sym(attached.label, value.numel())
        read = tuple((name, x.shape) for name, x in there.items())
        running.stages.append(Stage(attached, taken, given, value.shape, read))
        return ca.reshape(given, *value.shape)

    return apply


def _staged_word(running: Trace, word: Word, value: SX) -> SX:
    """A symbol in the place of what a word of the body gives."""
    if word == "turned" and value.shape != (3, 1):
        raise DeclarationError(f"turned(…) takes a rate about three axes, not {value.shape}")
    if word == "carried" and value.shape != (6, 1):
        raise DeclarationError("carried(…) takes a rate and a vector, of three axes each")
    shape = {"turned": (3, 3), "carried": (3, 1)}.get(word, value.shape)
    given = ca.SX.sym(word, shape[0] * shape[1])
    running.stages.append(Stage(None, ca.vec(value), given, shape, (), word))
    return ca.reshape(given, *shape)


def _as_if_at_rest(running: Trace, word: Word, value: SX) -> SX:
    """Of a single sample: all was as it is, and the body has turned for a second."""
    if word == "carried":
        return value[3:]
    return value if word == "before" else ca.SX.eye(3) + ca.skew(value)


def _in_deviations(model: Declared, residual: Residual, symbols: Mapping[str, SX]) -> SX:
    """The residual, each axis over the constant that is its noise, where that is known."""
    found = residual.expression
    if not residual.noise:
        return found
    constants = {c.name for c in model.constants}
    for name in residual.noise:
        if name not in constants and not isinstance(symbols.get(name), ca.SX):
            raise DeclarationError(f"model {model.name}: noise= names {name!r}, no constant of it")
    if len(residual.noise) != found.numel():
        raise DeclarationError(
            f"model {model.name}: noise= has {len(residual.noise)} names for {found.numel()} axes"
        )
    sizes = [symbols[name] for name in residual.noise]
    known = [1.0 if isinstance(size, float) and not size > 0 else size for size in sizes]
    return found / ca.vertcat(*known)


def _run_body(model: Declared, running: Trace, symbols: Mapping[str, SX]) -> Residual:
    arguments = {s.name: symbols[s.name] for s in model.declared if "." not in s.name}
    token = current_trace.set(running)
    try:
        with warnings.catch_warnings():
            # CasADi remarks on NumPy's functions, which give the right expression.
            warnings.simplefilter("ignore", FutureWarning)
            residual = model.function(**arguments)
        if not isinstance(residual, Residual):
            found = type(residual).__name__
            raise DeclarationError(f"the body must return Residual(…), not {found}")
        _refuse_not_a_number(residual.expression)  # also raises where shapes do not match
    except CasestError as error:
        raise type(error)(f"model {model.name}, {_where(model.function)}: {error}") from None
    except NameError as error:
        raise DeclarationError(
            f"model {model.name}, {_where(model.function)}: {error}; "
            "declare it in the model's signature, or import it"
        ) from None
    except (Exception, SystemExit) as error:
        raise DeclarationError(
            f"model {model.name}, {_where(model.function)}: {last_line(error)}"
        ) from error
    finally:
        current_trace.reset(token)
    return residual


def _with_named_prediction(residual: Residual, running: Trace, unit: str) -> Residual:
    """A prediction that nobody named is a quantity all the same: effects on the reading act there.

    It is called PREDICTED, or PREDICTED_ where that is something else.
    """
    of = residual.predicted
    for name, found in running.quantities.items():
        if of is found.value or of is running.handed[name]:
            return residual
    name = PREDICTED
    while name in running.quantities or name in running.reserved:
        name += "_"
    named = copy(residual)
    named.predicted = running.enter(name, of, unit, implied=True)
    return named


def _with_changed_reading(traced: Traced, attached: Attached) -> Traced:
    """The prediction stays; what is compared with it does not."""
    if traced.measured is not None:
        changed = ca.vec(ca.SX(attached.apply(traced.reading, traced.symbols)))
    else:
        own = traced.symbols[attached.on]
        part = ca.vec(ca.SX(attached.apply(own, traced.symbols)))
        changed = ca.substitute(traced.reading, ca.vec(own), part)
    expression = traced.residual.of(changed, traced.predicted)
    return replace(traced, reading=changed, expression=expression)


def _with_signal_effect(traced: Traced, attached: Attached, running: Trace) -> Traced:
    """Effects on a signal act after the body, because der(…, t) needs the bare symbol."""
    symbol = traced.symbols[attached.on]
    plain = flat(symbol)
    changed = running.passed(plain, flat(ca.SX(attached.apply(symbol, traced.symbols))))

    if running.straight:  # what was there before reads the signal as it has become
        *others, own = running.steps
        late = [(step, ca.substitute(change, plain, changed)) for step, change in others]
        running.steps = [own, *late]
    return _substituted(traced, plain, changed)


def _with_other_time(traced: Traced, attached: Attached) -> Traced:
    """A signal taken at another time is what its record gives there: a symbol in its place."""
    plain = flat(traced.symbols[attached.on])
    given = ca.SX.sym(attached.label, plain.numel())
    traced = _substituted(traced, plain, given)
    return replace(traced, stages=(Stage(attached, plain, given), *traced.stages))


def _substituted(traced: Traced, plain: SX, changed: SX) -> Traced:
    """The body with one signal changed, after it has been run."""

    def put(expression: SX) -> SX:
        return ca.substitute(expression, plain, changed)

    quantities = {
        name: replace(q, declared=put(q.declared), value=put(q.value))
        for name, q in traced.quantities.items()
    }
    return replace(
        traced,
        quantities=quantities,
        expression=put(traced.expression),
        predicted=None if traced.predicted is None else put(traced.predicted),
        stages=tuple(replace(stage, taken=put(stage.taken)) for stage in traced.stages),
    )


def _corrected(
    model: Declared, residual: Residual, running: Trace, symbols: Mapping[str, SX]
) -> str | None:
    if residual.corrected is None:
        return None
    for name, found in running.quantities.items():
        if residual.corrected is found.value or residual.corrected is running.handed.get(name):
            return name
    if isinstance(residual.corrected, str) and residual.corrected in running.quantities:
        return residual.corrected
    signal = next((s for s in model.signals if residual.corrected is symbols[s.name]), None)
    if signal is not None:
        unit = f', "{signal.unit}"' if signal.unit else ""
        raise DeclarationError(
            f"model {model.name}: corrected= is the signal {signal.name}: write wanted = "
            f'quantity("wanted", {signal.name}{unit}), use `wanted` instead of {signal.name} in '
            "the lines below, and say corrected=wanted"
        )
    names = [name for name, found in running.quantities.items() if not found.implied]
    there = f" (there is {', '.join(names)})" if names else ""
    raise DeclarationError(
        f"model {model.name}: corrected= must be a quantity of the model{there}: wrap the "
        'expression where it is computed, wanted = quantity("wanted", …, "unit"), and say '
        "corrected=wanted"
    )


def function_of(model: Declared, outputs: Mapping[str, SX], traced: Traced | None = None) -> Any:
    """CasADi function (parameters, sample) -> outputs, one sample at a time.

    `parameters` holds the solver's coordinates and then the chart references; `sample` the
    signals one after the other.
    """
    traced = traced or model.traced
    inputs = [ca.vertcat(traced.coordinates, traced.references), sample_symbol(model, traced)]
    values = [ca.SX(v) for v in outputs.values()]
    # Not the model's own name: CasADi reserves some, and refuses two underscores in a row.
    return ca.Function("one_sample", inputs, values, ["parameters", "sample"], list(outputs))


def sample_symbol(model: Declared, traced: Traced | None = None) -> SX:
    """All that a sample holds as one column, in the order in which data hold it."""
    symbols = (traced or model.traced).symbols
    return ca.vertcat(*[flat(symbols[s.name]) for s in model.columns])


def reading_symbol(model: Declared, traced: Traced | None = None) -> SX:
    """The signals of one sample that carry noise, as one column: those that effects read do not."""
    symbols = (traced or model.traced).symbols
    return ca.vertcat(*[flat(symbols[s.name]) for s in model.readings])


def reached_parameters(model: Declared, traced: Traced, expression: SX) -> set[str]:
    """Names of the parameters that an expression of the trace depends on."""
    columns = ca.jacobian(ca.vec(expression), traced.coordinates).sparsity().get_triplet()[1]
    reached, place = set(), 0
    for p in model.parameters:
        width = p.shape.coordinates
        if any(place <= c < place + width for c in columns):
            reached.add(p.name)
        place += width
    return reached


def reached_signals(model: Declared, traced: Traced, expression: SX) -> set[str]:
    """Names of the signals that an expression of the trace depends on."""
    sample = sample_symbol(model, traced)
    columns = ca.jacobian(ca.vec(expression), sample).sparsity().get_triplet()[1]
    reached, place = set(), 0
    for s in model.columns:
        if any(place <= c < place + s.size for c in columns):
            reached.add(s.name)
        place += s.size
    return reached


def equations(model: Declared) -> list[str]:
    """The body of the model and of its effects, as declared.

    Where the source is not at hand, the traced expressions in terms of the quantities before.
    """
    try:
        lines = body(model.function)
        for attached in model.effects:
            lines += [
                "",
                f"# effect {attached.label} on {attached.on}",
                *body(attached.effect.function),
            ]
    except (OSError, TypeError):
        traced = trace(model, naming=True)
        lines = [f"{q.name} = {_expression(q.value)}" for q in traced.quantities.values()]
        lines.append(f"residual = {_expression(traced.expression)}")
    return lines


def body(function: Callable[..., Any]) -> list[str]:
    """Source lines of a function without its signature and docstring."""
    source = textwrap.dedent(inspect.getsource(function))
    declared = next(n for n in ast.parse(source).body if isinstance(n, ast.FunctionDef))
    statements = declared.body[1:] if ast.get_docstring(declared) else declared.body
    lines = source.splitlines()[statements[0].lineno - 1 : statements[-1].end_lineno]
    return textwrap.dedent("\n".join(lines)).splitlines()


def describe(model: Declared) -> str:
    """Table of the model's symbols, and its equations."""
    summary = (inspect.getdoc(model.function) or "").partition("\n")[0]
    rows = [("signal", s.name, s.size, s.unit or "any unit", "") for s in model.signals]
    for p in model.parameters:
        said = ["per run"] * (p.scope == "run") + ["diagonal > 0"] * _diagonal_positive(p)
        rows.append(("parameter", p.name, p.shape.size, p.unit, ", ".join(said)))
    for c in model.constants:
        value = in_digits(c.array, 6)
        rows.append(("constant", c.name, c.array.size, c.unit, f"= {value}"))
    for a in model.effects:
        rows.append(("effect", a.label, sum(p.shape.size for p in a.parameters), f"on {a.on}", ""))
    width = max(len(row[1]) for row in rows)
    table = [f"  {k:<10} {n:<{width}} {s:>3}  {u} {more}".rstrip() for k, n, s, u, more in rows]
    return "\n".join([f"{model.name}: {summary}", *table, *(f"  {e}" for e in equations(model))])


def _diagonal_positive(p: Parameter) -> bool:
    """Whether the diagonal of a matrix is bounded at 0, which its declaration does not show."""
    diagonal = [k for k, index in enumerate(p.shape.entries) if len(set(index)) == 1]
    return p.shape.positive_diagonal and all(p.lower[k] >= 0 for k in diagonal)


def _with_inputs(
    model: Declared, running: Trace, symbols: Mapping[str, SX], unknown: list[SX]
) -> list[Any]:
    """The stages, those that are differential equations with what their rates read."""
    held = {
        e.element_hash(): s.held for s in model.signals for e in ca.vertsplit(flat(symbols[s.name]))
    }
    return with_inputs(running.stages, ca.vertcat(*unknown), held, symbols.get("t"))


def _name_of(symbol: SX | None, symbols: Mapping[str, SX]) -> str | None:
    return (
        next((n for n, s in symbols.items() if s is symbol), None) if symbol is not None else None
    )


def flat(symbol: SX) -> SX:
    """A signal's numbers in the order in which data hold them (matrices row by row)."""
    return ca.vec(symbol.T) if symbol.shape == (3, 3) else symbol


def _where(function: Callable[..., Any]) -> str:
    """File and line of the function in the traceback of the current exception."""
    traceback = sys.exc_info()[2]
    line = function.__code__.co_firstlineno
    while traceback is not None:
        if traceback.tb_frame.f_code is function.__code__:
            line = traceback.tb_lineno
        traceback = traceback.tb_next
    return f"{function.__code__.co_filename}, line {line}"


def _refuse_not_a_number(expression: SX) -> None:
    """Functions of Python's math module turn a symbol into NaN without a word."""
    f = ca.Function("one_sample", ca.symvar(expression), [expression])
    for k in range(f.n_instructions()):
        constant = f.instruction_id(k) == ca.OP_CONST
        if constant and math.isnan(float(f.instruction_constant(k))):
            raise DeclarationError(
                "the body computes what is not a number; functions of `math` take numbers alone: "
                "use casest's (from casest import sin, sqrt, exp, …)"
            )


def _expression(value: SX) -> str:
    """A readable expression, component by component."""
    parts = [str(value[i]) for i in range(value.numel())]
    return parts[0] if len(parts) == 1 else "[" + ", ".join(parts) + "]"
