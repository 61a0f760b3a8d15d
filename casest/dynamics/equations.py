"""Declared differential equations as a model to calibrate: unknown constants, and the beginning.

Without driving noise a declaration says where its states go from where they begin, so that every
reading is a function of the unknowns: a model as any other, whose residual is integrated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol

import casadi as ca
import numpy as np

from casest import units
from casest.declaration.flow import integrated
from casest.declaration.model import Model
from casest.declaration.physics import (
    SX,
    Constraint,
    Residual,
    constraint,
    current_trace,
    quantity,
)
from casest.declaration.prior import Prior
from casest.declaration.shapes import array_shape
from casest.declaration.symbols import Constant, Parameter, Signal, Symbol, constant, make_parameter
from casest.declaration.travelling import reduced
from casest.errors import DeclarationError


class Declared(Protocol):
    """What is asked of a declaration; see `declare.Dynamics`."""

    @property
    def name(self) -> str:
        """As it is called."""

    @property
    def function(self) -> Any:
        """The body."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is recorded."""

    @property
    def states(self) -> tuple[Any, ...]:
        """States, and unknown constants, which have a parameter `of`."""

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Known numbers."""

    def moved(self, symbols: Mapping[str, Any]) -> Any:
        """What the body returns."""

    def rates_of(self, motion: Any) -> dict[str, SX]:
        """The rate of every state."""

    def measured_in(self, motion: Any, symbols: Mapping[str, SX]) -> list[str]:
        """Names of what is measured."""


@dataclass(frozen=True)
class Equations:
    """The body of the model that a declaration is: readings of states that follow their rates.

    States, and their rates as `rate of NAME`, are quantities, on which effects act.
    """

    declared: Any

    def __post_init__(self) -> None:
        """As the declared function is asked for: what it is called, and where it is."""
        function = self.declared.function
        for name in ("__name__", "__qualname__", "__module__", "__doc__", "__code__"):
            object.__setattr__(self, name, getattr(function, name))
        object.__setattr__(self, "__wrapped__", function)

    def __reduce__(self) -> tuple[Any, ...]:
        """To pickle: the declaration, its function by name."""
        return reduced(self)

    def __call__(self, **symbols: Any) -> Residual:
        """The residual, of signals, constants, parameters and beginnings by name."""
        declared, trace = self.declared, current_trace.get()
        assert trace is not None
        states = [s for s in declared.states if s.of is None]
        x = {s.name: ca.SX.sym(s.name, s.size) for s in states}
        inner = {s.name: quantity(s.name, x[s.name], s.unit) for s in states}
        outside = {n: v for n, v in symbols.items() if n not in {s.beginning for s in states}}
        motion = declared.moved({**outside, **inner})
        rates = _rates(states, motion, declared.rates_of(motion), with_units(declared))
        start = ca.vertcat(ca.SX(0, 1), *(ca.SX(symbols[s.beginning]) for s in states))
        anchored = any(s.known or s.stated for s in states)
        names = tuple(entry for s in states for entry in _entries(s.name, s.size))
        whole = ca.vertcat(ca.SX(0, 1), *x.values())
        _, put = integrated(trace, rates, whole, ca.densify(start), names, anchored=anchored)
        return self._residual(motion, symbols, put, tuple(_bounds(states, x)))

    def _residual(
        self, motion: Any, symbols: Mapping[str, SX], put: Any, within: tuple[Constraint, ...]
    ) -> Residual:
        """Readings against what is predicted of them, in standard deviations where these differ."""
        outputs, place = motion.outputs, f"dynamics {self.declared.name}"
        kept = tuple(
            replace(c, expression=put(c.expression)) for c in (*motion.constraints, *within)
        )
        if not outputs:
            raise DeclarationError(f"{place}: outputs= is empty: say what is measured(…)")
        names = self.declared.measured_in(motion, symbols)
        signals = {s.name: s for s in self.declared.signals}
        given = [signals[n].unit for n in names]
        unit, std = _weights(outputs, names, given, place)
        predicted = []
        for o, n in zip(outputs, names, strict=True):
            value = ca.SX(put(o.predicted))  # what is read of a state is not the state itself
            if value.numel() != o.signal.numel():
                raise DeclarationError(
                    f"{place}: {n} has {o.signal.numel()} numbers and its prediction "
                    f"{value.numel()}"
                )
            predicted.append(_near(o, value, signals[n].unit) if o.wraps else value)
        axes = tuple(entry for n in names for entry in _entries(n, signals[n].size))
        if len(outputs) == 1:
            only = outputs[0].signal, predicted[0], std[0] if std else None
            return Residual(
                measured=only[0],
                predicted=only[1],
                std=only[2],
                unit=unit,
                axes=axes,
                constraints=kept,
            )
        return Residual(
            measured=tuple(o.signal for o in outputs),
            predicted=tuple(predicted),
            std=std or None,
            unit=unit or f"[{names[0]}]",
            axes=axes,
            constraints=kept,
        )


def _bounds(states: Sequence[Any], x: Mapping[str, SX]) -> Iterator[Constraint]:
    """What the declared bounds of states say at every sample."""
    for s in states:
        for k in range(s.size):
            if np.isfinite(s.lower[k]):
                yield constraint(x[s.name][k], at_least=s.lower[k])
            if np.isfinite(s.upper[k]):
                yield constraint(x[s.name][k], at_most=s.upper[k])


def with_units(declared: Declared) -> bool:
    """Does a declaration state any unit? One that does not has none to check, of time neither."""
    every: list[str | None] = [s.unit for s in (*declared.states, *declared.constants)]
    every += [s.unit for s in declared.signals]
    every += [u for s in declared.states if s.of is not None for u in s.of.units]
    return bool({*every} - {None, "", "1"})


def _rates(states: Sequence[Any], motion: Any, found: Mapping[str, SX], united: bool) -> SX:
    """All rates, those that the body gives as quantities."""
    whole = [ca.SX(0, 1)]
    for s in states:
        if s.name in motion.rates:
            unit = per_second(s.unit) if united else ""
            whole.append(quantity(f"rate of {s.name}", found[s.name], unit))
        else:
            whole.append(found[s.name])
    return ca.densify(ca.vertcat(*whole))


def per_second(unit: str) -> str:
    """The unit of a rate: of rad/s it is rad/s^2, of degC K/s."""
    if unit in ("", "1"):
        return "1/s"
    if unit.endswith("/s") and unit.count("/") == 1:
        return f"{unit}^2"
    plain = "K" if unit == "degC" else unit
    return f"({plain})/s" if set("/*") & set(plain) else f"{plain}/s"


def _weights(
    outputs: Sequence[Any], names: Sequence[str], given: Sequence[str | None], place: str
) -> tuple[str, tuple[SX, ...]]:
    """Unit of the residual, and the std that each reading is divided by; none where all are alike.

    Raises DeclarationError where readings of different kinds are not weighed against each other.
    """
    stds = [_std(o) for o in outputs]
    alike = len(set(given)) == 1
    if alike and (all(s is None for s in stds) or len({s for s in stds}) == 1) and _number(stds[0]):
        return given[0] or "", ()
    for name, std in zip(names, stds, strict=True):
        if std is None:
            other = next((n for n in names if n != name), name)
            raise DeclarationError(
                f"{place}: {name} has no std, and weighs against {other} as its noise says: "
                f"measured({name}, …, std=…), also roughly; only their ratio matters"
            )
    return "1", tuple(
        ca.SX(s) * ca.SX.ones(o.signal.numel()) for s, o in zip(stds, outputs, strict=True)
    )


def _std(output: Any) -> Any:
    """Standard deviation of one reading: a number, an expression, or None."""
    if output.std is None and output.intensity is not None:
        return float(np.sqrt(output.intensity))
    return output.std


def _number(std: Any) -> bool:
    return std is None or isinstance(std, float)


def _near(output: Any, predicted: SX, unit: str | None) -> SX:
    """An angle by full turns as near to its reading as it comes."""
    turn = 2 * np.pi / units.size(unit or "rad")[0]
    return predicted + turn * ca.floor((output.signal - predicted) / turn + 0.5)


def _entries(name: str, size: int) -> tuple[str, ...]:
    return (name,) if size == 1 else tuple(f"{name}[{i}]" for i in range(size))


@lru_cache(maxsize=64)
def calibration(declared: Any) -> Model:
    """The model that a declaration without driving noise is.

    Unknowns are the declared ones, and for each run the states at the beginning that are not known,
    as `NAME_start`. Raises DeclarationError where the declaration is no calibration.
    """
    if declared.driven_by_noise:
        raise DeclarationError(
            f"{declared.name} has driving noise: it is an estimator in motion (casest filter, "
            "close or observe it); without intensity= it is a calibration"
        )
    symbols: list[Symbol] = [*declared.signals, *declared.unknown_constants, *declared.constants]
    symbols += _beginnings(declared)
    model = Model(declared.name, Equations(declared), tuple(symbols))
    return replace(model, prior=_known_before(declared, model))


def _known_before(declared: Declared, model: Model) -> Prior | None:
    """What the declaration says of where states begin, with std=; None where of none."""
    own = [s for s in declared.states if s.of is None and s.stated]
    if not own:
        return None
    variances = np.concatenate([np.full(s.size, s.std**2) for s in own])
    return Prior(
        tuple(s.beginning for s in own),
        tuple(s.start for s in own),
        tuple(() if s.size == 1 else (s.size,) for s in own),
        tuple(map(tuple, np.diag(variances).tolist())),
        _noise_of_a_residual(declared, model),
        f"std= of {' and '.join(s.name for s in own)}",
    )


def _noise_of_a_residual(declared: Declared, model: Model) -> float | None:
    """Its standard deviation by what measured(…) says; None where it says nothing."""
    traced = model.traced
    if traced.residual.std is not None:
        return 1.0
    states = {s.name: ca.SX.sym(s.name, s.size) for s in declared.states if s.of is None}
    known = {
        n: v for n, v in traced.symbols.items() if n not in {s.beginning for s in declared.states}
    }
    found = _std(declared.moved({**known, **states}).outputs[0])
    return None if found is None else float(found)


def _beginnings(declared: Declared) -> Iterator[Symbol]:
    """What every state begins with: a constant where it is known, else an unknown of each run."""
    taken = {s.name for s in declared.states} | {s.name for s in declared.signals}
    for s in declared.states:
        if s.of is not None:
            continue
        if s.beginning in taken | {c.name for c in declared.constants}:
            raise DeclarationError(
                f"dynamics {declared.name}: {s.beginning} is what {s.name} begins with: give "
                "another name"
            )
        shape = array_shape(None if s.size == 1 else s.size)
        start: Any = s.start[0] if s.size == 1 else list(s.start)
        free: Parameter = make_parameter(shape, s.unit if s.unit != "1" else "", start, None, "run")
        free = replace(free, name=s.beginning, lower=s.lower, upper=s.upper)
        if s.known:
            fixed: Constant = constant(start, free.unit)
            yield replace(fixed, name=s.beginning, frozen=free)
        else:
            yield free
