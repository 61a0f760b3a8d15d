"""What a cause is worth: twice the log of its likelihood over none, less what its unknowns cost.

The price is Schwarz's (1978), with its extension for what was looked through (J. Chen, Z. Chen,
2008): 2 log of the number of variants of one cause, and of families of causes. With few rows the
likelihood ratio with Zellner's prior of the weight of one observation stands in its place, which is
exact there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.likelihood import Beyond, Explained, Likelihood
from casest.diagnose.evidence.linear import Index


@dataclass(frozen=True)
class Trial:
    """A cause in its columns (N, m, k): slopes of the residual in its unknowns.

    `what` it is to whom asks; `family` its name for all that is a variant of it; `variants`: how
    many were looked through; `axes` (k,): the axis that each column belongs to, where that is a
    matter of axes; `among`: of how many choices of axes it is the best; `describes`: it is no
    cause, but what a cause must explain more than; `event`: it begins at a moment of its own;
    `feigned`: gain that noise of the inputs alone may give it; `secant`: all of it is held, and the
    columns are what it changes at that value, not a slope.
    """

    what: Any
    family: str
    columns: Array
    variants: float = 1.0
    axes: Index | None = None
    describes: bool = False
    feigned: float = 0.0
    secant: bool = False
    among: int = 1
    event: bool = False

    @property
    def choices(self) -> int:
        """Of axes, of which the best is taken, or was."""
        return self.among if self.axes is None else 2 ** len(np.unique(self.axes)) - 1


@dataclass(frozen=True)
class Evidence:
    """A trial (several, if they come together) with what it is worth.

    gain: 2 log L over none, less what is feigned; freedom: unknowns; score: gain less the price.
    """

    trials: tuple[Trial, ...]
    beyond: Beyond = field(repr=False)
    explained: Explained = field(repr=False)
    gain: float = 0.0
    freedom: int = 0
    score: float = -np.inf
    p_value: float = 1.0

    @property
    def families(self) -> tuple[str, ...]:
        """Of its trials."""
        return tuple(t.family for t in self.trials)

    @property
    def feigned(self) -> float:
        """Gain that noise of the inputs alone may give it."""
        return sum(t.feigned for t in self.trials)

    @property
    def columns(self) -> list[Array]:
        """(N, m, k) of each trial."""
        return [t.columns for t in self.trials]

    @property
    def basis(self) -> Array:
        """Orthonormal (N·m, k) by frequency, of what they do that the unknowns cannot."""
        return self.beyond.basis


def worth(gain: float, freedom: int, searched: float, likelihood: Likelihood) -> float:
    """The score of a gain; `searched`: log of what was looked through."""
    n = len(likelihood.residual)
    rest = max(n - likelihood.declared.shape[1], 2)
    if likelihood.linear.coloured:
        return gain - freedom * float(np.log(rest)) - 2 * searched
    left = np.exp(-gain / n)  # share of the squares that is left
    ratio = (rest - freedom) * np.log1p(n) - rest * np.log1p(n * left)
    return float(ratio - 2 * searched)


def p_value(gain: float, freedom: int, searched: float, likelihood: Likelihood) -> float:
    """Of the F test, shared among what was looked through."""
    from scipy.special import fdtrc

    n = len(likelihood.residual)
    rest = n - likelihood.declared.shape[1] - freedom
    if rest < 1 or freedom < 1:
        return 1.0
    F = np.expm1(min(gain / n, 700.0)) * rest / freedom
    return float(min(1.0, fdtrc(freedom, rest, F) * np.exp(min(searched, 700.0))))


def shared_chance(chance: float, evidence: Evidence, families: int) -> float:
    """A chance shared among what was looked through to find the evidence."""
    searched = min(_searched(evidence.trials, families), 700.0)
    return float(min(1.0, chance * np.exp(searched)))


def screened(beyond: Beyond, likelihood: Likelihood, none: Explained) -> float:
    """The gain of columns under the noise beside none, less its price: to choose among variants."""
    before, H, g, square = likelihood.partly(beyond, none)
    alive = np.diag(H) > likelihood.linear.least**2 * np.diag(before)
    if not alive.any():
        return -np.inf
    gain, freedom = _gain(H[np.ix_(alive, alive)], g[alive])
    return worth(_in_logs(gain, square, likelihood), freedom, 0.0, likelihood)


def _gain(H: Array, g: Array) -> tuple[float, int]:
    """gᵀH⁻¹g over the directions that are told apart, and how many they are."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(size, size))
    good = values > 1e-6 * values.max(initial=0.0)
    return float(np.sum((vectors[:, good].T @ (g / size)) ** 2 / values[good])), int(good.sum())


def _in_logs(gain: float, square: float, likelihood: Likelihood) -> float:
    """2 log L over none, of what is taken from the square of a whitened residual.

    Where the noise is white its variance falls with them; beside a colour the spectrum is held.
    """
    if likelihood.linear.coloured:
        return gain
    left = 1 - gain / max(square, 1e-300)
    return -len(likelihood.residual) * float(np.log(max(left, 1e-15)))


def judged(
    trials: Sequence[Trial],
    likelihood: Likelihood,
    none: Explained,
    *,
    start: Explained | None = None,
    families: int = 1,
    rounds: int = 2,
    beyond: Beyond | None = None,
) -> Evidence | None:
    """Trials together, beside a noise of their own; None where the unknowns do all that they do.

    `beyond`: of their columns, where that is known.
    """
    if beyond is None:
        beyond = Beyond(likelihood, np.concatenate([t.columns for t in trials], axis=2))
    if not beyond.freedom or not _leaves_enough(beyond.freedom, likelihood):
        return None
    before = Evidence(tuple(trials), beyond, start or none)
    return again(before, likelihood, none, families, rounds)


def again(
    evidence: Evidence, likelihood: Likelihood, none: Explained, families: int, rounds: int = 2
) -> Evidence:
    """The same where the likelihood has changed."""
    found = likelihood.beside(evidence.beyond, evidence.explained, rounds)
    gain, freedom = none.cost - found.cost - evidence.feigned, evidence.beyond.freedom
    searched = _searched(evidence.trials, families)
    score = worth(gain, freedom, searched, likelihood)
    return replace(evidence, explained=found, gain=gain, freedom=freedom, score=score,
                   p_value=p_value(gain, freedom, searched, likelihood))  # fmt: skip


def less(evidence: Evidence, gain: float, likelihood: Likelihood, families: int) -> Evidence:
    """The same with so much less gain, which is feigned."""
    trials = tuple(replace(t, feigned=gain / len(evidence.trials)) for t in evidence.trials)
    gain, freedom = evidence.gain + evidence.feigned - gain, evidence.freedom
    searched = _searched(trials, families)
    return replace(evidence, trials=trials, gain=gain,
                   score=worth(gain, freedom, searched, likelihood),
                   p_value=p_value(gain, freedom, searched, likelihood))  # fmt: skip


def with_chance(evidence: Evidence, likelihood: Likelihood, families: int) -> Evidence:
    """With the chance of what it gains now."""
    searched = _searched(evidence.trials, families)
    chance = p_value(evidence.gain, evidence.freedom, searched, likelihood)
    return replace(evidence, p_value=chance)


def priced(evidence: Evidence, gain: float, count: float, families: int) -> Evidence:
    """With a gain of so many independent samples, and their price of an unknown."""
    gain -= evidence.feigned
    price = evidence.freedom * float(np.log(max(count, 2.0)))
    return replace(evidence, gain=gain,
                   score=gain - price - 2 * _searched(evidence.trials, families))  # fmt: skip


def _searched(trials: Sequence[Trial], families: int) -> float:
    """Log of how much was looked through to find these."""
    several = len({t.family for t in trials}) * float(np.log(families))
    return sum(float(np.log(t.variants)) for t in trials) + several


def _leaves_enough(freedom: int, likelihood: Likelihood) -> bool:
    rest = len(likelihood.residual) - likelihood.declared.shape[1]
    return bool(rest - freedom >= max(4, rest / 4))


def on_fewer_axes(evidence: Evidence, likelihood: Likelihood) -> list[int] | None:
    """Axes on which a trial is worth its price; None for all of them.

    By the part of the gain that each choice keeps, under the spectrum beside the whole trial.
    """
    (trial,) = evidence.trials
    if trial.axes is None:
        return None
    names = np.unique(trial.axes)
    if len(names) < 2:
        return None
    before, H, g, square = likelihood.partly(evidence.beyond, evidence.explained)
    alive = np.diag(H) > likelihood.linear.least**2 * np.diag(before)
    best: tuple[float, list[int] | None] = (-np.inf, None)
    for count in range(1, len(names) + 1):
        ways = list(combinations(names, count))
        searched = float(np.log(trial.variants)) + float(np.log(len(ways)))
        for kept in ways:
            own = np.flatnonzero(np.isin(trial.axes, kept))
            gain, freedom = _gain(H[np.ix_(own, own)], g[own]) if alive[own].all() else (0.0, 0)
            if freedom < len(own):
                continue  # what the unknowns, or other axes, can do has no size of its own
            score = worth(_in_logs(gain, square, likelihood), freedom, searched, likelihood)
            if score > best[0] + 1e-9:
                best = (score, [int(k) for k in kept])
    return None if best[1] is None or len(best[1]) == len(names) else best[1]


def shift(evidence: Evidence, likelihood: Likelihood) -> Array:
    """How the declared unknowns move where the trial is added, by what they predict (p,)."""
    root = 1 / np.sqrt(evidence.explained.spectrum)
    Q = likelihood.declared
    flat = np.concatenate(evidence.columns, axis=2)
    G = likelihood.by_frequency(flat)
    size = np.maximum(np.linalg.norm(G, axis=0), 1e-300)
    X = np.concatenate([Q, G / size], axis=1) * root[:, None]
    values = np.linalg.lstsq(X, likelihood.residual * root, rcond=1e-9)[0]
    alone = np.linalg.lstsq(Q * root[:, None], likelihood.residual * root, rcond=1e-9)[0]
    return np.asarray(values[: Q.shape[1]] - alone)


def expected_loss(found: Sequence[Evidence], likelihood: Likelihood) -> tuple[Array, float]:
    """How far off each choice would leave the declared parameters, were each of the others true.

    By what they predict; and that of choosing none. Weights are those of the evidence.
    """
    moved = np.array([shift(e, likelihood) for e in found] + [0 * shift(found[0], likelihood)])
    scores = np.array([e.score for e in found] + [0.0])
    weight = np.exp(0.5 * (scores - scores.max()))
    away = ((moved[:, None, :] - moved[None, :, :]) ** 2).sum(axis=2)
    loss = away @ (weight / weight.sum())
    return loss[:-1], float(loss[-1])
