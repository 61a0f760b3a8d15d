"""What the sensors of a data set have in common that their model lacks: pass by pass over it.

In each round every effect that poses can show is asked of all sensors (`fleet.common`); the
clearest is held at its common size, and the others are asked again. Before and after are compared
on sensors that had no part in that size: each half of the fleet is calibrated with the size that
the other half says. Halves are told by the sensors' names, whatever the order of the rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest.dataset.names import empty, numbers_of
from casest.dataset.partitions import Partition
from casest.dataset.readings import blocks, bound, together
from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import DataError
from casest.fleet.calibrate_many import Batch, calibrate_many
from casest.fleet.common import Trial, added, between, seen, trials
from casest.tasks.job import Job
from casest.tasks.task import alike, side_by_side

#: Rounds at most: so many effects are named.
ROUNDS = 4
#: Values of a column from which on it is no label but a number of its own.
LABELS = 200


class Group(NamedTuple):
    """S sensors with equally many readings (S, N, size) of each signal: which half, and labels."""

    signals: dict[str, Array]
    fold: NDArray[np.int_]
    labels: dict[str, list[Any]]


@dataclass(frozen=True)
class Common:
    """An effect that the fleet has: its unknowns' common size, and how much it explains.

    `chance` where sensors have nothing in common; `follows`: columns along which it differs, with
    the chance of that; `rivals`: effects that explain nearly as much.
    """

    effect: Effect
    names: tuple[str, ...]
    size: Array
    std: Array
    chance: float
    statistic: float
    rivals: tuple[str, ...]
    follows: dict[str, float]
    #: σ of held-out sensors before and after, and the mean move of each unknown in its own std.
    before: float
    after: float
    moved: dict[str, float]


@dataclass
class Told:
    """What was asked of how many sensors, and what they said."""

    sensors: int = 0
    effects: list[Common] = field(default_factory=list)
    #: Of the last round: effect, chance, and whether poses can show it at all.
    tried: list[tuple[str, float, bool]] = field(default_factory=list)


def common(
    job: Job,
    partitions: Sequence[Partition],
    catalogue: Sequence[Effect],
    *,
    chance: float,
    clear: float,
    say: Callable[[str], None] = lambda words: None,
) -> Told:
    """Name the effects that sensors have in common.

    `chance` of naming any where there is none; `clear`: difference of T² up to which another effect
    explains as much. Raises DataError where a file cannot be read, or no sensor is trusted.
    """
    told, model = Told(), job.model
    for k in range(ROUNDS):
        say(f"asking {'all sensors' if not k else 'again'} what they have in common")
        asked = trials(model, [e for e in catalogue if e.name not in _named(told)])
        told.sensors = _ask(job, partitions, model, asked)
        if not told.sensors:
            raise DataError("no sensor is trusted: casest fleet says why, sensor by sensor")
        chances = {t.effect.name: t.whole.chance() for t in asked if seen(t)}
        told.tried = [(t.effect.name, chances.get(t.effect.name, (0, 1.0))[1], seen(t))
                      for t in asked]  # fmt: skip
        best = max((t for t in asked if seen(t)), key=lambda t: _lead(t, chances), default=None)
        if best is None or chances[best.effect.name][1] * len(chances) > chance:
            break
        say(f"comparing before and after {best.effect.name}")
        lead = _lead(best, chances)
        rivals = [t.effect.name for t in asked
                  if t is not best and seen(t) and lead - _lead(t, chances) < clear]  # fmt: skip
        told.effects.append(_judged(job, partitions, model, best, tuple(rivals)))
        model = held(best, best.whole.size[0])
    return told


def held(trial: Trial, size: Array) -> Model:
    """The extended model with the effect at this size."""
    values, first = {}, 0
    for p in trial.extended.parameters:
        if set(p.entry_names) <= set(trial.names):
            values[p.name] = p.shape.unpack(size[first : first + p.shape.size])
            first += p.shape.size
    return trial.extended.having(**values)


def groups(job: Job, partition: Partition) -> Iterator[Group]:
    """Sensors of a partition that can be calibrated, by the number of their readings."""
    for pieces in together(partition.pieces, job.layout):
        for block in blocks(job.layout, pieces):
            signals = bound(block, job.layout, job.model.signals, job.options)
            twice = {name for name, _ in partition.twice}
            usable = ~empty(block.names)
            usable[[*block.bad]] = False
            if twice:
                usable &= np.array([str(n) not in twice for n in block.names.to_pylist()])
            ends = np.concatenate([[0], np.cumsum(block.counts)])
            fold = (numbers_of(block.names) >> np.uint64(7)).astype(np.int64) % 2
            for places in alike(block.counts, np.flatnonzero(usable)):
                for count in np.unique(block.counts[places]):
                    own = places[block.counts[places] == count]
                    given, counts = side_by_side(signals, block.counts, ends, own)
                    given = given if counts is None else {n: v[:, :count] for n, v in given.items()}
                    kept = {n: c.to_pylist() for n, c in block.kept.items()}
                    labels = {n: [values[i] for i in own] for n, values in kept.items()}
                    yield Group(given, fold[own], labels)


def _named(told: Told) -> set[str]:
    return {e.effect.name for e in told.effects}


def _lead(trial: Trial, chances: dict[str, tuple[float, float]]) -> float:
    """T² less what the unknowns cost: log of the number of sensors each (Schwarz)."""
    whole = trial.whole
    return chances[trial.effect.name][0] - len(trial.names) * float(np.log(whole.count))


def _ask(job: Job, partitions: Sequence[Partition], model: Model, asked: Sequence[Trial]) -> int:
    """Add all sensors to all trials; returns how many."""
    total = 0
    for partition in partitions:
        for group in groups(job, partition):
            found = calibrate_many(model, group.signals, noise=job.noise)
            good = found.trusted
            total += int(good.sum())
            readings = [group.signals[s.name][good] for s in model.signals]
            labels = {n: [v for v, g in zip(own, good, strict=True) if g]
                      for n, own in group.labels.items()}  # fmt: skip
            for trial in asked if good.any() else ():
                added(trial, unknowns(found)[good], readings, group.fold[good], labels)
    return total


def unknowns(found: Batch) -> Array:
    """Fitted unknowns (S, n) of a batch."""
    rows = []
    for p in found.model.parameters:
        for index in p.shape.entries:
            entry: Any = (slice(None), *index)
            rows.append(found.values[p.name][entry])
    return np.stack(rows, axis=1)


def _judged(
    job: Job,
    partitions: Sequence[Partition],
    model: Model,
    trial: Trial,
    rivals: tuple[str, ...],
) -> Common:
    """Before and after on sensors that had no part in the size, and what the effect follows."""
    ways = [held(trial, trial.folds[1 - k].size[0]) for k in (0, 1)]
    before = after = 0.0
    count, moves = 0, np.zeros(sum(p.shape.size for p in model.parameters))
    for partition in partitions:
        for group in groups(job, partition):
            for k in (0, 1):
                own = {n: v[group.fold == k] for n, v in group.signals.items()}
                if not (group.fold == k).any():
                    continue
                one, other = calibrate_many(model, own), calibrate_many(ways[k], own)
                good = one.trusted & other.trusted
                before += float(np.sum(one.sigma[good] ** 2))
                after += float(np.sum(other.sigma[good] ** 2))
                std = np.sqrt(np.einsum("sii->si", one.covariance[good]))
                moves += ((unknowns(other) - unknowns(one))[good] / std).sum(axis=0)
                count += int(good.sum())
    size, covariance = trial.whole.size
    statistic, chance = trial.whole.chance()
    names = [n for p in model.parameters for n in p.entry_names]
    columns = [c for c, own in trial.groups.items() if len(own) <= LABELS]
    return Common(
        replace(trial.effect),
        trial.names,
        size,
        np.sqrt(np.diag(covariance)),
        chance,
        statistic,
        rivals,
        {c: between(trial, c) for c in columns},
        float(np.sqrt(before / max(count, 1))),
        float(np.sqrt(after / max(count, 1))),
        dict(zip(names, (moves / max(count, 1)).tolist(), strict=True)),
    )
