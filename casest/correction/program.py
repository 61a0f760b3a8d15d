"""A correction as a list of scalar operations, independent of CasADi and of the model's source.

One list serves all targets, so that they agree to rounding. `direct`: the outputs are the
corrected values (an implicit relation, the model's own closed form, or one that is linear in the
reading). `newton`: the inputs are followed by a trial value, the outputs are the step to the
solution and what is left of the reading; the target iterates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from casest.correction.inverse import Correction
from casest.declaration.shapes import Array
from casest.engine.operations import operation_of
from casest.errors import UsageError


@dataclass(frozen=True)
class Input:
    """A signal that the correction needs: its name, how many numbers, and their unit."""

    name: str
    size: int
    unit: str


@dataclass(frozen=True)
class Program:
    """A straight line of operations on registers.

    `steps` are [operation, register, operands…]: "input" has the number of the input, "constant"
    a value, "output" (with the register as operand) the number of the output. `starts` are the
    levels where Newton's method begins, the reading itself among them where `from_reading`;
    `measured` is the place of the reading among the inputs. `left` are effects that stay in.
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

    @property
    def width(self) -> int:
        """Numbers per sample."""
        return sum(i.size for i in self.inputs)


def program(
    correction: Correction,
    values: Mapping[str, Any],
    units: Mapping[str, str],
    around: tuple[float, float] | None,
    largest: float,
) -> Program:
    """The correction with its parameters put in as numbers.

    `around` is the range that the corrected quantity had in the fit, `largest` the size of the
    largest reading there, both for Newton's method.
    """
    model = correction.model
    kind, function = correction.as_function()
    parameters = np.concatenate(model.point(dict(values)))
    inputs = tuple(Input(s.name, s.size, units.get(s.name, "")) for s in correction.signals)
    bound = _bound(function, parameters, correction, inputs, trial=kind == "newton")
    steps, registers = _steps(bound)
    output = Input(correction.name, correction.size, units.get(correction.name, ""))
    if kind == "direct":
        return Program(model.name, "direct", inputs, output, registers, steps)
    levels = [] if around is None else [0.5 * sum(around), around[0], around[1]]
    names = [i.name for i in inputs]
    at = names.index(correction.measured)
    measured = sum(i.size for i in inputs[:at]), inputs[at].size
    starts = (*levels, 0.0, 1.0, -1.0, 100.0, -100.0)
    middle = levels[0] if levels else 0.0
    return Program(
        model.name, "newton", inputs, output, registers, steps, starts, middle, measured, largest
    )


def _bound(
    function: Any,
    parameters: Array,
    correction: Correction,
    inputs: Sequence[Input],
    trial: bool,
) -> Any:
    """The function of the needed inputs alone (and the trial value), parameters put in."""
    x = ca.SX.sym("x", sum(i.size for i in inputs) + (correction.size if trial else 0))
    wanted, place = {}, 0
    for i in inputs:
        wanted[i.name] = x[place : place + i.size]
        place += i.size
    sample = [wanted.get(s.name, ca.SX.zeros(s.size)) for s in correction.model.signals]
    arguments = [ca.SX(ca.DM(parameters)), ca.vertcat(*sample)]
    if trial:
        arguments[1] = ca.vertcat(arguments[1], x[place:])
    out = ca.simplify(ca.densify(function(*arguments)))
    return ca.Function("correction", [x], [ca.densify(out)])


def _steps(function: Any) -> tuple[tuple[tuple[Any, ...], ...], int]:
    """The instruction list of a CasADi function of one input and one output."""
    found: list[tuple[Any, ...]] = []
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        ins, outs = function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_CONST:
            found.append(("constant", outs[0], float(function.instruction_constant(k))))
        elif op == ca.OP_INPUT:
            found.append(("input", outs[0], ins[1]))
        elif op == ca.OP_OUTPUT:
            found.append(("output", outs[1], ins[0]))
        else:
            operation = operation_of(op, "the correction")
            if operation.numpy is None:
                raise UsageError(
                    f"the correction uses the operation {operation.name}, which is not exported:"
                    " write the model without it, or correct with casest apply"
                )
            found.append((operation.name, outs[0], *ins[: operation.arity]))
    return tuple(found), int(function.sz_w())
