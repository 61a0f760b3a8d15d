"""Causes by what they are worth beside one fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.input_noise import at_most, feigned
from casest.diagnose.evidence.likelihood import Beyond, Likelihood, far_out
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import (
    Evidence,
    Trial,
    again,
    judged,
    less,
    on_fewer_axes,
    screened,
)
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.state import F, Ranking
from casest.diagnose.protocol.subject import Subject


def ranked(subject: Subject[F], fit: F) -> Ranking:
    """Every cause beside a fit: the best variants of each family, each with a noise of its own."""
    return refined(subject, fit, ranked_of(subject.linear(fit), subject.trials(fit)))


def refined(subject: Subject[F], fit: F, ranking: Ranking) -> Ranking:
    """Each on the axes that it needs, near its best values, less what noise of inputs feigns."""
    whole = {e.trials[0].family: e for e in ranking.found}
    found = tuple(on_its_axes(subject, fit, e, ranking) for e in ranking.found)
    found = without_feigned(subject, fit, ranking.likelihood, found, ranking.families)
    ranking = _about_the_best(replace(ranking, found=best_first(found)))
    # What describes a course is compared with causes that are: at its own best as they are.
    courses = [e for e in ranking.courses if e.trials[0].what.held]
    near = [*ranking.causes[: LEVELS.contenders], *courses]
    near = [e for e in near if e.score > -LEVELS.clear]
    finer = {e.trials[0].family: _finer(subject, fit, ranking, e, whole) for e in near}
    found = tuple(finer.get(e.trials[0].family, e) for e in ranking.found)
    found = without_feigned(subject, fit, ranking.likelihood, found, ranking.families)
    return replace(ranking, found=best_first(found))


def _finer(
    subject: Subject[F],
    fit: F,
    ranking: Ranking,
    evidence: Evidence,
    whole: Mapping[str, Evidence],
) -> Evidence:
    """At the best value near that of the grid: also on all axes first, since on which it shows is
    seen at that value alone."""
    found = sharpened(subject, fit, ranking, evidence)
    every = whole[evidence.trials[0].family]
    if found.trials[0] is evidence.trials[0] or every.freedom == evidence.freedom:
        return found
    every = sharpened(subject, fit, ranking, every)
    every = on_its_axes(subject, fit, every, ranking)
    return every if every.score > found.score else found


def without_feigned(
    subject: Subject[F],
    fit: F,
    likelihood: Likelihood,
    found: Sequence[Evidence],
    families: int,
) -> tuple[Evidence, ...]:
    """The same without the gain that noise of the inputs alone may give."""
    asked = [e for e in found if e.score > 0]
    noisy = subject.jittered(fit, [t for e in asked for t in e.trials]) if asked else ()
    inputs = [[(Likelihood(linear), columns) for linear, columns in draws] for draws in noisy]
    charged: dict[int, Evidence] = {}
    for e in asked:
        gains = [feigned(e, likelihood, _columns(e, draws)) for draws in inputs]
        gain = max(gains, default=0.0)
        if gain > 0 and len(e.trials) == 1:
            mirror = subject.gain_backward(fit, e.trials[0])
            gain = min(gain, at_most(mirror, len(likelihood.residual)))
        charged[id(e)] = less(e, gain, likelihood, families)
    return tuple(charged.get(id(e), e) for e in found)


def _columns(
    evidence: Evidence, draws: Sequence[tuple[Likelihood, Mapping[int, Array]]]
) -> list[tuple[Likelihood, Array]]:
    """Those of the evidence's trials, side by side, in every draw that has them."""
    own = [id(t) for t in evidence.trials]
    return [
        (likelihood, np.concatenate([columns[k] for k in own], axis=2))
        for likelihood, columns in draws
        if columns.keys() >= set(own)
    ]


def ranked_of(linear: Linear, trials: Sequence[Trial]) -> Ranking:
    """The best variant of each family, with a noise of its own."""
    likelihood = Likelihood(linear)
    none = likelihood.beside()
    families = max(len({t.family for t in trials}), 1)
    best: dict[str, tuple[float, Trial, Beyond]] = {}
    most: dict[str, tuple[float, Trial]] = {}
    for trial in trials:
        beyond = Beyond(likelihood, trial.columns)
        if not trial.describes:
            known, share = most.get(trial.family, (LEVELS.most, trial)), beyond.share
            most[trial.family] = (share, trial) if share > known[0] else known
        promise = screened(beyond, likelihood, none)
        if trial.family not in best or promise > best[trial.family][0]:
            best[trial.family] = (promise, trial, beyond)
    found = [
        judged([trial], likelihood, none, families=families, beyond=beyond)
        for promise, trial, beyond in best.values()
        if promise > -np.inf
    ]
    several = best_first([e for e in found if e is not None])
    order = {family: k for k, family in enumerate(dict.fromkeys(t.family for t in trials))}
    taking = sorted((m for m in most.values() if m[0] > LEVELS.most), key=lambda m: -m[0])
    return Ranking(linear, likelihood, none, several, families, order, tuple(t for _, t in taking))


def best_first(found: Sequence[Evidence]) -> tuple[Evidence, ...]:
    """By score."""
    return tuple(sorted(found, key=lambda e: -e.score))


def on_its_axes(subject: Subject[F], fit: F, evidence: Evidence, ranking: Ranking) -> Evidence:
    """Without the axes that are not worth their price."""
    axes = on_fewer_axes(evidence, ranking.likelihood)
    if axes is None:
        return evidence
    trial = subject.on_axes(fit, evidence.trials[0], axes)
    less = judged([trial], ranking.likelihood, ranking.none, start=evidence.explained,
                  families=ranking.families)  # fmt: skip
    whole = evidence.freedom == evidence.trials[0].columns.shape[2]  # else no size of its own
    return less if less is not None and (less.score > evidence.score or not whole) else evidence


def _about_the_best(ranking: Ranking) -> Ranking:
    """The same with what is far out told from the best course: far from none may be the cause."""
    if not ranking.found or not ranking.linear.series:
        return ranking
    best, families = ranking.found[0], ranking.families
    if best.score < 0:
        return ranking
    cut = far_out(ranking.linear.residual - best.explained.course)
    likelihood = ranking.likelihood.cutting(cut)
    none = likelihood.beside(start=ranking.none)
    found = best_first([again(e, likelihood, none, families, 1) for e in ranking.found])
    return replace(ranking, likelihood=likelihood, none=none, found=found)


def sharpened(subject: Subject[F], fit: F, ranking: Ranking, evidence: Evidence) -> Evidence:
    """At the best value near the one that a grid had: the grid is coarse."""
    for k, trial in enumerate(evidence.trials):
        others = [t for t in evidence.trials if t is not trial]
        for scale in (1.0, 0.3, 0.1):
            for moved in subject.nearer(fit, evidence.trials[k], scale):
                moved = replace(moved, feigned=trial.feigned)
                both = [*others[:k], moved, *others[k:]]
                found = judged(both, ranking.likelihood, ranking.none, start=evidence.explained,
                               families=ranking.families, rounds=1)  # fmt: skip
                if found is not None and found.score > evidence.score:
                    evidence = found
    return evidence


def pairs(ranking: Ranking) -> list[Evidence]:
    """The best causes two by two: what neither shows alone."""
    best = ranking.causes[: LEVELS.contenders]
    found = []
    for one, other in combinations(best, 2):
        both = judged(
            [*one.trials, *other.trials],
            ranking.likelihood,
            ranking.none,
            start=one.explained,
            families=ranking.families,
        )
        if both is not None and both.freedom > max(one.freedom, other.freedom):
            found.append(both)
    return sorted(found, key=lambda e: -e.score)
