"""Least-squares sums where every entry of J is a sum of few factors × atoms.

J = C(parameters) · Φ(sample), with atoms Φ that all entries share: JᵀJ = Σ Cᵢ (ΦΦᵀ) Cᵢᵀ and
Jᵀr = Σ Cᵢ (Φ rᵢ) over the residuals i. Then only atoms and residuals are computed on every sample,
and one product of them in place of one for each residual.

Where the terms of an entry cancel, digits are lost that the entry itself has. The loss is measured
on every call, and what has lost too much is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from casest.engine.graph import Graph
from casest.engine.operations import Floats
from casest.engine.replay import BLOCK, Plan, Replay, Samples
from casest.engine.spreading import _SUMS, Spreading

#: Samples from which on this way is tried.
ENOUGH = 4_000
#: Length of an entry's terms over that of the entry: the error of JᵀJ grows with its square.
_LOSS = 16.0
#: After this many refusals in a row nothing is tried any more.
_PATIENCE = 3
#: Multiplications of BLAS that take as long as one operation on a sample; what must be saved.
_RATE, _GAIN = 8.0, 0.8
#: OpenBLAS is quicker with pieces of up to a million multiplications.
_PIECE, _SMALL = 1024, 1_000_000


def factored_sums(replay: Replay, parameters: Floats, samples: Samples) -> Floats | None:
    """[J r]ᵀ[J r] (n+1, n+1), or None where it does not pay, is not finite or loses digits."""
    if len(samples) < ENOUGH:
        return None
    way = _factored(replay)
    return None if way is None else way.sums(parameters, samples)


@lru_cache(maxsize=256)
def _factored(replay: Replay) -> _Factored | None:
    graph, (m, _) = replay.graph, replay.shapes[1]
    residual, jacobian = graph.outputs[0], graph.outputs[1]
    sums = [i for i in graph.needed(residual) if graph.values[i].code in _SUMS]
    ways = [_Factored(replay, Spreading(graph, jacobian, closed)) for closed in ((), sums)]
    best = min(ways, key=lambda way: way.work)
    counts = np.bincount(replay.sparsity[1][0], minlength=m) + 1
    now = _operations(graph, [*jacobian, *residual]) + float(counts @ counts) / _RATE
    return best.prepared() if best.work < _GAIN * now else None


def _operations(graph: Graph, wanted: Sequence[int]) -> int:
    values = [graph.values[i] for i in graph.needed(wanted)]
    return sum(value.per_sample and value.kind == "operation" for value in values)


class _Factored:
    def __init__(self, replay: Replay, spreading: Spreading) -> None:
        self.replay, self.spreading = replay, spreading
        self.atoms = sorted({atom for own in spreading.sums for atom in own})
        self.m, self.n = replay.shapes[1]
        self.count = len(self.atoms)
        values = [spreading.value(atom) for atom in self.atoms]
        self.wanted = [*values, *replay.graph.outputs[0]]
        products = self.count * (self.count + self.m)
        self.work = _operations(replay.graph, self.wanted) + products / _RATE
        self.piece = max(1, min(_PIECE, _SMALL // max(products, 1)))
        self.refused = 0

    def prepared(self) -> _Factored:
        place = {atom: k for k, atom in enumerate(self.atoms)}
        row, column = self.replay.sparsity[1]
        entries = [
            (j, i, place[atom], factor)
            for own, i, j in zip(self.spreading.sums, row, column, strict=True)
            for atom, factor in own.items()
        ]
        where = self.spreading.factors.keep([factor for *_, factor in entries])
        self.entries = tuple(np.array([e[k] for e in entries], dtype=np.intp) for k in range(3))
        self.source = np.array([where[e[3]] for e in entries], dtype=np.intp)
        self.plan = Plan(self.replay.graph, self.wanted)
        return self

    def sums(self, parameters: Floats, samples: Samples) -> Floats | None:
        if self.refused >= _PATIENCE:
            return None
        with np.errstate(all="ignore"):
            found = self._sums(parameters, samples)
        self.refused = self.refused + 1 if found is None else 0
        return found

    def _sums(self, parameters: Floats, samples: Samples) -> Floats | None:
        parameters, columns = self.replay.check(parameters, samples)
        K, n = self.count, self.n
        products, squares = np.zeros((K, K + self.m)), 0.0
        for _, values in self.plan.blocks(parameters, columns, BLOCK):
            for start in range(0, values.shape[1], self.piece):
                piece = values[:, start : start + self.piece]
                products += piece[:K] @ piece.T
            squares += sum(float(r @ r) for r in values[K:])
        gram = products[:, :K]
        C = np.zeros((n, self.m, K))
        C[self.entries] = self.spreading.factors.values(parameters)[self.source]
        flat = C.reshape(n, -1)
        whole = np.empty((n + 1, n + 1))
        matrix = (C @ (0.5 * (gram + gram.T))).reshape(n, -1) @ flat.T
        whole[:n, :n] = 0.5 * (matrix + matrix.T)
        whole[:n, n] = whole[n, :n] = flat @ products[:, K:].T.ravel()
        whole[n, n] = squares
        terms = np.abs(C) @ np.sqrt(np.diag(gram))
        kept = np.einsum("ji,ji->j", terms, terms) <= _LOSS**2 * np.diag(matrix)
        return whole if np.isfinite(whole).all() and kept.all() else None
