"""Differential equations in a model's body: states that follow their rates along the record.

In a trace that keeps what looks at other samples apart (`staged`) the states at a sample are
symbols, which `leastsquares.flow` gives values and slopes; in any other they are the states at the
beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from casest.declaration.effect import RATE
from casest.declaration.physics import SX, Quantity, Trace, current_trace
from casest.errors import DeclarationError


@dataclass(frozen=True)
class Flow:
    """ẋ = rates(x, inputs, parameters) from `start`; `given` stands for x at every sample.

    `inputs` (k,) are symbols of the rates, `taken` what they are at a sample: a straight line
    between two, or as at the one before where `held`; `clock` says which of them is the time.
    `names` of the numbers of x. `anchored`: it begins at t = 0, not at the first sample.
    """

    x: SX
    rates: SX
    start: SX
    given: SX
    names: tuple[str, ...]
    anchored: bool = False
    inputs: SX = None
    taken: SX = None
    held: tuple[bool, ...] = ()
    clock: int | None = None
    attached: None = None
    word: str = ""

    @property
    def entered(self) -> SX:
        """All by which parameters enter."""
        return ca.vertcat(self.taken, self.rates, self.start)


def integrate(rates: Callable[[SX], Any], states: Any, *, over: SX) -> SX:
    """The state at every sample that begins as `states` and follows its rates.

    `rates(x)` gives ẋ, of the parameters, of signals and of x, which has the shape of `states`;
    `over` is the signal of the time. It begins at the first sample of each run. Inputs are straight
    lines between samples, or held where their signals are declared so.
    """
    trace = current_trace.get()
    if trace is None:
        raise DeclarationError("integrate(…) belongs in the body of a @model function")
    if not (isinstance(over, ca.SX) and over.is_symbolic()):
        raise DeclarationError("integrate(…, over=t): `over` is the signal of the time itself")
    start = ca.densify(ca.vec(ca.SX(states)))
    x = ca.SX.sym("x", start.numel())
    names = tuple(f"state[{i}]" for i in range(start.numel()))
    found = ca.densify(ca.vec(ca.SX(rates(x))))
    return integrated(trace, found, x, start, names)[0]


def integrated(
    trace: Trace, rates: SX, x: SX, start: SX, names: tuple[str, ...], *, anchored: bool = False
) -> tuple[SX, Callable[[SX], SX]]:
    """The states at every sample, and a function that puts them into what is written in x."""
    if rates.numel() != x.numel():
        raise DeclarationError(f"{rates.numel()} rates for {x.numel()} states: give one for each")
    given = ca.SX.sym("state", x.numel()) if trace.staged else start
    if trace.staged:
        trace.stages.append(Flow(x, rates, start, given, names, anchored))
    trace.integrates = True
    moved: dict[int, SX] = {}

    def put(expression: SX) -> SX:
        if id(expression) in moved:
            return moved[id(expression)]
        return ca.substitute(ca.SX(expression), x, given)

    for name, q in trace.quantities.items():
        if ca.depends_on(ca.vec(q.value), x) or ca.depends_on(ca.vec(q.declared), x):
            value, handed = put(q.value), trace.handed[name]
            moved[id(q.value)] = value
            moved[id(handed)] = value if handed is q.value else put(handed)
            trace.handed[name] = moved[id(handed)]
            trace.quantities[name] = replace(q, declared=put(q.declared), value=value)
    return given, put


def rates_of(quantities: Mapping[str, Quantity], stages: Sequence[Any]) -> dict[str, str]:
    """Rates that may lack something, with the state of each: not those that are a state.

    A rate that is another state by definition lacks nothing.
    """
    flows = [stage for stage in stages if isinstance(stage, Flow)]
    given = {s.element_hash() for flow in flows for s in ca.vertsplit(flow.given)}
    found = {}
    for name, quantity in quantities.items():
        state = name.removeprefix(RATE)
        if state == name or state not in quantities:
            continue
        parts = ca.vertsplit(ca.densify(quantity.declared))
        if not all(p.is_symbolic() and p.element_hash() in given for p in parts):
            found[name] = state
    return found


def with_inputs(
    stages: Sequence[Any], unknown: SX, held: Mapping[int, bool], clock: SX | None
) -> list[Any]:
    """The stages, those that are flows with the inputs that their rates read.

    `unknown`: the parameters' symbols; `held`: of each signal's symbol by its hash.
    """
    own = {s.element_hash() for s in ca.symvar(ca.SX(unknown))}
    time = None if clock is None else clock.element_hash()
    found = []
    for stage in stages:
        if not isinstance(stage, Flow):
            found.append(stage)
            continue
        states = {s.element_hash() for s in ca.symvar(stage.x)}
        inputs = [s for s in ca.symvar(stage.rates) if s.element_hash() not in own | states]
        hashes = [s.element_hash() for s in inputs]
        symbols = ca.vertcat(ca.SX(0, 1), *inputs)
        how = tuple(held.get(h, False) for h in hashes)
        place = hashes.index(time) if time in hashes else None
        found.append(replace(stage, inputs=symbols, taken=symbols, held=how, clock=place))
    _refuse_memory_within(found)
    return found


def _refuse_memory_within(stages: Sequence[Any]) -> None:
    """What looks at other samples cannot act inside what is followed between them."""
    inner = [stage.x for stage in stages if isinstance(stage, Flow)]
    for stage in stages:
        if stage.attached is not None and inner and ca.depends_on(stage.taken, ca.vertcat(*inner)):
            raise DeclarationError(
                f"{stage.attached.label} looks at other samples and cannot act on "
                f"{stage.attached.on}, which is inside differential equations"
            )
