"""What sensors of a data set lack, each in a size of its own (`fleet.spread`): one more pass.

Asked beside what they have in common, which is held at its common size; also of that itself, which
may differ from sensor to sensor around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from casest.dataset.partitions import Partition
from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.fleet.calibrate_many import calibrate_many
from casest.fleet.common import Trial, trials
from casest.fleet.spread import Excess, excess, in_errors
from casest.tasks.common import Common, groups, held, unknowns
from casest.tasks.job import Job

#: Sensors that are asked: of a larger fleet the first ones.
ASKED = 50_000
#: Share of the sensors that must say something of an effect.
SAID = 0.5


@dataclass(frozen=True)
class OwnSize:
    """An effect of which each sensor has a size of its own: root mean square over sensors of each
    unknown, with its error; in how many sensors; σ before and with it; what explains as much."""

    effect: Effect
    names: tuple[str, ...]
    size: Array
    error: Array
    chance: float
    sensors: int
    before: float
    after: float
    rivals: tuple[str, ...]


@dataclass(frozen=True)
class Spreads:
    """What was asked, with the chance of as much where no effect has a spread; what was found."""

    tried: dict[str, float] = field(default_factory=dict)
    found: OwnSize | None = None


def own_sizes(
    job: Job,
    partitions: Sequence[Partition],
    catalogue: Sequence[Effect],
    known: Sequence[Common],
    *,
    chance: float,
    apart: float,
    say: Callable[[str], None] = lambda words: None,
) -> Spreads:
    """Name the effect of which each sensor has a size of its own, if there is one.

    `known`: what they have in common. `chance` of naming any where there is none; `apart`: standard
    errors up to which another effect explains as much.
    """
    say("asking whether each sensor has something of its own")
    model = _holding(job.model, known)
    asked = trials(model, [e for e in catalogue if e.name not in {k.effect.name for k in known}])
    asked += [_around(job.model, known, k) for k in range(len(known))]
    told = _asked(job, partitions, model, asked)
    chances = {name: e.chance()[1] for name, e in told.items()}
    best = min(chances, key=lambda name: chances[name], default=None)
    if best is None or chances[best] * len(chances) > chance:
        return Spreads(chances)
    alike = [n for n, e in told.items() if in_errors(told[best].over - e.over) < apart]
    common = [k.effect.name for k in known if k.effect.name in alike]
    name = common[0] if common else best  # what is there anyway, and differs, is one cause, not two
    own, rivals = told[name], tuple(n for n in alike if n != name)
    trial = next(t for t in asked if t.effect.name == name)
    found = OwnSize(
        trial.effect, trial.names, *own.size, chances[name], own.told, *own.sigma, rivals
    )
    return Spreads(chances, found)


def _holding(model: Model, known: Sequence[Common]) -> Model:
    """The model with effects at their common sizes."""
    for one in known:
        (trial,) = trials(model, [one.effect])
        model = held(trial, one.size)
    return model


def _around(model: Model, known: Sequence[Common], k: int) -> Trial:
    """An effect that all have in common, as one that differs from that."""
    others = [*known[:k], *known[k + 1 :]]
    (trial,) = trials(_holding(model, others), [known[k].effect])
    return replace(trial, null=known[k].size)


def _asked(
    job: Job, partitions: Sequence[Partition], model: Model, asked: Sequence[Trial]
) -> dict[str, Excess]:
    """What the first ASKED sensors say of each effect, where enough of them say something."""
    parts: dict[str, list[Excess]] = {t.effect.name: [] for t in asked}
    total = 0
    for group in (g for partition in partitions for g in groups(job, partition)):
        fitted = calibrate_many(model, group.signals, noise=job.noise)
        good = np.flatnonzero(fitted.trusted)[: ASKED - total]
        total += len(good)
        readings = [group.signals[s.name][good] for s in model.signals]
        for trial in asked if len(good) else ():
            own = excess(trial, unknowns(fitted)[good], readings)
            parts[trial.effect.name].append(own)
        if total >= ASKED:
            break
    found = {name: Excess.joined(own) for name, own in parts.items() if own}
    return {name: e for name, e in found.items() if e.told > SAID * total}
