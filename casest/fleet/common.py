"""Effects that many sensors have in common: too small to see in one, plain in ten thousand.

At the fit of the declared model the score of an effect, s = Gᵀ(1 − P)(−r), and its information
I = Gᵀ(1 − P)G, with G the slopes of the residual in the effect's unknowns where it is absent and P
the projection on those in the declared ones, are computed for all sensors side by side (C. R. Rao,
1948). What all sensors share is the mean of the scores: Hotelling's T² asks whether it is zero,
with the scatter that the scores themselves have, so that neither the size of the noise nor a spread
of the effect between sensors is taken for it. The common size is ΣI⁻¹Σs. Sums are all that is kept
of a sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from casest.declaration.effect import NOISE, OVER_TIME, RECORDED, Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.effects.placing import placed_in
from casest.engine.threads import one_thread
from casest.errors import CasestError
from casest.fleet.sums import Squares, side_by_side, widest
from casest.leastsquares.per_sample import residual_and_jacobian

#: Share of an effect's slopes that the declared unknowns must leave, for it to be told from them.
SURVIVES = 1e-3
#: Chance of naming any effect where a fleet has none in common: it has power to spare, an effect of
#: 0.2 standard deviations in each of 10 000 sensors has a T² of 400.
CHANCE = 1e-4
#: Scores are clipped here, in robust standard deviations: one bad sensor is no common effect.
CLIP = 8.0


@dataclass
class Sums:
    """Of scores (q,) over sensors: count, Σs, Σssᵀ, ΣI."""

    count: int
    score: Array
    square: Array
    information: Array

    @classmethod
    def empty(cls, q: int) -> Sums:
        """Nothing yet of q unknowns."""
        return cls(0, np.zeros(q), np.zeros((q, q)), np.zeros((q, q)))

    def add(self, score: Array, information: Array) -> None:
        """Scores (S, q) and information (S, q, q) of some sensors."""
        self.count += len(score)
        self.score += score.sum(axis=0)
        self.square += score.T @ score
        self.information += information.sum(axis=0)

    def joined(self, other: Sums) -> Sums:
        """Of both."""
        return Sums(
            self.count + other.count,
            self.score + other.score,
            self.square + other.square,
            self.information + other.information,
        )

    @property
    def scatter(self) -> Array:
        """Covariance of one sensor's score, (q, q)."""
        mean = self.score / self.count
        return (self.square - self.count * np.outer(mean, mean)) / max(self.count - 1, 1)

    @property
    def size(self) -> tuple[Array, Array]:
        """Common size of the effect's unknowns (q,), and its covariance (q, q)."""
        inverse, _ = _inverse(self.information)
        return inverse @ self.score, self.count * inverse @ self.scatter @ inverse

    def chance(self) -> tuple[float, float]:
        """Hotelling's T², and how probable one as large is where sensors have nothing in common."""
        if self.count <= len(self.score) + 1:
            return 0.0, 1.0
        inverse, q = _inverse(self.scatter)
        mean = self.score / self.count
        t2 = float(self.count * mean @ inverse @ mean)
        ratio = t2 * (self.count - q) / (q * (self.count - 1))
        return t2, float(fdtrc(q, self.count - q, ratio))


@dataclass
class Trial:
    """An effect that is tried on a fleet: the extended model, where it is absent, and sums.

    `folds` are the sums over two halves of the fleet; `groups` those of each value of a column.
    """

    effect: Effect
    extended: Model
    names: tuple[str, ...]
    null: Array
    folds: tuple[Sums, Sums]
    groups: dict[str, dict[str, Sums]] = field(default_factory=dict)
    #: Σ(1 − P) share of the slopes that is left, and how many sensors that was.
    left: float = 0.0

    @property
    def whole(self) -> Sums:
        """Over all sensors."""
        return self.folds[0].joined(self.folds[1])


def trials(model: Model, catalogue: Sequence[Effect]) -> list[Trial]:
    """Effects of the catalogue that act on the model's poses, each with its place in it.

    Those that follow columns, time or neighbours are none that single poses could show.
    """
    found = []
    for effect in catalogue:
        if (
            effect.kind in (*OVER_TIME, "rate")
            or NOISE in (effect.kind, effect.on)
            or effect.on == RECORDED
        ):
            continue
        if effect.profile or effect.columns or any(w != "middle" for _, w in effect.numbers):
            continue
        try:
            extended = model.with_effect(placed_in(effect, model))
        except CasestError:
            continue
        own = [p for p in extended.parameters if p.name not in {q.name for q in model.parameters}]
        if {s.name for s in extended.signals} != {s.name for s in model.signals} or not own:
            continue
        if any(p.shape.curved for p in own):
            continue
        null = [np.full(p.shape.size, effect.null_of(p.name.rpartition(".")[2])) for p in own]
        names = tuple(name for p in own for name in p.entry_names)
        sums = (Sums.empty(len(names)), Sums.empty(len(names)))
        found.append(Trial(effect, extended, names, np.concatenate(null), sums))
    return found


def scores(trial: Trial, values: Array, signals: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Scores (S, q), information (S, q, q), and the share of each slope that is left, (S, q).

    values: fitted unknowns (S, n) of the declared model; signals (S, N, size) in its order.
    """
    squares = Squares(residual_and_jacobian(trial.extended))
    size, n, q = len(values), values.shape[1], len(trial.null)
    found = np.empty((size, q)), np.empty((size, q, q)), np.empty((size, q))
    width = widest(signals[0].shape[1])
    with np.errstate(all="ignore"), one_thread():
        for first in range(0, size, width):
            s = slice(first, min(first + width, size))
            own = _projected(squares, values[s], [v[s] for v in signals], trial.null, n)
            for whole, part in zip(found, own, strict=True):
                whole[s] = part
    return found


def _projected(
    squares: Squares, values: Array, signals: Sequence[Array], null: Array, n: int
) -> tuple[Array, Array, Array]:
    """The same of a block."""
    total, sensors = len(values), side_by_side(signals)
    width = sensors.samples.shape[2]
    x = np.repeat(null[:, None], width, axis=1)
    x = np.concatenate([values[np.minimum(np.arange(width), total - 1)].T, x])
    rows = squares.normals(x, sensors).rows[..., :total]
    rows = rows.transpose(2, 0, 1)
    A = rows[:, :-1] + np.tril(rows[:, :-1], -1).swapaxes(1, 2)
    pull = rows[:, -1]
    scale = np.sqrt(np.einsum("sii->si", A[:, :n, :n]))
    JJ = A[:, :n, :n] / (scale[:, :, None] * scale[:, None, :])
    JG, Jr = A[:, :n, n:] / scale[:, :, None], pull[:, :n] / scale
    usable = np.isfinite(JJ).all(axis=(1, 2)) & np.isfinite(JG).all(axis=(1, 2))
    JJ[~usable], JG[~usable] = np.eye(n), np.nan
    solved = np.linalg.solve(JJ, np.concatenate([JG, Jr[:, :, None]], axis=2))
    information = A[:, n:, n:] - np.einsum("sik,sil->skl", JG, solved[:, :, :-1])
    score = -(pull[:, n:] - np.einsum("sik,si->sk", JG, solved[:, :, -1]))
    diagonal = np.einsum("skk->sk", information), np.einsum("skk->sk", A[:, n:, n:])
    return score, information, diagonal[0] / diagonal[1]


def added(
    trial: Trial,
    values: Array,
    signals: Sequence[Array],
    fold: NDArray[np.int_],
    labels: Mapping[str, Sequence[Any]],
) -> None:
    """Add sensors to a trial: which half each belongs to, (S,), and its labels by column."""
    score, information, left = scores(trial, values, signals)
    good = np.isfinite(score).all(axis=1) & np.isfinite(information).all(axis=(1, 2))
    score, information, left, fold = score[good], information[good], left[good], fold[good]
    if not len(score):
        return
    score = _clipped(score)
    trial.left += float(left.max(axis=1).sum())
    for k in (0, 1):
        trial.folds[k].add(score[fold == k], information[fold == k])
    for column, own in labels.items():
        names = np.asarray([str(v) for v in own], dtype=object)[good]
        groups = trial.groups.setdefault(column, {})
        for name in dict.fromkeys(names.tolist()):
            chosen = names == name
            sums = groups.setdefault(name, Sums.empty(score.shape[1]))
            sums.add(score[chosen], information[chosen])


def _clipped(score: Array) -> Array:
    """Scores of a sensor that is far beyond the others count no more than CLIP."""
    middle = np.median(score, axis=0)
    scale = CLIP * 1.4826 * np.median(np.abs(score - middle), axis=0)
    return np.clip(score, middle - scale, middle + scale)


def seen(trial: Trial) -> bool:
    """Do the declared unknowns leave enough of the effect to tell it from them?"""
    count = trial.whole.count
    return count > 0 and trial.left / count > SURVIVES


def between(trial: Trial, column: str) -> float:
    """How probable such different means of the scores are where they do not follow a column."""
    groups = [own for own in trial.groups.get(column, {}).values() if own.count > 1]
    if len(groups) < 2:
        return 1.0
    whole = trial.whole
    mean, (inverse, rank) = whole.score / whole.count, _inverse(whole.scatter)
    apart = [(g.score / g.count - mean, g.count) for g in groups]
    total = sum(n * float(d @ inverse @ d) for d, n in apart)
    return float(chdtrc(rank * (len(groups) - 1), total))


def _inverse(matrix: Array) -> tuple[Array, int]:
    """Inverse within the directions that are there, and how many those are."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    kept = values > SURVIVES * max(float(values[-1]), 1e-300)
    own = vectors[:, kept] / scale[:, None]
    return np.asarray(own / values[kept] @ own.T), int(kept.sum())
