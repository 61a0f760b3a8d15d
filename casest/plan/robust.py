"""Plans for values that the unknowns may have, drawn from the covariance of a result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.plan.candidates.candidates import Candidates
from casest.plan.design.criteria import Criterion, inverse
from casest.plan.design.several import Several, beside
from casest.plan.planning import Planned, Task, planned

#: Values that are drawn.
DRAWN = 6


def possible_values(
    model: Model,
    values: Mapping[str, Any],
    names: Sequence[str],
    information: Array,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Values of all unknowns, those that all runs share drawn from what is known of them.

    A direction or a rotation stays as it is.
    """
    size = 1 / np.sqrt(np.diag(information))
    root = np.linalg.cholesky(inverse(information * np.outer(size, size))) * size[:, None]
    found = []
    for _ in range(DRAWN):
        off, here, place = root @ rng.standard_normal(len(names)), dict(values), 0
        for p in model.parameters:
            if p.scope != "all":
                continue
            own = off[place : place + p.shape.coordinates]
            place += p.shape.coordinates
            if not p.shape.curved:
                here[p.name] = np.asarray(values[p.name]) + p.shape.unpack(own)
        found.append(here)
    return found


def planned_robustly(
    nominal: Task,
    make: Callable[[Mapping[str, Any]], Candidates],
    drawn: Sequence[Mapping[str, Any]],
    criterion: Criterion,
    count: int,
    worst: bool,
) -> Planned:
    """The best `count` candidates for all drawn values; covariances are those at the nominal ones.

    UsageError where other values mean other measurements.
    """
    first = planned(nominal, criterion, count)  # says so where so many do not determine all
    if not count:
        return first
    every = [make(values) for values in drawn]
    words = every[0].words
    if any(found.words != words or len(found) != len(nominal.factors) for found in every):
        raise UsageError(
            "--robust: with other values of the unknowns these are other measurements; give them "
            "as a table (--candidates)"
        )
    factors = beside([found.factors * nominal.scale for found in every])
    S = len(every)
    known = np.asarray(np.kron(np.eye(S), nominal.known), float)
    blocks = Task(factors, known, np.tile(nominal.scale, S), nominal.names * S, nominal.once)
    plan = planned(blocks, Several(criterion, S, worst), count)
    steps = tuple(nominal.covariance(plan.chosen[:k]) for k in range(count + 1))
    return Planned(plan.chosen, steps, plan.share)
