"""A step that begins where the one before ended, over a whole record: a filter's, a simulation's.

CasADi's virtual machine runs the step's instructions; compiled by the machine's C compiler they run
ten times as fast and give the same digits. Compiling takes half a second: it is done once so much
has been spent on replaying, and what is in the cache folder already is used at once.

Environment: as for the kernels.
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from casest.engine import lanes
from casest.engine.direct import Bound
from casest.engine.kernel import library
from casest.engine.operations import Floats

#: Steps that CasADi runs in one call, at most.
CHUNK = 512
#: Steps from which on the cache is looked at, and from which on a compiler is worthwhile.
LOOK, WORTHWHILE = 5_000, 60_000
#: No contraction: the digits are those of the virtual machine.
_FLAGS = [
    ["-O2", "-march=native", "-ffp-contract=off", "-fno-math-errno"],
    ["-O2", "-ffp-contract=off", "-fno-math-errno"],
]

#: Part p of what a step is given lies at part[p] + k·step[p], from k = late[p] on: read in place.
_LOOP = """
void casest_run(const double *state, const double **part, const long *step, const long *late,
                long n, double **out, int keep) {
  static const double none[%(wide)d];
  const double *from = state;
  const double *arg[%(arg)d];
  double *res[%(res)d], w[%(w)d];
  casadi_int iw[%(iw)d];
  static const long size[] = {%(sizes)s};
  for (long k = 0; k < n; ++k) {
    arg[0] = from;
    for (long p = 0; p < %(parts)d; ++p)
      arg[1 + p] = k < late[p] ? none : part[p] + (k - late[p]) * step[p];
    res[0] = out[0] + (keep ? k : k %% 2) * size[0];
    for (int i = 1; i < %(outputs)d; ++i) res[i] = out[i] + k * size[i];
    casest_step(arg, res, iw, w, 0);
    from = res[0];
  }
}
"""


class Recursion:
    """`step`: (state, numbers of one sample) -> (state, …), vectors; numbers in one or more parts.

    `instead`: a dearer step that is made where the last number of what `step` gives is above zero.
    """

    def __init__(self, step: ca.Function, instead: ca.Function | None = None) -> None:
        self._step = _shared(step, "casest_step")
        if instead is not None:
            self._step = _either(self._step, _shared(instead, "instead"))
        self.sizes = [int(step.numel_out(i)) for i in range(step.n_out())]
        self._widths = [int(step.numel_in(i)) for i in range(1, step.n_in())]
        self._replayed = 0
        self._library: ctypes.CDLL | None = None
        self._looked = self._built = False
        #: Chunks by their length, those that are not in use.
        self._chunks: dict[int, list[_Chunk]] = {}
        self._beside: dict[tuple[int, bool], Any] = {}

    def __call__(
        self, state: Floats, numbers: Floats | Sequence[Floats], *, keep: bool = True
    ) -> list[Floats]:
        """Every output of every step, (N, …) each; without `keep` the last state alone.

        `state`: what the first step begins from; `numbers` (N, …): what each step is given, an
        array a part; a shorter one is zero at the first steps.
        """
        parts = [_rows(p) for p in ([numbers] if isinstance(numbers, np.ndarray) else numbers)]
        assert [p.shape[1] for p in parts] == self._widths
        count = max(map(len, parts))
        state = np.ascontiguousarray(state, float).ravel()
        rows = [count if keep or i else 2 for i in range(len(self.sizes))]
        found = [np.empty((r, size)) for r, size in zip(rows, self.sizes, strict=True)]
        compiled = self._compiled(count)
        if compiled is None:
            last = self._replay(state, parts, found, keep)
            self._replayed += count
            return found if keep else [last[None], *found[1:]]
        compiled.casest_run(*_given(state, parts, count), _places(found), ctypes.c_int(keep))
        return found if keep else [found[0][[(count - 1) % 2]], *found[1:]]

    def beside(self, states: Floats, numbers: Floats) -> list[list[Floats]]:
        """Runs from several states (L, …) given the same numbers (N, …): what each gives, as the
        call without `keep`."""
        count = lanes.wide_enough(len(states))
        compiled = self._in_lanes(count, len(numbers)) if len(states) > 1 else None
        if compiled is None:
            return [self(state, numbers, keep=False) for state in states]
        several = []
        for first in range(0, len(states), count):
            own = states[first : first + count]
            rows = [1, *[len(numbers)] * (len(self.sizes) - 1)]
            found = [np.empty((r, s, count)) for r, s in zip(rows, self.sizes, strict=True)]
            state = lanes.interleaved(own, count)
            compiled.casest_lanes(*_given(state, [_rows(numbers)], len(numbers)), _places(found))
            several += [[f[:, :, lane] for f in found] for lane in range(len(own))]
        return several

    def along(self, states: Floats, numbers: Sequence[Floats]) -> list[Floats]:
        """The call from states[0], where others are known already: states (L, …) before the steps
        that `stretches` names. The same digits, the stretches side by side."""
        parts, count = [_rows(p) for p in numbers], len(numbers[0])
        assert [p.shape[1] for p in parts] == self._widths
        begin = lanes.stretches(count)
        compiled = self._in_lanes(len(begin), count, apart=True) if len(begin) > 1 else None
        if compiled is None:
            return self(states[0], numbers)
        found = [np.empty((count, size)) for size in self.sizes]
        state, steps = lanes.interleaved(states, len(begin)), [p.strides[0] // 8 for p in parts]
        compiled.casest_lanes(
            ctypes.c_void_p(state.ctypes.data),
            _places(parts),
            _longs(steps),
            _longs(begin.tolist()),
            ctypes.c_long(count - int(begin[-1])),
            _places(found),
        )
        return found

    def _in_lanes(self, count: int, steps: int, *, apart: bool = False) -> ctypes.CDLL | None:
        """Where the step itself is compiled, and for as many steps as that takes."""
        wish = os.environ.get("CASEST_KERNEL", "auto")
        if wish == "off":
            return None
        nothing = {"seen": 0, "looked": False, "library": None}
        own = self._beside.setdefault((count, apart), nothing)
        own["seen"] += steps if apart else count * steps
        due = wish == "always" or own["seen"] > WORTHWHILE
        if own["library"] is None and own["looked"] is not due:
            own["looked"] = due
            parts = len(self._widths)
            text = lanes.source(self._source(), self.sizes, parts, count, apart=apart)
            own["library"] = lanes.built(text, build=due)
        found: ctypes.CDLL | None = own["library"]
        return found

    def _compiled(self, count: int) -> ctypes.CDLL | None:
        wish = os.environ.get("CASEST_KERNEL", "auto")
        if wish == "off":
            return None
        due = wish == "always" or self._replayed + count > WORTHWHILE
        if self._library is None and due and not self._built:
            self._built = self._looked = True
            self._library = library(self._source(), _FLAGS)
        elif not self._looked and self._replayed + count >= LOOK:
            self._looked = True
            self._library = library(self._source(), _FLAGS, build=False)
        return self._library

    def _source(self) -> str:
        generator = ca.CodeGenerator("step.c")
        generator.add(self._step)
        sizes: dict[str, Any] = {name: getattr(self._step, f"sz_{name}")() + 1
                                 for name in ("arg", "res", "iw", "w")}  # fmt: skip
        sizes |= {"outputs": len(self.sizes), "sizes": ", ".join(map(str, self.sizes))}
        sizes |= {"parts": len(self._widths), "wide": max(self._widths, default=0) + 1}
        return str(generator.dump()) + _LOOP % sizes

    def _replay(
        self, state: Floats, given: Sequence[Floats], found: list[Floats], keep: bool
    ) -> Floats:
        """The last state; every output in `found`, states only with `keep`."""
        k, count = 0, max(map(len, given))
        while k < count:
            length = _length(count - k)
            idle = self._chunks.setdefault(length, [])
            # Taken off the shelf while in use: two threads never share one.
            chunk = idle.pop() if idle else _Chunk(self._step, length)
            span = slice(k, min(k + length, count))
            parts = chunk.run(state, given, span, count)
            for i, part in enumerate(parts):
                if keep or i:
                    found[i][span] = part[: span.stop - k]
            state = parts[0][span.stop - k - 1].copy()
            idle.append(chunk)
            k = span.stop
        return state


class _Chunk:
    """So many steps in one call of CasADi's, and the arrays that it reads and writes."""

    def __init__(self, step: ca.Function, length: int) -> None:
        self._all = Bound(step.mapaccum("steps", length))
        self._state, *self._given = self._all.given

    def run(
        self, state: Floats, parts: Sequence[Floats], span: slice, count: int
    ) -> Sequence[Floats]:
        """Every output of the steps of a span of all `count`; of those beyond it, no matter what.

        The arrays are overwritten by the next call.
        """
        self._state[0] = state
        size = span.stop - span.start
        for own, part in zip(self._given, parts, strict=True):
            missing = count - len(part)
            late = min(max(missing - span.start, 0), size)
            own[:late] = 0.0
            own[late:size] = part[span.start + late - missing : span.stop - missing]
            own[size:] = own[size - 1]
        return self._all()


def _shared(step: ca.Function, name: str) -> ca.Function:
    """The same of SX, what is computed twice computed once."""
    arguments = step.sx_in()
    return ca.Function(name, arguments, step.call(arguments), {"cse": True})


def _either(step: ca.Function, instead: ca.Function) -> ca.Function:
    """The step, or that instead where it says so; only one of them is computed then."""
    arguments = [ca.MX.sym(f"i{i}", step.size_in(i)) for i in range(step.n_in())]
    first = step.call(arguments)
    given = [ca.MX.sym(f"g{i}", step.size_out(i)) for i in range(step.n_out())]
    taken = ca.Function("taken", [*arguments, *given], instead.call(arguments))
    kept = ca.Function("kept", [*arguments, *given], given)
    chosen = ca.Function.if_else("chosen", taken, kept)
    found = chosen.call([first[-1][-1] > 0, *arguments, *first])
    return ca.Function("casest_step", arguments, found)


def _rows(part: Floats) -> Floats:
    """An array (N, …) as rows of numbers that lie one after the other; how far apart they are is of
    no matter."""
    size = math.prod(part.shape[1:])
    rows = np.asarray(part, float).reshape(len(part), size)
    even = rows.strides[0] % 8 == 0 and (size < 2 or rows.strides[1] == 8)
    return rows if even else np.ascontiguousarray(rows)


def _given(state: Floats, parts: Sequence[Floats], count: int) -> list[Any]:
    """Where a compiled run begins, and what it is given: parts of rows, some of them late."""
    steps, late = [p.strides[0] // 8 for p in parts], [count - len(p) for p in parts]
    return [
        ctypes.c_void_p(state.ctypes.data),
        _places(parts),
        _longs(steps),
        _longs(late),
        ctypes.c_long(count),
    ]


def _places(arrays: Sequence[Floats]) -> Any:
    return (ctypes.c_void_p * len(arrays))(*[array.ctypes.data for array in arrays])


def _longs(numbers: Sequence[int]) -> Any:
    return (ctypes.c_long * max(len(numbers), 1))(*numbers)


def _length(left: int) -> int:
    """Steps in one call where so many are left: a power of two, so that few kinds are made."""
    return min(CHUNK, 1 << max(left.bit_length() - 1, 2))
