"""A plan: which candidates next, in which order, and how good that is beside the best possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.plan.design.continuous import certified, continuous, slopes
from casest.plan.design.criteria import (
    Criterion,
    Largest,
    Longest,
    Trace,
    Volume,
    inverse,
)
from casest.plan.design.distinct import distinct, floor_of
from casest.plan.design.exact import exchanged, in_order, rounded
from casest.plan.goals import Goal

#: Candidates that whole measurements are chosen from: those of the largest slopes.
POOL = 400
#: Measurements from which on their weights need no exchange.
MANY = 60
#: Information of one candidate, as a share of their mean, that stands in for what is not known yet:
#: standard deviations 10⁴ times those of one measurement.
VAGUE = 1e-8
#: Share of the largest eigenvalue, of scaled unknowns, below which one is not determined.
NULL = 1e-12


@dataclass(frozen=True)
class Known:
    """What is known of the unknowns before: information (n, n), in their own units."""

    information: Array


@dataclass(frozen=True)
class Planned:
    """The chosen candidates, those first that bring most; of a run's times the earliest.

    covariances: before, and after each of them, (n, n), infinite where undetermined. value: of the
    criterion at the end; share: of its standard deviations that the best possible design of as many
    measurements has at least. at_least: fewer than so many never reach the goals.
    """

    chosen: tuple[int, ...]
    covariances: tuple[Array | None, ...]
    share: float
    at_least: int | None = None


@dataclass(frozen=True)
class Task:
    """Candidates' factors (N, k, n), what is known (n, n), and the criterion, in scaled unknowns.

    `scale` (n,): the unknowns' own sizes. once: no candidate can be made again.
    """

    factors: Array
    known: Array
    scale: Array
    names: tuple[str, ...]
    once: bool = False

    @property
    def start(self) -> Array:
        """What is known, and a trace of everything, so that an inverse exists."""
        return np.asarray(self.known + VAGUE * np.eye(len(self.scale)))

    def information(self, chosen: Sequence[int]) -> Array:
        """Of what is known and the chosen candidates, in scaled unknowns."""
        own = self.factors[list(chosen)].reshape(-1, len(self.scale))
        return np.asarray(self.known + own.T @ own)

    def covariance(self, chosen: Sequence[int]) -> Array | None:
        """In the unknowns' own units; None where something is not determined."""
        M = self.information(chosen)
        values = np.linalg.eigvalsh(M)
        if not values[0] > NULL * values[-1]:
            return None
        return np.asarray(inverse(M) * np.outer(self.scale, self.scale))


def task(factors: Array, known: Array, names: Sequence[str], what: str, once: bool = False) -> Task:
    """The task in unknowns whose sizes are what one average candidate says of each alone.

    UsageError where no candidate, nor what is known, says anything of an unknown, or of some
    combination of them.
    """
    N, _, n = factors.shape
    every = factors.reshape(-1, n)
    single = np.einsum("ij,ij->j", every, every) / N
    alone = single + np.diag(known) / N
    if not np.all(alone > 0):
        silent = ", ".join(name for name, a in zip(names, alone, strict=True) if not a > 0)
        raise UsageError(f"{what}: no candidate says anything of {silent}: vary what it depends on")
    scale = 1 / np.sqrt(alone)
    scaled = Task(factors * scale, known * np.outer(scale, scale), scale, tuple(names), once)
    return scaled


def undetermined(given: Task) -> Array:
    """Combinations that all candidates together leave open, (n, k), in the unknowns' own units."""
    values, axes = np.linalg.eigh(given.information(range(len(given.factors))))
    null = axes[:, values <= NULL * max(values[-1], 1e-300)]
    return np.asarray(null * given.scale[:, None])


def criterion_of(given: Task, name: str, columns: Array | None = None) -> Criterion:
    """D, A, E, or the largest of some combinations: columns (n, c) in the unknowns' own units."""
    n = len(given.scale)
    if columns is not None:
        return Largest(_with_all(columns * given.scale[:, None], given))
    if name == "D":
        return Volume()
    return Trace(np.eye(n)) if name == "A" else Longest()


#: Size of an unknown that a goal does not name, beside what the goal asks for: its standard
#: deviation may be larger by this factor, in units of what one candidate says of it.
LOOSE = 30.0
#: Share of standard deviations to which a number of measurements is looked for.
ROUGHLY = 0.01
#: Variance of a scaled unknown from which on nothing is known of it.
UNKNOWN = 1e4


def _with_all(columns: Array, given: Task) -> Array:
    """The combinations and, with little weight, what is unknown yet: nothing is to stay so."""
    size = np.linalg.norm(columns, axis=0).min() / LOOSE
    unknown = np.diag(inverse(given.start)) > UNKNOWN
    return np.hstack([columns, np.eye(len(given.scale))[:, unknown] * size])


def planned(given: Task, criterion: Criterion, count: int) -> Planned:
    """The best `count` candidates, each as often as it is worth."""
    if not count:
        return Planned((), (given.covariance(()),), 1.0, 0)
    chosen, floor = _best(given, criterion, count)
    if given.covariance(chosen) is None:
        rank = np.linalg.matrix_rank(given.information(chosen), hermitian=True)
        raise UsageError(
            f"{count} measurements determine {rank} of {len(given.scale)} unknowns: plan more "
            "(--count)"
        )
    if not given.once:
        chosen = in_order(criterion, given.start, given.factors, chosen)
    steps = tuple(given.covariance(chosen[:k]) for k in range(count + 1))
    start = given.start + given.information(chosen) - given.known
    value = criterion.value(inverse(start))
    return Planned(tuple(chosen), steps, criterion.ratio(floor, value, len(given.scale)))


def _best(given: Task, criterion: Criterion, count: int) -> tuple[list[int], float]:
    """The best candidates, and the least value of the criterion that so many can have."""
    if given.once:
        return _best_once(given, criterion, count)
    best = continuous(criterion, given.start, given.factors, count)
    chosen = _whole(given, criterion, best.weights, count)
    weights = np.bincount(chosen, minlength=len(given.factors)) / count
    floor = certified(criterion, given.start, given.factors, weights, count)[1]
    return chosen, max(floor, best.floor)


def _best_once(given: Task, criterion: Criterion, count: int) -> tuple[list[int], float]:
    N = len(given.factors)
    if count > N:
        raise UsageError(f"--count {count}: there are {N} times at which one can read")
    chosen = distinct(criterion, given.start, [given.factors], count, False)
    C = inverse(given.start + given.information(chosen) - given.known)
    return chosen, floor_of(criterion, C, given.factors, chosen)


def _whole(given: Task, criterion: Criterion, weights: Array, count: int) -> list[int]:
    """Whole measurements from weights, exchanged among the candidates that matter."""
    M = given.start + np.einsum("i,ikm,ikn->mn", count * weights, given.factors, given.factors)
    C = inverse(M)
    worth = slopes(C, criterion.weight(C), given.factors)
    first = rounded(weights, count)
    if count > MANY:  # rounded to whole numbers, little is lost
        return first
    pool = np.union1d(np.argsort(-worth)[:POOL], first)
    places = [int(np.searchsorted(pool, i)) for i in first]
    found = exchanged(criterion, given.start, given.factors[pool], places)
    return [int(pool[i]) for i in found]


def until(given: Task, goals: Sequence[Goal], most: int) -> Planned:
    """The fewest candidates after which every goal is reached, at most `most`.

    UsageError with the best possible where it is not.
    """
    most = min(most, len(given.factors)) if given.once else most
    criterion = Largest(np.hstack([goal.scaled * given.scale[:, None] for goal in goals]))
    if criterion.value(inverse(given.start)) <= 1:
        return Planned((), (given.covariance(()),), 1.0, 0)
    steady = Largest(_with_all(criterion.K, given))
    floor = continuous(criterion, given.start, given.factors, most, ROUGHLY).floor
    if floor > 1:
        raise UsageError(_unreachable(given, goals, planned(given, steady, most), most))
    low = _fewest(given, criterion, most, floor)
    found, at_least = None, low
    high = low
    while found is None:
        found = _reached(given, steady, criterion, high)
        if found is None:
            if high == most:
                raise UsageError(_unreachable(given, goals, planned(given, steady, most), most))
            low, high = high + 1, min(most, high + max(1, high // 8))
    while low < high:
        middle = (low + high) // 2
        fewer = _reached(given, steady, criterion, middle)
        if fewer is None:
            low = middle + 1
        else:
            found, high = fewer, middle
    return Planned(found.chosen, found.covariances, found.share, at_least)


def _fewest(given: Task, criterion: Criterion, most: int, floor: float) -> int:
    """A number below which even a continuous design does not reach the goals.

    `floor` is that of `most`; a variance falls about as one over the number.
    """
    low, high = 1, most
    while low < high:
        guess = min(max(int(high * floor), low, (3 * low + high) // 4), high - 1)
        there = continuous(criterion, given.start, given.factors, guess, ROUGHLY).floor
        if there > 1:
            low = guess + 1
        else:
            high, floor = guess, there
    return low


def _reached(given: Task, steady: Criterion, criterion: Criterion, count: int) -> Planned | None:
    try:
        found = planned(given, steady, count)
    except UsageError:
        return None
    last = found.covariances[-1]
    assert last is not None
    scaled = last / np.outer(given.scale, given.scale)
    return found if criterion.value(scaled) <= 1 else None


def _unreachable(given: Task, goals: Sequence[Goal], best: Planned, most: int) -> str:
    last = best.covariances[-1]
    assert last is not None
    said = ", ".join(
        f"{goal.name} {goal.std(last):.3g}{' ' + goal.unit if goal.unit != '1' else ''}"
        for goal in goals
    )
    asked = " and ".join(f"{goal}" for goal in goals)
    out = "allow more (--most), or a sensor with less noise"
    if given.once and most == len(given.factors):
        out = "a longer run (--duration), a higher --rate, or a sensor with less noise"
    return (
        f"{asked} cannot be reached with {most} measurements: the best possible are {said}; {out}"
    )
