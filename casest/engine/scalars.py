"""Values that do not depend on the sample: computed once per call, one after the other.

As Python's numbers: one addition takes NumPy several times as long as Python.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from casest.engine.graph import Graph, Value
from casest.engine.operations import BY_CODE, Floats

#: What is done with two earlier numbers, the second of which may be the first again.
Step = tuple[Callable[[float, float], float], int, int]


class Scalars:
    """Some values of a graph and all that they take; `place` says where each is in the result."""

    def __init__(self, graph: Graph, wanted: Iterable[int]) -> None:
        numbers = {i: graph.values[i] for i in graph.needed(wanted)}
        constants = [i for i, value in numbers.items() if value.kind == "constant"]
        given = [i for i, value in numbers.items() if value.kind == "parameter"]
        computed = [i for i, value in numbers.items() if value.kind == "operation"]
        self.place = {i: k for k, i in enumerate([*constants, *given, *computed])}
        self._constants = [numbers[i].constant for i in constants]
        self._codes = [numbers[i].code for i in given]
        self._steps = [self._step(numbers[i]) for i in computed]

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.place)

    def __call__(self, parameters: Floats) -> list[float]:
        """All of them at some parameters (n,)."""
        given = parameters.tolist()
        found = [*self._constants, *(given[code] for code in self._codes)]
        for do, a, b in self._steps:
            found.append(do(found[a], found[b]))
        return found

    def _step(self, value: Value) -> Step:
        first, last = (self.place[value.operands[k]] for k in (0, -1))
        do = BY_CODE[value.code].python or _by_numpy(value.code, len(value.operands))
        return do, first, last


def _by_numpy(code: int, count: int) -> Callable[[float, float], float]:
    kernel = BY_CODE[code].kernel

    def compute(*numbers: float) -> float:
        if isinstance(kernel, np.ufunc):
            return float(kernel(*numbers[:count]))
        out = np.empty(())
        kernel(*map(np.float64, numbers[:count]), out)
        return float(out)

    return compute
