"""Models: the declared relation between signals and parameters, as an immutable value."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.changing import (
    check_units_known,
    converted_constant,
    converted_parameter,
    uncertainty_of_coordinates,
)
from casest.declaration.effect import (
    NOISE,
    OVER_TIME,
    RATES,
    RECORDED,
    Attached,
    Effect,
    Kind,
    attach,
    check_null,
    label_of,
)
from casest.declaration.flow import Flow, rates_of
from casest.declaration.noise import Stated, in_units_of_noise
from casest.declaration.physics import Quantity, Residual
from casest.declaration.prior import Prior
from casest.declaration.sampson import sampson
from casest.declaration.shapes import Array, in_words
from casest.declaration.symbols import Constant, Parameter, Scope, Signal, Symbol, constant, named
from casest.declaration.tracing import (
    Traced,
    describe,
    function_of,
    reached_parameters,
    reached_signals,
    trace,
)
from casest.declaration.travelling import reduced
from casest.errors import CasestError, DeclarationError, UnitError, UsageError
from casest.units import known, parse_quantity, size


@dataclass(frozen=True)
class Model:
    """Signals, parameters, constants, the body that relates them, and the effects added to it.

    A value: `having` and `with_effect` return new models, and two models are equal when they
    were declared by the same function with the same symbols and effects.
    """

    name: str
    function: Callable[..., Residual]
    declared: tuple[Symbol, ...]
    effects: tuple[Attached, ...] = ()
    starter: Callable[..., Any] | None = None
    starter_of_many: Callable[..., Any] | None = None
    limiter: Callable[..., Any] | None = None
    remarker: Callable[..., Any] | None = None
    refuser: Callable[..., Any] | None = None
    inverter: Callable[..., Any] | None = None
    canonicaliser: Callable[..., Any] | None = None
    estimators: tuple[tuple[str, Callable[..., Any]], ...] = ()
    noise: Stated | None = None
    prior: Prior | None = None

    def __hash__(self) -> int:
        """As a dataclass has it, computed once: all that is kept for a model is found by it."""
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(tuple(getattr(self, field.name) for field in fields(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        """To pickle: the declaration alone; it is traced anew where it arrives."""
        return reduced(self)

    # -- the symbol table ----------------------------------------------------------------------

    @cached_property
    def signals(self) -> tuple[Signal, ...]:
        """Signals of the body, then those that effects read, each once."""
        own = [s for s in self.declared if isinstance(s, Signal)]
        for attached in self.effects:
            own += [s for s in attached.signals if s.name not in {o.name for o in own}]
        return tuple(own)

    @cached_property
    def columns(self) -> tuple[Signal, ...]:
        """What a sample holds: the signals, then what is stated of their noise."""
        if self.noise is None:
            return self.signals
        return self.signals + self.noise.columns({s.name: s for s in self.signals})

    def elsewhere(self, spans: Sequence[tuple[float, float] | None]) -> Model:
        """As it is for other records than those that it was fitted to, from first to last time.

        What happened in the only one of them and passed is not there; what stayed is, as its mean
        over that record: how much of it another one has nobody knows. What several share came again
        in each: it is kept. Itself where all lasts.
        """
        kept = []
        for a in self.effects:
            if a.lasts or (a.effect.once and len(spans) > 1):
                kept.append(a)
            elif a.effect.once == "stayed" and spans and spans[0] is not None:
                kept.append(replace(a, over=spans[0]))
        return self if tuple(kept) == self.effects else replace(self, effects=tuple(kept))

    def among(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Those of the values that are its parameters'."""
        names = {p.name for p in self.parameters}
        return {name: value for name, value in values.items() if name in names}

    @cached_property
    def without_noise(self) -> Model:
        """The same relation, its residual in its own unit; itself where no noise was stated."""
        return self if self.noise is None else replace(self, noise=None)

    @cached_property
    def as_read(self) -> Model:
        """Of a predicted reading: its residual at the readings themselves, over the noise there."""
        return self._with_noise(as_read=True)

    @cached_property
    def at_true_values(self) -> Model:
        """With the residual at the likeliest true values, as noise that was stated has it."""
        return self._with_noise(as_read=False)

    def _with_noise(self, as_read: bool) -> Model:
        if self.noise is None or self.implicit:
            return self
        return replace(self, noise=replace(self.noise, as_read=as_read))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declared parameters, then those of the effects (`quadratic.k`)."""
        own = [p for p in self.declared if isinstance(p, Parameter)]
        changed = {s.name: s for s in self.declared if "." in s.name}
        added = [p for attached in self.effects for p in attached.parameters]
        of_effects: list[Symbol] = [changed.get(p.name, p) for p in added]
        return tuple(
            [p for p in own if "." not in p.name]
            + [p for p in of_effects if isinstance(p, Parameter)]
        )

    def unknowns_of(self, label: str) -> set[str]:
        """Names of the parameters that an effect brought, by its label; none without it."""
        return {p.name for a in self.effects if a.label == label for p in a.parameters}

    @cached_property
    def constants(self) -> tuple[Constant, ...]:
        """Plain numbers of the model."""
        return tuple(c for c in self.declared if isinstance(c, Constant))

    @property
    def in_records(self) -> tuple[Signal, ...]:
        """All that a record must hold: its signals, and of differential equations the time `t`."""
        timed = not self.traced.integrates or any(s.name == "t" for s in self.signals)
        return self.signals if timed else (*self.signals, Signal("t", 1, "s"))

    @property
    def readings(self) -> tuple[Signal, ...]:
        """Signals of the body that carry noise: all but time and attitude, which are exact.

        All of them where there is nothing else.
        """
        own = [s for s in self.declared if isinstance(s, Signal)]
        return tuple([s for s in own if s.name != "t" and s.kind == "plain"] or own)

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """Named inner values, in the order in which the body computes them."""
        return self.traced.quantities

    @property
    def implicit(self) -> bool:
        """True where the residual is no signal, so that readings cannot be simulated from it."""
        return self.traced.residual.implicit is not None

    @property
    def axes(self) -> tuple[str, ...]:
        """Name of each component of the residual."""
        given, size = self.traced.residual.axes, self.traced.expression.numel()
        if given:
            return given
        return (
            ("x", "y", "z")
            if size == 3
            else tuple(map(str, range(size)))
            if size > 1
            else ("value",)
        )

    @property
    def residual_unit(self) -> str:
        """Unit of the residual; `[v]` stands for the unit of signal v."""
        traced = self.traced
        if traced.residual.noise:
            return "1"
        if traced.measured is not None and not traced.residual.unit:
            return self[traced.measured].unit or f"[{traced.measured}]"
        return traced.residual.unit

    def __getitem__(self, name: str) -> Any:
        """Signal, parameter or constant of that name."""
        if name in self.symbols:
            return self.symbols[name]
        raise UsageError(self._unknown(name))

    @cached_property
    def symbols(self) -> Mapping[str, Symbol]:
        """Every signal, parameter and constant by name."""
        every: list[Symbol] = [*self.signals, *self.parameters, *self.constants]
        return {symbol.name: symbol for symbol in every}

    def _unknown(self, name: str) -> str:
        names = list(self.symbols)
        near = difflib.get_close_matches(name, names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else f"; it has {', '.join(names)}"
        return f"model {self.name} has no {name!r}{hint}"

    # -- new models from this one --------------------------------------------------------------

    def having(self, **changes: Any) -> Model:
        """A model with constants set, parameters redeclared, or either turned into the other.

        A number fixes (`radius=0.3`), also with its unit (`norm="48 uT"`), a `param(…)` frees
        (`radius=param("m", start=0.28)`), a `constant(…)` sets value and unit.
        """
        model = self
        for name, change in changes.items():
            old, model = model[name], model._with(name, model._changed(name, change))
            if model.prior is not None and isinstance(old, Parameter):
                prior = model.prior.without(name, old.shape.coordinates)
                model = replace(model, prior=prior)
        return model

    def _changed(self, name: str, change: Any) -> Parameter | Constant:
        old = self[name]
        if isinstance(old, Signal):
            raise UsageError(f"{name} is a signal of model {self.name}: data give it, not having()")
        if isinstance(change, Parameter):
            return replace(converted_parameter(name, change, old), name=name)
        new = change if isinstance(change, Constant) else _stated(name, change, old.unit)
        new = converted_constant(name, new, old.unit)
        if isinstance(old, Parameter):
            try:
                value = old.shape.unpack(old.shape.pack(new.array))
            except DeclarationError as error:
                raise UsageError(f"{name} of model {self.name}: {error}") from None
            fixed: Constant = constant(value, new.unit)
            known = uncertainty_of_coordinates(name, new, old)
            return replace(fixed, name=name, frozen=old, uncertainty=known)
        if new.array.shape != old.array.shape:
            raise UsageError(
                f"{name} of model {self.name} is {in_words(old.array.shape)}, and "
                f"{in_words(new.array.shape)} is given"
            )
        like = old.like or (old.unit if "[" in old.unit and new.unit != old.unit else "")
        chosen = new.chosen or old.chosen
        return replace(new, name=name, frozen=old.frozen, like=like, chosen=chosen)

    def _with(self, name: str, symbol: Any) -> Model:
        if name in {s.name for s in self.declared}:
            declared = tuple(symbol if s.name == name else s for s in self.declared)
        else:  # a parameter of an effect
            declared = (*self.declared, symbol)
        return replace(self, declared=declared)

    def freed(self, name: str) -> Model:
        """A model in which the constant is an unknown, starting from its value."""
        old = self[name]
        if isinstance(old, Parameter):
            return self
        if isinstance(old, Signal):
            raise UsageError(f"{name} is a signal of model {self.name}, not a constant")
        from casest.declaration.symbols import param

        if old.frozen is not None:
            return self._with(
                name, replace(old.frozen, start=tuple(old.frozen.shape.pack(old.array)))
            )
        shape: Any = old.array.shape if old.dims else None
        return self._with(name, named(param(shape, old.unit, start=old.array), name))

    def scoped(self, name: str, scope: Scope) -> Model:
        """A model in which the parameter is shared by all runs ("all") or one per run ("run")."""
        old = self[name]
        if not isinstance(old, Parameter):
            raise UsageError(f"{name} is not a parameter of model {self.name}: it has no scope")
        return self._with(name, replace(old, scope=scope))

    def with_effect(
        self,
        added: Effect,
        *,
        on: str | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> Model:
        """A model with one more effect. `on` and `columns` say where, if not as declared.

        Raises UsageError where the effect is not applicable: its quantity or signal does not
        exist here.
        """
        form = added.otherwise
        if form is None:
            place = on or (self._rate(added, columns or {}) if added.on == RATES else added.on)
            return self._with_effect(added, place, dict(columns or {}), on)
        try:
            return self.with_effect(replace(added, otherwise=None), on=on, columns=columns)
        except (UsageError, DeclarationError):  # of another quantity, or of other axes
            same = ("name", "on", "typical", "shown_by", "foreign_to", "only_of")
            told = {n: getattr(added, n) for n in same}
            said = form.formula or added.formula
            return self.with_effect(replace(form, **told, formula=said), on=on, columns=columns)

    @cached_property
    def rates(self) -> Mapping[str, str]:
        """Rates of states that may lack something (`rate of speed`), and the state of each."""
        return rates_of(self.staged.quantities, self.staged.stages)

    def _rate(self, added: Effect, columns: Mapping[str, str]) -> str:
        """The rate that an effect on any acts on: that of the state that it reads, or the one."""
        own = [columns.get(name) for name, what in added.columns if what == "itself"]
        found = [rate for rate, state in self.rates.items() if not own or state in own]
        if len(found) == 1:
            return found[0]
        there = f"it has {', '.join(self.rates)}" if self.rates else "it follows none"
        raise UsageError(
            f"effect {added.name} is not applicable to model {self.name}: it acts on the rate of a "
            f"state, say of which; {there}"
        )

    def _with_effect(
        self, added: Effect, target: str, columns: dict[str, str], on: str | None
    ) -> Model:
        label = label_of(added, target, columns, moved=on is not None and on != added.on)
        taken = {a.label for a in self.effects}
        if label in taken:
            raise UsageError(f"model {self.name} already has the effect {label}")
        attached = self._attached(added, target, columns, label)
        shapes = {n: (q.declared.size1(), q.declared.size2()) for n, q in self.quantities.items()}
        shape = (1, 1) if attached.kind == "time" else self._target_shape(target)
        check_null(attached, shape, shapes)
        made = replace(self, effects=(*self.effects, attached))
        made.__dict__["resting"] = self.resting  # that is the body's, and to look takes a trace
        if why := made._not_applicable(attached):
            raise UsageError(f"effect {label} is not applicable to model {self.name}: {why}")
        return made

    def _not_applicable(self, attached: Attached) -> str:
        """Why an effect of this model does nothing in it, or cannot be; else empty."""
        on = attached.on
        if self.sequential:
            try:
                traced = self.staged
            except DeclarationError as error:
                return str(error)
            found = [stage.given for stage in traced.stages if stage.attached is attached]
            reached = ca.vertcat(traced.expression, *(stage.taken for stage in traced.stages))
            if found and not ca.depends_on(reached, found[0]):
                return f"its residual does not depend on {on}"
        if attached.kind in ("quantity", "signal") and not _reaches_residual(self, attached):
            if on in self.quantities and "t" in {s.name for s in attached.effect.extras}:
                return f"how fast {on} changes is unknown: it is not declared as a function of t"
            return f"its residual does not depend on {on}"
        return ""

    def _attached(
        self, added: Effect, target: str, columns: Mapping[str, str], label: str
    ) -> Attached:
        kind, dims, unit = self._place(added, target)
        signals = {s.name: s.unit for s in self.signals}
        for s in added.extras:
            own = signals.get(columns.get(s.name, s.name))
            if not (s.unit and own and known(s.unit) and known(own)):
                continue
            if size(s.unit) != size(own):
                raise UnitError(
                    f"effect {label} reads {s.name} in {s.unit}, and model {self.name} has it in "
                    f"{own}: declare {s.name}=signal({own!r})"
                )
        inner = tuple(name for name in self.quantities if name not in signals)
        units = {name: self.quantities[name].unit or "1" for name in inner}
        return attach(added, target, kind, dims, {**units, target: unit}, columns, label, inner)

    def _target_shape(self, target: str) -> tuple[int, int]:
        if target in self.quantities:
            shape = self.quantities[target].declared.shape
            return (int(shape[0]), int(shape[1]))
        if target == NOISE:
            return (1, 1)
        return (3, 3) if self[target].kind == "rotation" else (self[target].size, 1)

    def _place(self, added: Effect, target: str) -> tuple[Kind, tuple[int, ...], str]:
        if target == NOISE:
            return "noise", (), "1"
        if target in self.quantities:
            found = self.quantities[target]
            if added.kind != "sequence":
                return "quantity", found.dims, found.unit
            self._check_sequence(added)
            return "sequence", found.dims, found.unit
        # What another effect alone reads goes when that goes, and says nothing of the sensor.
        signals = {s.name: s for s in self.declared if isinstance(s, Signal)}
        if added.kind == "time":
            return "time", (), self._checked_recorded(added, target)
        if target in signals:
            dims = () if signals[target].size == 1 else (signals[target].size,)
            return "signal", dims, signals[target].unit or f"[{target}]"
        late = target == "t" and self.recorded
        raise UsageError(
            f"effect {added.name} is not applicable to model {self.name}: "
            f"it acts on {target!r}, and the model has {', '.join([*self.quantities, *signals])}"
            + (f"; what is recorded late: signal_lag({self.recorded[0]})" if late else "")
        )

    @property
    def recorded(self) -> tuple[str, ...]:
        """Signals that another instrument than the measured one may give, late: not t."""
        if self.implicit:
            return ()
        return tuple(s.name for s in self.signals if s.name not in ("t", *self.traced.readings))

    def _checked_recorded(self, added: Effect, target: str) -> str:
        """The unit of a recorded signal that comes at another time."""
        if target in self.recorded:
            return self[target].unit or f"[{target}]"
        why = f"{target} is what it measures" if target in self.symbols else f"it has no {target!r}"
        if target == "t":
            why = "t is the time of its samples"
        if target == RECORDED and self.recorded:
            why = "say of which signal"
        elif target == RECORDED:
            why = "it has no signal but the time and what it measures"
        if self.implicit:
            why = "its residual is no signal that could come late against another"
        there = f": it has {', '.join(self.recorded)}" if self.recorded else ""
        raise UsageError(
            f"effect {added.name} is not applicable to model {self.name}: {why}{there}"
        )

    def _check_sequence(self, added: Effect) -> None:
        if self.implicit:
            raise UsageError(
                f"effect {added.name} is not applicable to model {self.name}: it acts on the "
                "sequence of predicted readings, and this model's residual is no reading"
            )

    def start(self, function: Callable[..., Any]) -> Model:
        """Decorator: start values from the data, `def NAME(model, runs) -> {parameter: value}`.

        As with a property's setter, the decorated name becomes the model, so it must be the
        model's own name.
        """
        if function.__name__ != self.function.__name__:
            raise DeclarationError(
                f"@{self.function.__name__}.start decorates a function of the same name "
                f"(`def {self.function.__name__}(model, runs)`), not {function.__name__!r}: "
                "the name becomes the model with its start values"
            )
        return self.starting(function)

    def starting(
        self, function: Callable[..., Any], *, many: Callable[..., Any] | None = None
    ) -> Model:
        """A model with start values from the data: `function(model, runs) -> {name: value}`.

        `many` gives those of many sensors at once, for `calibrate_many`, which says what it takes.
        """
        return replace(self, starter=function, starter_of_many=many)

    def bounded(self, function: Callable[..., Any]) -> Model:
        """A model with bounds from the data: `function(model, runs) -> {name: (lower, upper)}`."""
        return replace(self, limiter=function)

    def remarking(self, function: Callable[..., Any]) -> Model:
        """A model that comments on its fits: `function(model, runs, values) -> sentences`."""
        return replace(self, remarker=function)

    def refusing(self, function: Callable[..., Any]) -> Model:
        """A model that refuses fits: `function(model, runs, values) -> sentences`, or none."""
        return replace(self, refuser=function)

    def canonical(self, function: Callable[..., Any]) -> Model:
        """A model that says which of equivalent values it means.

        `function(model, values) -> values`: an angle within a turn, say. Per-run values come with
        a leading run axis if there are several runs.
        """
        return replace(self, canonicaliser=function)

    def with_inverse(self, function: Callable[..., Any]) -> Model:
        """A model with a closed form of its correction: `function(values, reading) -> corrected`.

        It is used as long as no effect has been added; without one the model is solved for it.
        """
        return replace(self, inverter=function)

    def with_estimator(self, name: str, function: Callable[..., Any]) -> Model:
        """A model that also knows the estimator `name` (model, runs) -> {parameter: value}."""
        return replace(self, estimators=(*self.estimators, (name, function)))

    # -- the body in symbols -------------------------------------------------------------------

    @cached_property
    def traced(self) -> Traced:
        """The body in CasADi symbols, with every effect in place."""
        return _traced(self)

    @cached_property
    def staged(self) -> Traced:
        """The body with a symbol in the place of what each effect gives that looks at others."""
        return _staged(self)

    @property
    def along(self) -> Traced:
        """The body in which values at samples are told: with states as they are there, and without
        effects that look at other samples."""
        return self.staged if self.traced.integrates else self.traced

    @cached_property
    def resting(self) -> bool:
        """Does the body look back to the rest before (`before`, `turned`)?"""
        return any(stage.word for stage in self.staged.stages)

    @cached_property
    def sequential(self) -> bool:
        """Does a sample's residual depend on others: by an effect, by equations, by rests?"""
        over_time = any(a.kind in OVER_TIME for a in self.effects)
        return over_time or self.traced.integrates or self.resting

    @property
    def reading(self) -> dict[str, Any]:
        """What `load_runs` is told of its signals, as keyword arguments.

        Of differential equations a reading may be missing, for the states go on; and inputs may be
        constant, as settings of an experiment are.
        """
        if not self.traced.integrates:
            return {}
        traced = self.staged
        needed = ca.vertcat(traced.predicted, *(s.entered for s in traced.stages))
        reached = {"t", *reached_signals(self, traced, needed)}
        gaps = tuple(s.name for s in self.signals if s.name not in reached)
        measured = {*traced.readings}
        return {
            "gaps": gaps,
            "steady": tuple(s.name for s in self.signals if s.name not in measured),
        }

    # -- numbers -------------------------------------------------------------------------------

    def __call__(self, **values: Any) -> dict[str, Array]:
        """Evaluate on plain numbers: signals (N, size) or (size,), parameters by name.

        Parameters that are not given take their declared start. Returns every quantity, the
        prediction (explicit models) and the residual, each with the sample axis first.
        """
        for name in values:
            if isinstance(self[name], Constant):
                raise UsageError(f"{name} is a constant of model {self.name}: having({name}=…)")
        missing = [s.name for s in self.signals if s.name not in values]
        if missing:
            raise UsageError(f"model {self.name} needs the signal {missing[0]!r}")
        if self.sequential:
            raise UsageError(
                f"model {self.name} has an effect on the sequence of samples, differential "
                "equations, or looks at the rest before: single samples have no prediction of "
                "their own; evaluate it on a run (leastsquares.problem)"
            )
        traced = self.traced
        outputs = {q.name: q.value for q in traced.quantities.values()}
        if traced.predicted is not None:
            outputs["predicted"] = traced.predicted
        outputs["residual"] = traced.expression
        f = function_of(self, outputs)
        samples = np.hstack([_rows(values[s.name], s) for s in self.signals])
        given = {p.name: values.get(p.name) for p in self.parameters}
        point = np.concatenate([np.zeros(0), *self.point(given)])
        results = [f.call([point, row]) for row in samples]
        return {
            name: np.array([np.array(result[k]).ravel() for result in results])
            for k, name in enumerate(outputs)
        }

    def point(self, values: Mapping[str, Any]) -> tuple[Array, Array]:
        """Coordinates and chart references of given parameter values (declared start if None)."""
        coordinates, references = [np.zeros(0)], [np.zeros(0)]
        for p in self.parameters:
            value = values.get(p.name)
            packed = p.start_value() if value is None else p.shape.pack(value)
            if p.shape.curved:
                coordinates.append(np.zeros(p.shape.coordinates))
                references.append(p.shape.reference(p.shape.unpack(packed)))
            else:
                coordinates.append(packed)
        return np.concatenate(coordinates), np.concatenate(references)

    def __str__(self) -> str:
        """Table of the model's symbols, and its equations."""
        return describe(self)


def model(function: Callable[..., Residual]) -> Model:
    """Declare a model: positional arguments are signals, keyword-only ones unknowns or numbers.

    Raises DeclarationError naming the argument whose declaration makes no sense.
    """
    name = function.__name__.replace("_", "-")
    declared: list[Symbol] = []
    for argument in inspect.signature(function).parameters.values():
        declared.append(_declared(name, argument))
    made = Model(name, function, tuple(declared))
    check_units_known(made.name, made.declared)
    return made


@lru_cache(maxsize=512)
def _traced(made: Model) -> Traced:
    found = trace(made)
    if made.noise is not None:
        return in_units_of_noise(found, made.noise)
    acting = any(a.kind in ("quantity", "signal") for a in made.effects)
    if found.residual.implicit is None or not acting:
        return found
    return sampson(made, found, trace(made, straight=True))


@lru_cache(maxsize=512)
def _staged(made: Model) -> Traced:
    found = trace(made, staged=True)
    return found if made.noise is None else in_units_of_noise(found, made.noise)


def _declared(model_name: str, argument: inspect.Parameter) -> Symbol:
    default: object = argument.default
    where = f"model {model_name}: {argument.name}"
    if argument.kind is argument.POSITIONAL_OR_KEYWORD:
        if not isinstance(default, Signal):
            raise DeclarationError(
                f"{where} comes before the * and must be signal(…), not {default!r}"
            )
        return replace(default, name=argument.name)
    if argument.kind is not argument.KEYWORD_ONLY:
        raise DeclarationError(
            f"{where}: a model takes signals, then *, then parameters and constants"
        )
    if isinstance(default, Parameter | Constant):
        return replace(default, name=argument.name)
    if isinstance(default, Signal):
        raise DeclarationError(f"{where} is a signal: signals come before the *")
    if isinstance(default, int | float) and not isinstance(default, bool):
        plain: Constant = constant(default)
        return replace(plain, name=argument.name)
    raise DeclarationError(f"{where} must be param(…), constant(…) or a number, not {default!r}")


def _reaches_residual(made: Model, attached: Attached) -> bool:
    """Does the residual depend on the effect's parameters at all, also by what it integrates?"""
    traced = made.staged if made.traced.integrates else made.traced
    flows = [ca.vertcat(s.rates, s.start) for s in traced.stages if isinstance(s, Flow)]
    reached = reached_parameters(made, traced, ca.vertcat(traced.expression, *flows))
    own = {p.name for p in attached.parameters}
    return not own or bool(own & reached)


def _rows(value: Any, declared: Signal) -> Array:
    return np.asarray(value, dtype=float).reshape(-1, declared.size)


def _stated(name: str, value: Any, unit: str) -> Constant:
    """A constant from a number, or from text with its unit."""
    if isinstance(value, str):
        try:
            value, stated = parse_quantity(value)
        except CasestError as error:
            raise type(error)(f"{name}: {error}") from None
        unit = stated or unit
    found: Constant = constant(value, unit)
    return found
