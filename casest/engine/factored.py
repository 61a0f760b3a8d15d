"""Least-squares sums from atoms that all entries of J share.

Every entry of J is a sum of factor × atom, J = C(parameters) · Φ(sample). For the residuals i
JᵀJ = Σ Cᵢ (ΦΦᵀ) Cᵢᵀ and Jᵀr = Σ Cᵢ (Φ rᵢ): only atoms and residuals are computed on every sample,
and one product of them takes the place of one for each residual.

Where the terms of an entry cancel, digits are lost that the entry itself has. How far they do is
seen in the sums, on every call: what would lose too many is refused, and so is what is not finite,
for an atom may be infinite where an entry is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

from casest.engine.graph import Graph
from casest.engine.operations import Floats
from casest.engine.replay import Columns, Plan, Replay, Samples, once
from casest.engine.spreading import SUMS, Spreading

#: Samples from which on this way is looked for: finding it takes as long as it then saves in a few
#: evaluations.
ENOUGH = 10_000
#: Norm of a column's terms over that of the column: errors of JᵀJ grow with its square.
LOSS = 30.0
#: Squares below this have lost digits, or all, and large factors would show it.
_UNDERFLOW = 1e-290
#: Refusals in a row after which a function is evaluated entry by entry for good.
PATIENCE = 3
#: Terms up to which values are spread out: few make for few atoms, many for few operations.
_FEW, _MANY = 12, 24
#: Multiplications of a product that take as long as one operation on a sample.
_RATE = 5.0
#: The share of the work that must be left over for it to be worthwhile.
_WORTHWHILE = 0.8
#: Multiplications and samples of a piece of a product; see `normal`.
_SMALL, _PIECE = 1_000_000, 1024


def factored_sums(replay: Replay, parameters: Floats, samples: Samples) -> Floats | None:
    """[J r]ᵀ[J r], (n+1, n+1), of a replay with the outputs r and J; None where it is refused."""
    if len(samples) < ENOUGH:
        return None
    found = factored(replay)
    return None if found is None else found.sums(*replay.check(parameters, samples))


@once
def factored(replay: Replay) -> Factored | None:
    """The way that takes least work; None if that is no less than entry by entry."""
    graph, (residual, jacobian) = replay.graph, replay.graph.outputs[:2]
    lengths = np.bincount(replay.sparsity[1][0]) + 1
    now = _operations(graph, [*jacobian, *residual]) + float(lengths @ lengths) / _RATE
    least, fixed = _WORTHWHILE * now, _operations(graph, residual)
    best: tuple[Factored, Spreading] | None = None
    # What the residuals take anyway costs nothing as an atom.
    sums = {i for i in graph.needed(residual) if graph.values[i].code in SUMS}
    for most, closed in ((_FEW, set[int]()), (_FEW, sums), (_MANY, sums)):
        limit = sqrt(_RATE * max(least - fixed, 0.0))
        spreading = Spreading(graph, jacobian, most, closed, limit)
        if spreading.done:
            found = Factored(replay, spreading)
            if found.work < least:
                best, least = (found, spreading), found.work
    return None if best is None else best[0].prepared(best[1])


def _operations(graph: Graph, wanted: Sequence[int]) -> int:
    """How many there are on every sample."""
    values = [graph.values[i] for i in graph.needed(wanted)]
    return sum(value.per_sample and value.kind == "operation" for value in values)


class Factored:
    """One way to write J as factors × atoms. `work`: operations on every sample, products' too."""

    def __init__(self, replay: Replay, spreading: Spreading) -> None:
        self._graph = replay.graph
        self._row, self._column = replay.sparsity[1]
        self.m, self.n = replay.shapes[1]
        self._atoms = sorted(spreading.atoms)
        self._wanted = [*map(spreading.value, self._atoms), *replay.graph.outputs[0]]
        products = len(self._atoms) * len(self._wanted)
        self.work = _operations(self._graph, self._wanted) + products / _RATE
        self._piece = max(1, min(_PIECE, _SMALL // max(products, 1)))
        self._refused = 0

    def prepared(self, spreading: Spreading) -> Factored:
        """Itself, with what calls need: made once this is the way."""
        place = {atom: k for k, atom in enumerate(self._atoms)}
        entries = zip(spreading.sums, self._column, self._row, strict=True)
        terms = [
            (int(j), int(i), place[atom], factor)
            for own, j, i in entries
            for atom, factor in own.items()
        ]
        self._factors = spreading.factors
        where = self._factors.keep([factor for *_, factor in terms])
        self._source = np.array([where[factor] for *_, factor in terms], dtype=np.intp)
        self._target = tuple(np.array([t[:3] for t in terms], dtype=np.intp).reshape(-1, 3).T)
        self._plan = Plan(self._graph, self._wanted)
        return self

    def sums(self, parameters: Floats, samples: Columns) -> Floats | None:
        """[J r]ᵀ[J r], or None where digits would be lost or something is not finite."""
        if self._refused >= PATIENCE:
            return None
        with np.errstate(all="ignore"):
            total, squares = self._products(parameters, samples)
            found = self._whole(parameters, total, squares)
        if found is not None:
            self._refused = 0
        elif np.isfinite(squares):  # else it is the point that is bad
            self._refused += 1
        return found

    def _products(self, parameters: Floats, samples: Columns) -> tuple[Floats, float]:
        """Φ [Φ r]ᵀ (K, K + m) and Σ r²."""
        K = len(self._atoms)
        total, squares = np.zeros((K, K + self.m)), 0.0
        for _, values in self._plan.blocks(parameters, samples):
            for start in range(0, values.shape[1], self._piece):
                piece = values[:, start : start + self._piece]
                total += piece[:K] @ piece.T
            squares += sum(float(r @ r) for r in values[K:])
        return total, squares

    def _whole(self, parameters: Floats, total: Floats, squares: float) -> Floats | None:
        """The factors C (n, m, K) put to the products of the atoms."""
        n, K = self.n, len(self._atoms)
        C, size = np.zeros((2, n, self.m, K))
        for filled, values in zip((C, size), self._factors.values(parameters), strict=True):
            filled[self._target] = values[self._source]
        gram, flat = total[:, :K], C.reshape(n, -1)
        matrix = (C @ gram).reshape(n, -1) @ flat.T
        whole = np.empty((n + 1, n + 1))
        whole[:n, :n] = 0.5 * (matrix + matrix.T)
        whole[n, :n] = whole[:n, n] = flat @ total[:, K:].T.ravel()
        whole[n, n] = squares
        lengths = np.sum((size @ np.sqrt(np.diag(gram) + _UNDERFLOW)) ** 2, axis=1)
        kept = lengths <= LOSS**2 * np.diag(matrix)
        return whole if np.isfinite(whole).all() and kept.all() else None
