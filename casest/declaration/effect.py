"""Effects: something physical that a model lacks, null at zero, attachable wherever it fits."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from casest.declaration.physics import SX
from casest.declaration.symbols import Constant, Parameter, Signal, Undecided, named
from casest.declaration.travelling import reduced
from casest.errors import DeclarationError, UnitError, last_line
from casest.units import known

Kind = Literal["quantity", "signal", "noise", "sequence", "time", "rate"]

#: Kinds that look at other samples than a residual's own.
OVER_TIME: tuple[Kind, ...] = ("sequence", "time")
#: What `on` says of an effect that delays any recorded signal: `with_effect(…, on=…)` says which.
RECORDED = "recorded"
#: What `on` says of an effect on the rate of any state, and how such a quantity begins.
RATES, RATE = "rate of a state", "rate of "
#: Arguments of an effect on the sequence that casest gives, beside the value and what it keeps.
PREVIOUS, STEP, SPAN = "previous", "dt", "span"

#: What an effect on the noise acts on, instead of a quantity.
NOISE = "noise"
#: What an effect may say of a column that is looked for among those recorded: a temperature, any
#: other, or both, or an angle, or another sensor's acceleration on three axes; on a rate, the state
#: itself whose rate it is, or another state; of a number that data tell; of what is searched over a
#: grid; and of where one on the noise shows itself.
COLUMNS = ("temperature", "other", "any", "angle", "acceleration", "itself", "state")
NUMBERS = ("mean", "least", "greatest", "duration", "radian", "middle")
PROFILES = (
    "frequency", "time", "timescale", "memory", "level", "floor", "threshold", "band", "share",
    "lag", "onset",
)  # fmt: skip
TAILS, RANDOM_WALK = "tails", "random walk"


#: What became of what happened in one record alone.
Once = Literal["", "passed", "stayed"]


@dataclass(frozen=True)
class Effect:
    """A function of one quantity, signal, the noise, the sequence of samples, or a signal's time.

    `on` names what it acts on; `extras` are further signals, columns or quantities it reads;
    `null` maps each parameter to the value at which the effect vanishes (0 unless told).
    For tracing a residual: `typical` sizes of the parameters, each in its unit; `profile` the
    parameters that are searched over a grid (name -> "frequency", "time", "timescale", "level",
    "floor", "share", "lag" or "onset"), because it is not smooth in them, or has many valleys;
    `shown_by` the measurement that shows it; `plain` the form that it is tried in once it was
    found; `columns` the argument for which a recorded column is looked for (name -> "temperature",
    "other", "any", "angle", which is also a scalar signal or quantity of the model in rad or deg,
    or "acceleration", another measured signal of three axes; on a rate "itself", the state whose
    rate it is, or "state", any other); `numbers` those
    that data tell (name -> "mean", "least" or "greatest" of that column, "radian": rad for each of
    its unit, "duration" of the record, or "middle" of a recorded input that is far from zero, else
    0); `seen_in` where an effect on the noise shows itself: the "tails" of the residuals, or a
    "random walk" in them; `describes`: it says what a course looks like, and names no cause;
    `memory` what one on the sequence keeps from sample to sample, and what each begins from (the
    value acted on, or a number); `otherwise` the form that it takes in a
    model where it is not applicable as it stands; `once`: it happened in the record that it was
    found in, and has "passed" (in another one it is not there) or "stayed" (in another one nobody
    knows how much of it is there); `foreign_to` kinds of reading, by a unit each, of which no
    sensor has it, `only_of` those that alone have it: elsewhere it is tried where it is asked for;
    `within` sizes (least, most) of parameters out of which it is another effect than its name says.
    """

    name: str
    function: Callable[..., Any]
    on: str
    kind: Kind
    extras: tuple[Signal, ...]
    declarations: tuple[Any, ...]
    null: tuple[tuple[str, float], ...]
    doc: str = ""
    typical: tuple[tuple[str, float], ...] = ()
    profile: tuple[tuple[str, str], ...] = ()
    shown_by: str = ""
    #: What it does as a formula, where the source is not what a reader should see.
    formula: str = ""
    #: Values of parameters at which it is what it mostly is in practice, with fewer unknowns.
    plain: tuple[tuple[str, float], ...] = ()
    columns: tuple[tuple[str, str], ...] = ()
    numbers: tuple[tuple[str, str], ...] = ()
    seen_in: str = ""
    describes: bool = False
    memory: tuple[tuple[str, str | float], ...] = ()
    otherwise: Effect | None = None
    #: Python text of one that the loop wrote, to be given again.
    source: str = ""
    once: Once = ""
    foreign_to: tuple[str, ...] = ()
    only_of: tuple[str, ...] = ()
    within: tuple[tuple[str, tuple[float, float]], ...] = ()

    def __reduce__(self) -> tuple[Any, ...]:
        """To pickle: its function by name."""
        return reduced(self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Evaluate the effect's own function."""
        return self.function(*args, **kwargs)

    def null_of(self, parameter: str) -> float:
        """Value of a parameter at which the effect is absent."""
        return dict(self.null).get(parameter, 0.0)

    def holding(self, **values: float) -> Effect:
        """The same effect with parameters or numbers held at values (in their own units)."""
        held = tuple(
            (n, Constant(n, (float(values[n]),), getattr(d, "unit", "")) if n in values else d)
            for n, d in self.declarations
        )
        return replace(self, declarations=held, otherwise=self._other("holding", values))

    def starting(self, **values: float) -> Effect:
        """The same effect with other start values of scalar parameters, or of all axes alike."""

        def begun(declared: Any, value: float) -> Any:
            alike = isinstance(declared, Undecided)
            return replace(declared, start=float(value) if alike else (float(value),))

        moved = tuple((n, begun(d, values[n]) if n in values else d) for n, d in self.declarations)
        return replace(self, declarations=moved, otherwise=self._other("starting", values))

    def _other(self, changed: str, values: Mapping[str, float]) -> Effect | None:
        """Its other form, changed likewise."""
        other = self.otherwise
        return None if other is None else getattr(other, changed)(**values)


def label_of(declared: Effect, on: str, columns: Mapping[str, str], *, moved: bool) -> str:
    """What an effect of a model is called: with the columns it reads, and where it acts if moved.

    One on a signal's time is always called with the signal, one on any rate with the state.
    """
    if declared.kind == "time":
        return f"{declared.name}({on})"
    label = declared.name + "".join(f"({c})" for c in columns.values())
    if declared.kind == "rate":
        state = on.removeprefix(RATE)
        return label if state in columns.values() else f"{label}@{state}"
    return f"{label}@{on}" if moved else label


def effect(
    *,
    on: str,
    kind: Kind | None = None,
    null: Mapping[str, float] | None = None,
    typical: Mapping[str, float] | None = None,
    profile: Mapping[str, str] | None = None,
    shown_by: str = "",
    formula: str = "",
    plain: Mapping[str, float] | None = None,
    columns: Mapping[str, str] | None = None,
    numbers: Mapping[str, str] | None = None,
    seen_in: str = "",
    describes: bool = False,
    memory: Mapping[str, str | float] | None = None,
    otherwise: Effect | None = None,
    once: Once = "",
    foreign_to: Sequence[str] = (),
    only_of: Sequence[str] = (),
    within: Mapping[str, tuple[float, float]] | None = None,
) -> Callable[[Callable[..., Any]], Effect]:
    """Declare an effect: first argument the value acted on, further ones signals or columns.

    The kind follows from `on`: the name of a quantity or of a signal of the model, or `"noise"`
    (then the function returns the weight of a sample whose residual is r standard deviations).
    `kind="sequence"`: the function gives the value of one sample from that of its own and from
    what was before. Arguments that it may name: `previous`, the result for the sample before; `dt`,
    the time since then in s; `span`, how far the value goes from its least to its greatest in the
    run; and those of `memory`, each of the value's shape, {name: what it begins from}: 0, or the
    name of the first argument. With `memory` it returns the result and then, in that order, what is
    kept for the next sample. Where a gap in time ends, all begins anew.
    `kind="time"`: the first argument is the time of a sample in s, and the function gives the time
    at which the signal named by `on` is taken from its record, between samples by splines.
    """
    kept = {PREVIOUS, STEP, SPAN, *(memory or {})}

    def declare(function: Callable[..., Any]) -> Effect:
        positional, keyword = _signature(function)
        extras = []
        for name, default in positional[1:]:
            if kind == "sequence" and name in kept:
                continue
            extras.append(
                named(default, name) if isinstance(default, Signal) else Signal(name, 1, None)
            )
        for word, given in (
            ("null", null), ("typical", typical), ("profile", profile), ("plain", plain),
            ("numbers", numbers), ("within", within),
        ):  # fmt: skip
            _refuse_unknown(function.__name__, word, given or {}, [name for name, _ in keyword])
        if uncertain := [s.name for s in extras if s.std is not None]:
            raise DeclarationError(
                f"effect {function.__name__}: what an effect reads counts as exact; leave std of "
                f"{uncertain[0]} out"
            )
        said = {"columns": columns or {}, "numbers": numbers or {}, "profile": profile or {}}
        _refuse_other_words(function.__name__, on, extras, said, seen_in)
        _refuse_other_memory(function.__name__, positional, memory or {}, kind)
        if kind == "time" and extras:
            raise DeclarationError(
                f'effect {function.__name__}: kind="time" takes the time of a sample and '
                f"nothing else, not {extras[0].name!r}"
            )
        places: dict[str, Kind] = {NOISE: "noise", RATES: "rate"}
        declared_kind: Kind = kind or places.get(on, "quantity")
        declarations = tuple(_declaration(function.__name__, name, d) for name, d in keyword)
        return Effect(
            function.__name__,
            function,
            on,
            declared_kind,
            tuple(extras),
            declarations,
            tuple(sorted((null or {}).items())),
            inspect.getdoc(function) or "",
            tuple((typical or {}).items()),
            tuple((profile or {}).items()),
            shown_by,
            formula,
            tuple((plain or {}).items()),
            tuple((columns or {}).items()),
            tuple((numbers or {}).items()),
            seen_in,
            describes,
            tuple((memory or {}).items()),
            otherwise,
            once=once,
            foreign_to=tuple(foreign_to),
            only_of=tuple(only_of),
            within=tuple((within or {}).items()),
        )

    return declare


def _refuse_unknown(name: str, word: str, given: Mapping[str, Any], own: Sequence[str]) -> None:
    unknown = sorted(set(given) - set(own))
    if unknown:
        there = f"it has {', '.join(own)}" if own else "it has none; they stand after a *"
        raise DeclarationError(
            f"effect {name}: {word}= names {unknown[0]!r}, which is none of its parameters: {there}"
        )


def _refuse_other_words(
    name: str,
    on: str,
    extras: Sequence[Signal],
    given: Mapping[str, Mapping[str, str]],
    seen_in: str,
) -> None:
    """What is said of columns, numbers, grids and the noise must be what the loop knows."""
    columns = given["columns"]
    for argument in set(columns) - {s.name for s in extras}:
        raise DeclarationError(
            f"effect {name}: columns= names {argument!r}, which is no argument that it reads"
        )
    if len(columns) > 1:
        raise DeclarationError(
            f"effect {name}: columns= names {len(columns)} arguments, and one column is looked for"
        )
    if seen_in and on != NOISE:
        raise DeclarationError(
            f"effect {name}: seen_in= is for effects on the noise, and this one acts on {on!r}"
        )
    known_words = {"columns": COLUMNS, "numbers": NUMBERS, "profile": PROFILES}
    said = [(word, w, known_words[word]) for word, own in given.items() for w in own.values()]
    said += [("seen_in", seen_in, (TAILS, RANDOM_WALK))] if seen_in else []
    for word, what, known_ones in said:
        if what not in known_ones:
            raise DeclarationError(
                f"effect {name}: {word}= says {what!r}: give {' or '.join(known_ones)}"
            )


def _refuse_other_memory(
    name: str, positional: Sequence[tuple[str, Any]], memory: Mapping[str, Any], kind: Kind | None
) -> None:
    """What is kept is an argument, and begins from the value acted on or from a number."""
    first, *others = (argument for argument, _ in positional)
    for kept, start in memory.items():
        if kind != "sequence":
            raise DeclarationError(
                f'effect {name}: memory= is for kind="sequence", and this one is none'
            )
        if kept not in others or kept in (PREVIOUS, STEP, SPAN):
            raise DeclarationError(
                f"effect {name}: memory= names {kept!r}: give it as an argument behind {first!r}, "
                f"other than {PREVIOUS}, {STEP} and {SPAN}"
            )
        if start != first and not isinstance(start, int | float):
            raise DeclarationError(
                f"effect {name}: {kept} begins from {start!r}: give {first!r}, which it acts on, "
                "or a number"
            )


def _signature(function: Callable[..., Any]) -> tuple[list[tuple[str, Any]], list[tuple[str, Any]]]:
    """Positional and keyword-only arguments with their defaults."""
    parameters = inspect.signature(function).parameters.values()
    positional = [(p.name, p.default) for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    keyword = [(p.name, p.default) for p in parameters if p.kind is p.KEYWORD_ONLY]
    if not positional:
        raise DeclarationError(f"effect {function.__name__}: its first argument is what it acts on")
    return positional, keyword


def _declaration(effect_name: str, name: str, declared: Any) -> tuple[str, Any]:
    if isinstance(declared, Parameter | Undecided | Constant):
        return (name, declared)
    if isinstance(declared, int | float):
        return (name, Constant(name, (float(declared),), ""))
    raise DeclarationError(
        f"effect {effect_name}: {name} must be param(…) or a number, not {declared!r}"
    )


#: Moments of a record of which the mean of an effect is taken.
MOMENTS = 50


@dataclass(frozen=True)
class Attached:
    """An effect at its place in a model: what it acts on, which columns it reads, its unknowns."""

    effect: Effect
    on: str
    kind: Kind
    label: str
    columns: tuple[tuple[str, str], ...]
    parameters: tuple[Parameter, ...]
    inner: tuple[str, ...] = ()
    #: Times in s between which it is averaged: what it is in another record nobody knows.
    over: tuple[float, float] | None = None

    @property
    def reads(self) -> tuple[Signal, ...]:
        """All that the effect reads, under the names of data and model."""
        return tuple(read for _, read in _paired(self))

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Those of them that data give; `inner` are quantities of the model."""
        return tuple(s for s in self.reads if s.name not in self.inner)

    @property
    def lasts(self) -> bool:
        """Does it say something of other records than the one it was found in?"""
        return self.kind == "noise" or not (self.effect.once or self.effect.describes)

    @property
    def keeps(self) -> tuple[tuple[str, str | float], ...]:
        """What an effect on the sequence carries from sample to sample, and what it begins from."""
        first = next(iter(inspect.signature(self.effect.function).parameters))
        return self.effect.memory or ((PREVIOUS, first),)

    @property
    def spanned(self) -> bool:
        """Does an effect on the sequence ask how far its value goes in a run?"""
        return SPAN in inspect.signature(self.effect.function).parameters

    def apply(self, value: SX, symbols: Mapping[str, SX]) -> SX:
        """The value with the effect in it, from the model's symbols by name."""
        read = {s.name: symbols[own.name] for s, own in _paired(self)}
        numbers = self._numbers(symbols)

        def given(more: Mapping[str, SX]) -> SX:
            known = {**read, **more}
            extras = [known[s.name] for s in self.effect.extras]
            return evaluated(self.effect, value, *extras, **numbers)

        if self.over is None:
            return given({})
        first, last = self.over
        moments = (first + (last - first) * (k + 0.5) / MOMENTS for k in range(MOMENTS))
        return sum(given({"t": ca.SX(t)}) for t in moments) / MOMENTS

    def step(
        self, value: SX, symbols: Mapping[str, SX], before: Mapping[str, SX], dt: SX, span: SX
    ) -> tuple[SX, ...]:
        """Of an effect on the sequence: the value with it, then what is kept for the next sample.

        `before` holds what was kept at the sample before, by name.
        """
        read = {s.name: symbols[r.name] for s, r in _paired(self)}
        given = {**before, STEP: dt, SPAN: span, **read}
        return stepped(self.effect, value, given, self._numbers(symbols))

    def _numbers(self, symbols: Mapping[str, SX]) -> dict[str, Any]:
        """Its unknowns and constants, by the names that its function has for them."""
        unknowns = {p.name.rpartition(".")[2]: symbols[p.name] for p in self.parameters}
        numbers: dict[str, Any] = {
            n: d.array for n, d in self.effect.declarations if isinstance(d, Constant)
        }
        if self.kind == "noise":  # the scatter's own parameters are no unknowns of a fit
            for n, d in self.effect.declarations:
                if isinstance(d, Parameter):
                    numbers[n] = d.shape.unpack(d.start_value())
        numbers = {n: float(a) if a.ndim == 0 else a for n, a in numbers.items()}
        return {**unknowns, **numbers}


def _paired(attached: Attached) -> list[tuple[Signal, Signal]]:
    """What it reads: as the effect's function calls it, and as the model and the data do."""
    renamed, averaged = dict(attached.columns), attached.over is not None
    own = [s for s in attached.effect.extras if not (averaged and s.name == "t")]
    return [(s, replace(s, name=renamed.get(s.name, s.name))) for s in own]


def stepped(
    declared: Effect, value: SX, given: Mapping[str, Any], numbers: Mapping[str, Any]
) -> tuple[SX, ...]:
    """Result and memory of an effect on the sequence; the result is kept where it has no memory.

    Raises DeclarationError where it returns another number of values than it declares.
    """
    asked = inspect.signature(declared.function).parameters
    taken = {name: v for name, v in given.items() if name in asked}
    found = evaluated(declared, value, **taken, **numbers)
    if not declared.memory:
        return ca.SX(found), ca.SX(found)
    if not isinstance(found, tuple) or len(found) != 1 + len(declared.memory):
        names = ", ".join(name for name, _ in declared.memory)
        raise DeclarationError(
            f"effect {declared.name}: with memory={{…}} it returns the result and then what is "
            f"kept: return result, {names}"
        )
    return tuple(ca.SX(v) for v in found)


def evaluated(declared: Effect, *args: Any, **kwargs: Any) -> SX:
    """The effect's function, its own errors turned into one line with their place."""
    code = declared.function.__code__
    try:
        found = declared.function(*args, **kwargs)
    except (Exception, SystemExit) as error:
        line, traceback = code.co_firstlineno, error.__traceback__
        while traceback is not None:
            if traceback.tb_frame.f_code is code:
                line = traceback.tb_lineno
            traceback = traceback.tb_next
        raise DeclarationError(
            f"effect {declared.name}, {code.co_filename}, line {line}: {last_line(error)}"
        ) from None
    if found is None:
        raise DeclarationError(
            f"effect {declared.name}, {code.co_filename}, line {code.co_firstlineno}: it returns "
            "nothing; return what it acts on, with the effect in it"
        )
    return found


def attach(
    declared: Effect,
    on: str,
    kind: Kind,
    dims: tuple[int, ...],
    units: Mapping[str, str],
    columns: Mapping[str, str],
    label: str,
    inner: tuple[str, ...] = (),
) -> Attached:
    """An effect with its unknowns sized and named for the place where it is attached.

    `units` gives the unit of the value acted on, and of quantities that the effect may read.
    """
    parameters = []
    for name, declaration in declared.declarations:
        if isinstance(declaration, Constant) or kind == "noise":
            continue
        parameter = declaration.decided(dims) if isinstance(declaration, Undecided) else declaration
        parameter = replace(parameter, name=f"{label}.{name}")
        if parameter.start is None:
            null = tuple(np.full(parameter.shape.size, declared.null_of(name)))
            if not parameter.shape.curved:
                parameter = replace(parameter, start=null)
        first = next(iter(inspect.signature(declared.function).parameters))
        own = units.get(on) or f"[{on}]"
        own = f"({own})" if set("/*") & set(own) else own
        own_units = (u.replace(f"[{first}]", own) for u in parameter.units)
        renamed = tuple(of_columns(u, columns, units) for u in own_units)
        for unit in renamed:
            if "[" not in unit and unit and not known(unit):
                raise UnitError(f"effect {label}: {name} has unknown unit {unit!r}")
        parameters.append(replace(parameter, units=renamed))
    renamed_columns = tuple(sorted(columns.items()))
    return Attached(declared, on, kind, label, renamed_columns, tuple(parameters), inner)


def of_columns(unit: str, columns: Mapping[str, str], known: Mapping[str, str]) -> str:
    """The unit with the names of the columns that an effect reads: [channel] is [tyre temp].

    Of a quantity of the model with its `known` unit.
    """
    for name, column in columns.items():
        if column in known:
            unit = unit.replace(f"[{name}]", f"({known[column]})")
        elif not set("[]") & set(column):
            unit = unit.replace(f"[{name}]", f"[{column}]")
    return unit


def check_null(
    attached: Attached, shape: tuple[int, int], inner: Mapping[str, tuple[int, int]]
) -> None:
    """An effect must vanish at its null value: tried at random points.

    `inner` gives the shape of every quantity of the model that it may read.

    Raises DeclarationError naming the effect, its null value, and by how much it misses.
    """
    symbols = {s.name: ca.SX.sym(s.name, *inner.get(s.name, (s.size, 1))) for s in attached.reads}
    free = [ca.SX.sym("value", *shape), *symbols.values()]
    value = free[0]
    if "t" in symbols:  # so that rates of change are not zero
        value = value + 3 * symbols["t"]
        symbols = {n: s + 3 * symbols["t"] if n in inner else s for n, s in symbols.items()}
    nulls, unknowns = {}, {}
    for name, declaration in attached.effect.declarations:
        if isinstance(declaration, Constant):
            nulls[name] = declaration.array
        else:
            dims = next(
                (p.shape.dims for p in attached.parameters if p.name == f"{attached.label}.{name}"),
                (),
            )
            nulls[name] = np.full(dims or (1,), attached.effect.null_of(name))
            unknowns[name] = attached.effect.null_of(name)
    if attached.kind == "noise" and not unknowns:
        return  # weights without a parameter: there is nothing that could vanish
    more: list[SX] = []
    numbers = {n: float(v.ravel()[0]) if v.size == 1 else ca.SX(ca.DM(v)) for n, v in nulls.items()}
    if attached.kind == "sequence":
        kept = {name: ca.SX.sym(name, *shape) for name, _ in attached.keeps}
        given = {**kept, STEP: ca.SX.sym(STEP), SPAN: ca.SX.sym(SPAN, *shape)}
        more = list(given.values())
        own = {s.name: symbols[r.name] for s, r in _paired(attached)}
        changed = stepped(attached.effect, value, {**given, **own}, numbers)[0]
    else:
        changed = ca.SX(evaluated(attached.effect, value, *symbols.values(), **numbers))
    if changed.shape != shape:
        raise DeclarationError(
            f"effect {attached.label} changes the shape of {attached.on} from {shape} to "
            f"{changed.shape}"
        )
    expected = ca.SX.ones(*shape) if attached.kind == "noise" else value
    f = ca.Function("vanishes", [free[0], *more, *free[1:]], [changed - expected])
    rng = np.random.default_rng(0)
    for _ in range(3):
        point = [rng.uniform(0.5, 2.0, size=f.size_in(i)) for i in range(f.n_in())]
        change = float(np.max(np.abs(np.array(f(*point)))))
        if not change <= 1e-12:
            where = ", ".join(f"{n} = {v:g}" for n, v in unknowns.items())
            raise DeclarationError(
                f"effect {attached.label} is not null at {where}: it changes {attached.on} by "
                f"{change:.3g}; give the value at which it vanishes, @effect(…, null={{…}})"
            )
