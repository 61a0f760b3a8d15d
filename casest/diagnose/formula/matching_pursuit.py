"""Which few shapes a residual asks for: chosen from sums over batches, again from half of them.

The residual is linear in the sizes of all shapes, so that sums of products over every batch of
samples say what any few of them would explain beside the declared parameters. Shapes are taken
one by one, the one that explains most first (orthogonal matching pursuit, Pati et al. 1993); then
those which are no more than noise beside the others leave. Most half-samples of the batches must
choose the same variables (Meinshausen & Bühlmann 2010), so that no lucky stretch decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.score_test import Score, ScoreSums, ScoreTest, scored
from casest.diagnose.levels import SURVIVES

#: Chance, under a model that lacks nothing, that any formula is called significant.
FALSE_ALARM = 0.002
#: Chance that a further shape is added to a formula that needs no more.
FURTHER = 0.05
#: Shapes of a formula at most, and those that are looked at closely: in all, of what one reads.
MOST, CLOSELY, OF_EACH = 3, 60, 3
#: Half-samples of the batches, and the share of them that must choose the same variables.
HALVES, STABLE = 40, 0.7
#: Fewest batches whose halves are a sample.
FEWEST = 8
#: Share of a shape's squared length that the declared parameters must leave.
LEFT = 1e-4
#: A size within so many standard deviations of zero is none.
NOTHING = 3.0

#: Rows of the declared columns (N, m, n) with their places, shapes (N, m, shapes, axes), residuals
#: (N, m), and the batch of every sample.
Rows = tuple[NDArray[np.int_], Array, Array, Array, NDArray[np.int_]]


@dataclass(frozen=True)
class Chosen:
    """Shapes by number with the axes (numbers) on which each is something; the joint evidence."""

    shapes: tuple[int, ...]
    axes: tuple[tuple[int, ...], ...]
    score: Score


def screened(
    rows: Iterator[Rows], unknowns: int, reads: Sequence[frozenset[str]], axes: int
) -> list[int]:
    """Shapes that explain most by themselves, and the best of everything that any reads."""
    n, count = unknowns, len(reads)
    normal, cross = np.zeros((n, n)), np.zeros((n, count, axes))
    blocks, score = np.zeros((count, axes, axes)), np.zeros((count, axes))
    declared = np.zeros(n)
    for place, J, G, r, _ in rows:
        width = J.shape[2]
        flat, g = J.reshape(-1, width), G.reshape(-1, count, axes)
        normal[np.ix_(place, place)] += flat.T @ flat
        cross[place] += (flat.T @ g.reshape(len(g), -1)).reshape(width, count, axes)
        for a in range(axes):
            blocks[:, a] += np.einsum("nk,nkb->kb", g[:, :, a], g)
        score += np.einsum("nka,n->ka", g, r.ravel())
        declared[place] += flat.T @ r.ravel()
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-10, hermitian=True)
    absorbed = np.einsum("ij,jka->ika", inverse / np.outer(size, size), cross)
    left = blocks - np.einsum("ika,ikb->kab", cross, absorbed)
    gains = _gains(left, blocks, score - np.einsum("i,ika->ka", declared, absorbed))
    order = [int(k) for k in np.argsort(-gains) if gains[k] > 0]
    kept, seen = [], dict.fromkeys(reads, 0)
    for k in order:
        seen[reads[k]] += 1
        if seen[reads[k]] <= OF_EACH:
            kept.append(k)
    rest = [k for k in order if k not in set(kept)]
    return (kept[:CLOSELY] + rest)[:CLOSELY]


def _gains(left: Array, whole: Array, score: Array) -> Array:
    """Σ of squares that each shape (k) explains on all axes (a): scoreᵀ left⁻¹ score."""
    size = np.sqrt(np.maximum(np.einsum("kaa->ka", whole), 1e-300))
    values, vectors = np.linalg.eigh(left / size[:, :, None] / size[:, None, :])
    turned = np.einsum("kab,ka->kb", vectors, score / size)
    gains = np.where(values > LEFT, turned**2 / np.maximum(values, LEFT), 0.0)
    return np.asarray(gains.sum(axis=1))


def summed(rows: Iterator[Rows], unknowns: int, shapes: int, axes: int, batches: int) -> ScoreSums:
    """Sums over every batch of the declared columns and those of all shapes."""
    n = unknowns + shapes * axes
    matrices, gradients, squares = np.zeros((batches, n, n)), np.zeros((batches, n)), 0.0
    for place, J, G, r, number in rows:
        index = np.concatenate([place, np.arange(unknowns, n)])
        both = np.concatenate([J, G.reshape(*G.shape[:2], -1)], axis=2)
        squares += float(np.sum(r**2))
        first = np.flatnonzero(np.diff(number, prepend=-1))
        for start, stop in zip(first, [*first[1:], len(number)], strict=True):
            part, b = both[start:stop].reshape(-1, len(index)), number[start]
            matrices[b][np.ix_(index, index)] += part.T @ part
            gradients[b][index] += part.T @ r[start:stop].ravel()
    scale = np.sqrt(np.maximum(np.einsum("bii->i", matrices), 1e-300))
    gradients /= scale
    whole = matrices / np.outer(scale, scale)
    return ScoreSums(whole, gradients, gradients, scale, (squares, squares))


@dataclass(frozen=True)
class Search:
    """Sums of the declared columns, the first `declared`, and of shapes, `axes` columns each.

    `reads` says what each shape reads, `trials` how many there were, `count` the residuals.
    """

    sums: ScoreSums
    declared: int
    axes: int
    sigma: float
    count: int
    reads: Sequence[frozenset[str]]
    trials: int

    def chosen(self) -> Chosen | None:
        """The shapes that are significant and stable, without axes on which they are nothing."""
        first = self.forward(MOST, slice(None))
        picked = self._lasting(self._exchanged(list(first))) or self._lasting(first)
        if not picked:
            return None
        score = self._joint(picked)
        alive = _something(score).reshape(len(picked), self.axes)
        axes = [tuple(map(int, np.flatnonzero(on))) for on in alive]
        kept = [(k, on) for k, on in zip(picked, axes, strict=True) if on]
        return Chosen(tuple(k for k, _ in kept), tuple(on for _, on in kept), score)

    def _lasting(self, picked: list[int]) -> list[int]:
        """As many of them, the first ones, as are significant and stable."""
        picked = self._earning(picked)
        while picked and not (self._significant(picked) and self._stable(picked)):
            picked = picked[:-1]
        return picked

    def forward(self, most: int, batches: NDArray[np.int_] | slice) -> list[int]:
        """Shapes one by one, each explaining most beside those before it."""
        whole, total = self.sums.matrices[batches].sum(axis=0), self.sums.gradients[batches].sum(0)
        picked: list[int] = []
        while len(picked) < min(most, len(self.reads)):
            gains = self._gains_beside(picked, whole, total)
            best = int(np.argmax(gains))
            if not gains[best] > 0:
                break
            picked.append(best)
        return picked

    def _gains_beside(self, picked: Sequence[int], whole: Array, total: Array) -> Array:
        """What every shape explains beside those that are picked."""
        d = self._declared(picked)
        own = np.arange(self.declared, len(total)).reshape(-1, self.axes)
        absorbed = np.linalg.pinv(whole[np.ix_(d, d)], rcond=1e-10, hermitian=True) @ whole[d]
        blocks = whole[own[:, :, None], own[:, None, :]]
        inner = np.einsum("dka,dkb->kab", whole[d][:, own], absorbed[:, own])
        gains = _gains(blocks - inner, blocks, (total - total[d] @ absorbed)[own])
        gains[list(picked)] = 0.0
        return gains

    def _exchanged(self, picked: list[int]) -> list[int]:
        """Each in turn exchanged for the best beside the others: the first was alone at first."""
        whole, total = self.sums.whole, self.sums.gradients.sum(axis=0)
        for _ in picked[1:]:
            for i in range(len(picked)):
                rest = picked[:i] + picked[i + 1 :]
                picked[i] = int(np.argmax(self._gains_beside(rest, whole, total)))
        return picked

    def _columns(self, shapes: Sequence[int]) -> NDArray[np.int_]:
        start = self.declared + self.axes * np.asarray(shapes, dtype=int)
        return (start[:, None] + np.arange(self.axes)).ravel()

    def _declared(self, shapes: Sequence[int]) -> NDArray[np.int_]:
        return np.concatenate([np.arange(self.declared), self._columns(shapes)])

    def _joint(self, shapes: Sequence[int], beside: Sequence[int] = ()) -> Score:
        """The score of some shapes, of the residual that is left beside others."""
        d, A = self._declared(beside), self.sums.whole
        inverse = np.asarray(np.linalg.pinv(A[np.ix_(d, d)], rcond=1e-10, hermitian=True))
        sums = self._left(d, inverse) if len(beside) else self.sums
        test = ScoreTest(sums, d, inverse, self.sigma, None, SURVIVES)
        return scored(Candidate(None), self._columns(shapes), test, self.count)

    def _left(self, d: NDArray[np.int_], inverse: Array) -> ScoreSums:
        """Sums with the residual that a fit of the columns d leaves."""
        sums, total = self.sums, self.sums.gradients[:, d].sum(axis=0)
        sizes = inverse @ total
        gradients = sums.gradients - sums.matrices[:, :, d] @ sizes
        left = sums.squares[0] - float(total @ sizes)
        return replace(sums, gradients=gradients, unclipped=gradients, squares=(left, left))

    def _earning(self, picked: list[int]) -> list[int]:
        """Without the last ones that are no more than noise beside those before them.

        From the end: while others are missing, what they do counts as noise.
        """
        while len(picked) > 1:
            last = self._joint(picked[-1:], picked[:-1])
            if last.p_value * self.trials <= FURTHER:
                break
            picked = picked[:-1]
        return picked

    def _significant(self, picked: Sequence[int]) -> bool:
        """Together, among all sets of as many shapes."""
        return self._joint(picked).p_value * comb(self.trials, len(picked)) <= FALSE_ALARM

    def _stable(self, picked: Sequence[int]) -> bool:
        """Do most half-samples choose the same variables for every shape?"""
        batches = len(self.sums.gradients)
        if batches < FEWEST:
            return False
        rng = np.random.default_rng(0)
        hits = np.zeros(len(picked))
        for _ in range(HALVES):
            half = np.sort(rng.permutation(batches)[: batches // 2])
            again = {self.reads[k] for k in self.forward(len(picked), half)}
            hits += [self.reads[k] in again for k in picked]
        return bool(hits.min() >= STABLE * HALVES)


def _something(score: Score) -> NDArray[np.bool_]:
    """Which of the sizes are something beside the others; the weakest goes first."""
    total, kept = score.information @ score.step, np.ones(len(score.step), dtype=np.bool_)
    while kept.sum() > 1:
        inverse = np.linalg.pinv(score.information[np.ix_(kept, kept)], hermitian=True)
        variance = np.maximum(np.diag(inverse) * score.inflation, 1e-300)
        z = np.abs(inverse @ total[kept]) / np.sqrt(variance)
        if z.min() > NOTHING:
            break
        kept[np.flatnonzero(kept)[np.argmin(z)]] = False
    return kept


def matching_pursuit(
    rows: Callable[[Sequence[int]], Iterator[Rows]],
    unknowns: int,
    axes: int,
    reads: Sequence[frozenset[str]],
    sigma: float,
    count: int,
    batches: int,
) -> Chosen | None:
    """The few shapes that the residual asks for, by number; None for none.

    `rows(shapes)` yields the record with the columns of these shapes.
    """
    close = screened(rows(range(len(reads))), unknowns, reads, axes)
    if not close:
        return None
    sums = summed(rows(close), unknowns, len(close), axes, batches)
    own = [reads[k] for k in close]
    found = Search(sums, unknowns, axes, sigma, count, own, len(reads)).chosen()
    return found and replace(found, shapes=tuple(close[k] for k in found.shapes))
