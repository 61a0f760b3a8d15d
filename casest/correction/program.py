"""A correction as a list of scalar operations, independent of CasADi and of the model's source.

One list serves all targets, so that they agree to rounding. `direct`: the outputs are the
corrected values (an implicit relation, the model's own closed form, or one that is linear in the
reading). `newton`: the inputs are followed by a trial value, the outputs are the step to the
solution and what is left of the reading; the target iterates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from casest.correction.inverse import Correction
from casest.declaration.shapes import Array
from casest.engine.operations import OPERATIONS, operation_of
from casest.errors import UsageError


@dataclass(frozen=True)
class Input:
    """A signal that the correction needs: its name, how many numbers, and their unit."""

    name: str
    size: int
    unit: str
    kind: Literal["plain", "rotation"] = "plain"


@dataclass(frozen=True)
class Program:
    """A straight line of operations on registers.

    `steps` are [operation, register, operands…]: "input" has the number of the input, "constant"
    a value, "output" (with the register as operand) the number of the output. `starts` are the
    levels where Newton's method begins, the reading itself among them where it has as many numbers
    as what is corrected; `measured` is the place of the reading among the inputs. `left` are
    effects that stay in. `seen`: least and greatest of each input of the fit, None where it is no
    matter. `own` numbers of one run follow the inputs (and the trial value): see `of_run`.
    """

    model: str
    kind: Literal["direct", "newton"]
    inputs: tuple[Input, ...]
    output: Input
    registers: int
    steps: tuple[tuple[Any, ...], ...]
    starts: tuple[float, ...] = ()
    middle: float = 0.0
    measured: tuple[int, int] | None = None
    largest: float = 1.0
    left: tuple[str, ...] = ()
    own: int = 0
    seen: tuple[tuple[float, float] | None, ...] = ()

    @property
    def width(self) -> int:
        """Numbers per sample."""
        return sum(i.size for i in self.inputs)

    def of_run(self, numbers: Sequence[float]) -> Program:
        """The program of one run: its own numbers put in."""
        if len(numbers) != self.own:
            raise ValueError(f"{len(numbers)} numbers of a run, not {self.own}")
        first = self.width + (self.output.size if self.kind == "newton" else 0)
        steps = tuple(
            ("constant", step[1], float(numbers[step[2] - first]))
            if step[0] == "input" and step[2] >= first
            else step
            for step in self.steps
        )
        return replace(self, steps=steps, own=0)


def program(
    correction: Correction,
    values: Mapping[str, Any],
    units: Mapping[str, str],
    around: tuple[float, float] | None,
    largest: float,
    differing: Sequence[int] = (),
) -> Program:
    """The correction with its parameters put in as numbers.

    `around` is the range that the corrected quantity had in the fit, `largest` the size of the
    largest reading there, both for Newton's method. Entries of the model's point that are
    `differing` between runs stay inputs.
    """
    model = correction.model
    kind, function = correction.as_function()
    parameters = np.concatenate(model.point(dict(values)))
    inputs = tuple(Input(s.name, s.size, units.get(s.name, ""), s.kind) for s in correction.signals)
    if not inputs:
        raise UsageError(
            f"model {model.name}: {correction.name} is computed from no signal: there is nothing "
            "to correct"
        )
    bound = _bound(function, parameters, correction, differing, trial=kind == "newton")
    steps, registers = steps_of(bound, "the correction")
    output = Input(correction.name, correction.size, units.get(correction.name, ""))
    built = Program(model.name, kind, inputs, output, registers, steps, own=len(differing))
    if kind == "direct":
        return built
    levels = [] if around is None else [0.5 * sum(around), around[0], around[1]]
    names = [i.name for i in inputs]
    at = names.index(correction.measured)
    measured = sum(i.size for i in inputs[:at]), inputs[at].size
    starts = (*levels, 0.0, 1.0, -1.0, 100.0, -100.0)
    middle = levels[0] if levels else 0.0
    return replace(built, starts=starts, middle=middle, measured=measured, largest=largest)


def _bound(
    function: Any, parameters: Array, correction: Correction, differing: Sequence[int], trial: bool
) -> Any:
    """The function of the needed inputs alone (trial value, numbers of a run), parameters in."""
    needed = [s.name for s in correction.signals]
    width = sum(s.size for s in correction.signals)
    last = width + (correction.size if trial else 0)
    x = ca.SX.sym("x", last + len(differing))
    wanted, place = {}, 0
    for s in correction.signals:
        wanted[s.name] = x[place : place + s.size]
        place += s.size
    signals = correction.model.signals
    sample = [wanted[s.name] if s.name in needed else ca.SX.zeros(s.size) for s in signals]
    point = ca.SX(ca.DM(parameters))
    for k, entry in enumerate(differing):
        point[entry] = x[last + k]
    sample += [x[width:last]] if trial else []
    out = ca.simplify(ca.densify(function(point, ca.vertcat(*sample))))
    return ca.Function("correction", [x], [ca.densify(out)])


def steps_of(function: Any, what: str) -> tuple[tuple[tuple[Any, ...], ...], int]:
    """The instruction list of a CasADi function of one input and one output, and its registers;
    `what` it is, in an error about an operation that there is not."""
    found: list[tuple[Any, ...]] = []
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        ins, outs = function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_CONST:
            found.extend(_constant(outs[0], float(function.instruction_constant(k))))
        elif op == ca.OP_INPUT:
            found.append(("input", outs[0], ins[1]))
        elif op == ca.OP_OUTPUT:
            found.append(("output", outs[1], ins[0]))
        else:
            operation = operation_of(op, what)
            found.append((operation.name, outs[0], *ins[: operation.arity]))
    return tuple(found), int(function.sz_w())


def _constant(place: int, value: float) -> Iterator[tuple[Any, ...]]:
    """A constant; JSON has no infinity, so that one is computed."""
    if np.isfinite(value):
        yield "constant", place, value
        return
    yield "constant", place, 1e308
    yield "mul", place, place, place
    if np.isnan(value):
        yield "sub", place, place, place
    elif value < 0:
        yield "neg", place, place


def refuse_unexported(built: Program) -> None:
    """Raise UsageError where the program has an operation that other languages lack."""
    for operation in OPERATIONS:
        if operation.numpy is None and operation.name in {step[0] for step in built.steps}:
            raise UsageError(
                f"the correction uses the operation {operation.name}, which is not exported:"
                " write the model without it, or correct with casest apply"
            )
