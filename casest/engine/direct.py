"""CasADi functions called without CasADi's matrices: quicker where little is computed."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from casest.engine.operations import Floats


class Bound:
    """A function of dense matrices and the arrays that it reads and writes, overwritten by calls.

    CasADi's matrices are column by column: a row of these arrays is one of its columns.
    """

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._call = function.buffer()
        f, inputs, outputs = function, range(function.n_in()), range(function.n_out())
        self.given = [np.empty((int(f.size2_in(i)), int(f.size1_in(i)))) for i in inputs]
        self._found = [np.empty((int(f.size2_out(i)), int(f.size1_out(i)))) for i in outputs]
        for i, array in enumerate(self.given):
            if array.size:  # a view of nothing has no address
                self._buffer.set_arg(i, _view(array))
        for i, array in enumerate(self._found):
            if array.size:
                self._buffer.set_res(i, _view(array))

    def __call__(self) -> list[Floats]:
        """Compute, and return the arrays that were written."""
        self._call()
        return self._found


class Direct:
    """A function of vectors."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._idle: list[Bound] = []

    def __call__(self, *arguments: Floats) -> list[Floats]:
        """Every output, as a vector."""
        # Taken off the shelf while in use: two threads never share one.
        bound = self._idle.pop() if self._idle else Bound(self._function)
        for own, argument in zip(bound.given, arguments, strict=True):
            own[0] = argument
        found = [array.ravel().copy() for array in bound()]
        self._idle.append(bound)
        return found


def _view(array: Floats) -> Any:
    return memoryview(array)  # type: ignore[arg-type]
