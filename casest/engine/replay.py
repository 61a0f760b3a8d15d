"""Replay a CasADi SX function over many samples with NumPy.

CasADi evaluates an SX function one sample at a time. Here its instruction list is read once, put
into single-assignment form, split into what depends on the parameters only (computed once per
call, as scalars) and what depends on the sample (computed for a block of samples at a time, one
NumPy call per instruction and block). Memory is constant in the number of samples.

The way down: `Replay` (what users hold) > `Plan` (which values to compute, and in which register)
> `_Workspace` (the registers themselves) > kernels (one per CasADi operation).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import wraps
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from casest.engine.graph import PARAMETER, SAMPLE, Graph
from casest.engine.grouping import group
from casest.engine.operations import BY_CODE, Floats, Kernel
from casest.engine.scalars import Scalars
from casest.engine.waiting import WAITING
from casest.errors import CasestError

T = TypeVar("T")
Entry = tuple[int, int]  # (output, index of the nonzero in CasADi's column-major order)

BLOCK = 9216  # samples per block: long enough to hide the cost of NumPy's calls


class Columns:
    """Samples as columns (N,) of numbers, wherever they lie: views of arrays or of mapped files.

    Nothing is copied, so a record may be larger than memory allows twice.
    """

    def __init__(self, parts: Sequence[Floats]) -> None:
        """From arrays (N,) or (N, k), side by side."""
        self.columns: list[Floats] = []
        for part in parts:
            self.columns += [part] if part.ndim == 1 else [part[:, j] for j in range(part.shape[1])]
        self._length = len(parts[0]) if parts else 0
        #: Addresses and strides for compiled code, found when first wanted.
        self.plain: list[tuple[int, int]] | None = None

    def __len__(self) -> int:
        """Return the number of samples N."""
        return self._length

    def __getitem__(self, span: slice) -> Columns:
        """Return the samples of a slice, still as views."""
        found = Columns([column[span] for column in self.columns])
        found._length = len(range(*span.indices(self._length)))
        return found

    def with_more(self, part: Floats) -> Columns:
        """Return these columns and those of an array (N, k)."""
        return Columns([*self.columns, part])

    @property
    def dense(self) -> Floats:
        """All of it in one array, (N, k), the numbers of a column together."""
        if not self.columns:
            return np.zeros((self._length, 0))
        return np.array(self.columns, dtype=np.float64).T


Samples = Floats | Columns


class Plan:
    """What to compute for some wanted values of a graph, and where each value lives.

    A per-sample value lives in a row: one of the result's if it is wanted, else one that is taken
    over as soon as its last reader has run. The other values live in `scalars`.
    """

    def __init__(self, graph: Graph, wanted: Sequence[int]) -> None:
        self.graph = graph
        self.wanted = list(wanted)
        needed = graph.needed(self.wanted)
        values = graph.values
        self.scalars = [i for i in needed if not values[i].per_sample]
        self.once = Scalars(graph, self.scalars)
        self.inputs = [i for i in needed if values[i].kind == "sample"]
        self.steps = [i for i in needed if values[i].per_sample and values[i].kind == "operation"]
        # The first place a computed value is wanted in is its home; the others get copies.
        self.home: dict[int, int] = {}
        computed = set(self.steps)
        for row, i in enumerate(self.wanted):
            if i in computed:
                self.home.setdefault(i, row)
        self.register, self.n_registers = self._assign_registers()
        self._idle: list[_Workspace] = []

    def _assign_registers(self) -> tuple[dict[int, int], int]:
        values = self.graph.values
        last_reader = {j: i for i in self.steps for j in values[i].operands}
        register: dict[int, int] = {}
        free: list[int] = []
        count = 0
        for i in self.steps:
            # Freed before the result is placed, and last in first out: works in place where it can.
            for j in dict.fromkeys(values[i].operands):
                if last_reader[j] == i and j in register:
                    free.append(register[j])
            if i in self.home:
                continue
            if not free:
                free.append(count)
                count += 1
            register[i] = free.pop()
        return register, count

    def blocks(
        self, parameters: Floats, samples: Columns, block: int = BLOCK
    ) -> Iterator[tuple[slice, Floats]]:
        """Yield, per block, the slice of samples and the wanted entries, (wanted, in block).

        parameters: (n,). samples: N of k numbers, in memory or mapped. The array is a view of a
        buffer that the next block, and the next call, overwrite.
        """
        if block < 1:
            raise CasestError(f"block is {block}: give the number of samples per block, at least 1")
        total = len(samples)
        if total == 0:
            return
        # Blocks of equal length: a short last one would cost as many calls as a long one.
        length = -(-total // -(-total // block))
        workspace = self._take(length)
        try:
            workspace.set_parameters(parameters)
            for start in range(0, total, length):
                span = slice(start, min(start + length, total))
                yield span, workspace.run(samples[span])
        finally:
            self._idle[:] = [workspace]
            WAITING.keep(workspace, workspace.n_bytes, self.forget)

    def _take(self, length: int) -> _Workspace:
        # Taken off the list while in use, so that interleaved iterations do not share a buffer.
        while self._idle:
            workspace = self._idle.pop()
            if workspace.length == length:
                return workspace
        return _Workspace(self, length)

    def forget(self, workspace: _Workspace) -> None:
        """Let go of a workspace that waits for another call; one in use is not among them."""
        self._idle[:] = [kept for kept in self._idle if kept is not workspace]


class _Workspace:
    """The registers of one plan for blocks of up to `length` samples, and the bound calls."""

    def __init__(self, plan: Plan, length: int) -> None:
        self.plan = plan
        self.length = length
        self._scalars = np.empty(len(plan.once))
        self._scalar = {i: self._scalars[k, ...] for i, k in plan.once.place.items()}
        self._results = aligned(len(plan.wanted), length)
        self._inputs = aligned(len(plan.inputs), length)
        self._registers = aligned(plan.n_registers, length)
        self._bound: dict[int, list[tuple[Kernel, tuple[Floats, ...]]]] = {}
        self.n_bytes = self._results.nbytes + self._inputs.nbytes + self._registers.nbytes

    def set_parameters(self, parameters: Floats) -> None:
        """Evaluate once what does not depend on the sample."""
        with np.errstate(all="ignore"):
            self._scalars[:] = self.plan.once(parameters)
        for row, i in enumerate(self.plan.wanted):
            if i in self._scalar:
                self._results[row] = self._scalar[i]

    def run(self, samples: Columns) -> Floats:
        """Evaluate a block, k columns to (wanted, rows)."""
        length = len(samples)
        for row, i in zip(self._inputs, self.plan.inputs, strict=True):
            row[:length] = samples.columns[self.plan.graph.values[i].code]
        if length not in self._bound:
            self._bound[length] = self._bind(length)
        _run(self._bound[length])
        return self._results[:, :length]

    def _bind(self, length: int) -> list[tuple[Kernel, tuple[Floats, ...]]]:
        plan = self.plan
        place = dict(self._scalar)
        place.update((i, self._inputs[k, :length]) for k, i in enumerate(plan.inputs))
        place.update((i, self._registers[k, :length]) for i, k in plan.register.items())
        place.update((i, self._results[k, :length]) for i, k in plan.home.items())
        calls = [self._call(i, place) for i in plan.steps]
        for row, i in enumerate(plan.wanted):
            if i not in self._scalar and plan.home.get(i) != row:
                calls.append((np.positive, (place[i], self._results[row, :length])))
        return calls

    def _call(self, i: int, place: dict[int, Floats]) -> tuple[Kernel, tuple[Floats, ...]]:
        value = self.plan.graph.values[i]
        return BY_CODE[value.code].kernel, (*(place[j] for j in value.operands), place[i])


def _run(calls: list[tuple[Kernel, tuple[Floats, ...]]]) -> None:
    with np.errstate(all="ignore"):
        for kernel, arguments in calls:
            kernel(*arguments)


def aligned(rows: int, length: int) -> Floats:
    """An uninitialised (rows, length) array whose rows start on cache lines.

    An odd number of cache lines per row: rows a power of two apart would fight for the same sets.
    """
    stride = 8 * ((length + 7) // 8 | 1)
    raw = np.empty(rows * stride + 7)
    start = -(raw.ctypes.data // 8) % 8
    return raw[start : start + rows * stride].reshape(rows, stride)[:, :length]


def once(make: Callable[[Replay], T]) -> Callable[[Replay], T]:
    """Make something of a replay once and keep it there: it goes when the replay goes.

    A cache beside it would keep replays alive, and their blocks of samples with them.
    """

    @wraps(make)
    def kept(replay: Replay) -> T:
        if make not in replay.made:
            replay.made[make] = make(replay)
        found: T = replay.made[make]
        return found

    return kept


class Replay:
    """A CasADi SX function of (parameters, sample), evaluated over all samples of a record.

    The function has exactly two inputs, `parameters` (n×1, dense) and `sample` (k×1, dense), and
    any number of outputs of any sparsity. Values equal CasADi's to a few units in the last place;
    non-finite ones are returned as they come, without a warning. Only the sign of a nan, which no
    standard fixes but copysign can see, may differ.
    """

    def __init__(self, function: Any, grouped: Collection[int] = ()) -> None:
        """From a function; outputs that are `grouped` may be computed in another order.

        That takes fewer operations (see `grouping`), and changes the last digits.
        """
        _check_function(function)
        self.name = str(function.name())
        self.n_parameters = int(function.numel_in(PARAMETER))
        self.n_sample = int(function.numel_in(SAMPLE))
        self.graph = Graph(function)
        if grouped:
            group(self.graph, grouped)
        self.shapes: list[tuple[int, int]] = [
            (int(function.size1_out(i)), int(function.size2_out(i)))
            for i in range(function.n_out())
        ]
        # Of every nonzero of each output, in CasADi's order: row and column.
        self.sparsity: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = [
            _triplet(function.sparsity_out(i)) for i in range(function.n_out())
        ]
        self._plans: dict[tuple[Entry, ...], Plan] = {}
        #: Compiled forms, by output (−1: least-squares sums); None where compiling failed.
        self.kernels: dict[int, Any] = {}
        #: What else was made of it once; see `once`.
        self.made: dict[Any, Any] = {}

    def plan(self, wanted: Sequence[Entry]) -> Plan:
        """How to compute the (output, nonzero) entries `wanted`, in that order; made once."""
        key = tuple(wanted)
        if key not in self._plans:
            values = [self.graph.outputs[output][nonzero] for output, nonzero in key]
            self._plans[key] = Plan(self.graph, values)
        return self._plans[key]

    def entries(self, output: int) -> list[Entry]:
        """All of one output."""
        return [(output, k) for k in range(len(self.sparsity[output][0]))]

    def blocks(
        self, parameters: Floats, samples: Samples, block: int = BLOCK
    ) -> Iterator[tuple[slice, list[Floats]]]:
        """Yield, per block, the slice of samples and each output's nonzeros, (nnz, in block).

        parameters: (n,). samples: (N, k), in memory or mapped. Nonzeros are in CasADi's
        column-major order. The arrays are views of a buffer that the next block, and the next
        call on this object, overwrite: copy what is to be kept.
        """
        parameters, columns = self.check(parameters, samples)
        counts = [len(row) for row, _ in self.sparsity]
        ends = np.cumsum(counts)
        plan = self.plan([entry for i in range(len(counts)) for entry in self.entries(i)])
        for span, values in plan.blocks(parameters, columns, block):
            yield (
                span,
                [values[end - count : end] for end, count in zip(ends, counts, strict=True)],
            )

    def by_entry(self, parameters: Floats, samples: Samples) -> list[Floats]:
        """Each output of every sample, dense, samples along the last axis: (rows, columns, N)."""
        results = [np.zeros((*shape, len(samples))) for shape in self.shapes]
        for span, outputs in self.blocks(parameters, samples):
            for result, values, (row, column) in zip(results, outputs, self.sparsity, strict=True):
                result[row, column, span] = values
        return results

    def __call__(self, parameters: Floats, samples: Samples) -> list[Floats]:
        """Each output of every sample, dense: (N, rows, columns)."""
        results = [np.zeros((len(samples), *shape)) for shape in self.shapes]
        for span, outputs in self.blocks(parameters, samples):
            for result, values, (row, column) in zip(results, outputs, self.sparsity, strict=True):
                result[span, row, column] = values.T
        return results

    def sum(self, parameters: Floats, samples: Samples, output: int = 0) -> Floats:
        """The sum of one output over all samples, dense: (rows, columns)."""
        parameters, columns = self.check(parameters, samples)
        row, column = self.sparsity[output]
        output %= len(self.shapes)
        total = np.zeros(self.shapes[output])
        plan = self.plan(self.entries(output))
        with np.errstate(all="ignore"):
            for _, values in plan.blocks(parameters, columns):
                total[row, column] += values.sum(axis=1)
        return total

    def check(self, parameters: Floats, samples: Samples) -> tuple[Floats, Columns]:
        """Return parameters (n,) and samples by column, or raise if a shape is wrong."""
        parameters = np.asarray(parameters, dtype=np.float64)
        if parameters.shape != (self.n_parameters,):
            raise CasestError(
                f"parameters of {self.name!r} have the shape {parameters.shape}:"
                f" give ({self.n_parameters},)"
            )
        shape = (
            (len(samples), len(samples.columns))
            if isinstance(samples, Columns)
            else np.shape(samples)
        )
        if len(shape) != 2 or shape[1] != self.n_sample:
            raise CasestError(
                f"samples of {self.name!r} have the shape {shape}:"
                f" give (N, {self.n_sample}), one row per sample"
            )
        if isinstance(samples, Columns):
            return parameters, samples
        columns = Columns([np.asanyarray(samples)])
        columns._length = shape[0]
        return parameters, columns


def _triplet(sparsity: Any) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    row, column = sparsity.get_triplet()
    return np.array(row, dtype=np.intp), np.array(column, dtype=np.intp)


def _check_function(function: Any) -> None:
    name = function.name()
    if not function.is_a("SXFunction"):
        raise CasestError(
            f"function {name!r} is a {function.class_name()}: build it from SX, or call .expand()"
        )
    if function.name_in() != ["parameters", "sample"]:
        raise CasestError(
            f"function {name!r} has the inputs {function.name_in()}:"
            " replay needs exactly ['parameters', 'sample']"
        )
    if function.has_free():
        raise CasestError(
            f"function {name!r} has free symbols {function.get_free()}: make them inputs"
        )
    for i, word in enumerate(function.name_in()):
        if not function.sparsity_in(i).is_dense() or function.size2_in(i) != 1:
            raise CasestError(
                f"input {word!r} of function {name!r} is {function.sparsity_in(i).dim(True)}:"
                " replay needs a dense column"
            )
