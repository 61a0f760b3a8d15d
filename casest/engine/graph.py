"""The instruction list of a CasADi SX function as a graph of values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from casest.engine.operations import BY_CODE, operation_of

PARAMETER = 0  # which input
SAMPLE = 1
_CONSTANT, _INPUT, _OUTPUT = ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT
_COMMUTATIVE = frozenset(code for code, operation in BY_CODE.items() if operation.commutative)


class Value(NamedTuple):
    """One value of the single-assignment form: a constant, an input entry or an operation."""

    kind: str  # "constant", "parameter", "sample" or "operation"
    code: int = 0  # index into the input, or CasADi's operation
    operands: tuple[int, ...] = ()
    constant: float = 0.0
    per_sample: bool = False


class Graph:
    """The instruction list in single-assignment form, with equal values merged.

    `values` are in order of computation; `outputs[i][j]` is the value of nonzero j of output i.
    """

    def __init__(self, function: Any) -> None:
        self.values: list[Value] = []
        self.outputs = [[-1] * function.nnz_out(i) for i in range(function.n_out())]
        self._known: dict[object, int] = {}
        register: dict[int, int] = {}
        where = f"function {function.name()!r}"
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            target = function.instruction_output(k)
            if code == _CONSTANT:
                constant = float(function.instruction_constant(k))
                register[target[0]] = self.add(Value("constant", constant=constant))
                continue
            source = function.instruction_input(k)
            if code == _OUTPUT:
                self.outputs[target[0]][target[1]] = register[source[0]]
            elif code == _INPUT:
                register[target[0]] = self.add(_input(source[0], source[1]))
            elif operation_of(code, where).same:
                register[target[0]] = register[source[0]]
            else:
                operands = [register[i] for i in source]
                register[target[0]] = self.operation(code, operands)

    def needed(self, wanted: Iterable[int]) -> list[int]:
        """Values that these take, in order of computation."""
        found: set[int] = set()
        stack = list(wanted)
        while stack:
            i = stack.pop()
            if i not in found:
                found.add(i)
                stack.extend(self.values[i].operands)
        return sorted(found)

    def operation(self, code: int, operands: Sequence[int]) -> int:
        """The number of an operation on values of the graph, added where there is no equal one."""
        key = (code, *(sorted(operands) if code in _COMMUTATIVE else operands))
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = len(self.values)
            per_sample = True in [self.values[i].per_sample for i in operands]
            self.values.append(Value("operation", code, key[1:], 0.0, per_sample))
        return known

    def add(self, value: Value) -> int:
        """The number of a constant or an input, added where there is no equal one."""
        # Constants by their bits, to keep -0.0 from 0.0.
        constant = value.kind == "constant"
        key: object = np.float64(value.constant).tobytes() if constant else value
        if key not in self._known:
            self._known[key] = len(self.values)
            self.values.append(value)
        return self._known[key]


def _input(which: int, index: int) -> Value:
    if which == PARAMETER:
        return Value("parameter", index)
    return Value("sample", index, per_sample=True)
