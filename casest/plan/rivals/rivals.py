"""The causes that a closed loop left open, each refitted to the record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.sensor import Sensor
from casest.diagnose.sensor.fits import Fit
from casest.effects import CATALOGUE
from casest.effects.placing import prepared
from casest.errors import UsageError
from casest.leastsquares.problem import Problem
from casest.plan.candidates.candidates import marginal, of_last_run

#: Causes that are looked at, the most likely ones; values of a grid at which each is refitted.
MOST, GRID = 5, 12


@dataclass(frozen=True)
class Rival:
    """One cause: the model with it, fitted to the record.

    information (n, n): of the record, in the unknowns that all runs share. cost: χ² there. values:
    of the last run, where runs differ.
    """

    label: str
    model: Model
    values: Mapping[str, Array]
    information: Array
    cost: float


def open_causes(content: Mapping[str, Any], model: Model) -> tuple[Model, list[str]]:
    """The model without what is in doubt, and the labels of the causes between which it is.

    Of the first effect that was added and has others that explain as much; else those of which none
    was added. Empty where nothing is in doubt.
    """
    for effect in content.get("effects") or []:
        alike = list(effect.get("indistinguishable_from") or [])
        own = next((a for a in model.effects if a.effect.name == effect["name"]), None)
        if alike and own is not None:
            left = tuple(a for a in model.effects if a is not own)
            names = {p.name for a in left for p in a.parameters}
            declared = tuple(s for s in model.declared if "." not in s.name or s.name in names)
            return replace(model, effects=left, declared=declared), [own.label, *alike]
    named = (content.get("unexplained") or {}).get("one_of") or []
    return model, list(named)


def refitted(
    model: Model,
    values: Mapping[str, Array],
    runs: Sequence[Run],
    labels: Sequence[str],
    sigma: Array,
) -> list[Rival]:
    """Each cause with its best fit to the record; UsageError where fewer than two have one."""
    sensor = Sensor(model, prepared(model, tuple(runs)), CATALOGUE)
    own = {name: v for name, v in values.items() if name in {p.name for p in model.parameters}}
    base = sensor.fitted(model, own)
    if base is None:
        raise UsageError(f"{model.name}: its fit to the record fails; close the loop again")
    trials = sensor.trials(base)
    found: list[Rival] = []
    why: list[str] = []
    for label in labels:
        if len(found) == MOST:
            break
        several = [t for t in trials if t.family == label]
        fits = [sensor.refit(base, [t]) for t in several[:: max(1, len(several) // GRID)]]
        good = [f for f in fits if not isinstance(f, str)]
        if not good:
            why.append(f"{label} ({next(iter(fits), 'it does not apply')})")
            continue
        best = min(good, key=_squares)
        if any(a.kind in OVER_TIME for a in best.model.effects):
            why.append(f"{label} (it acts on the sequence of samples, and one shows none of it)")
            continue
        found.append(rival_of(label, best, sensor.runs, sigma))
    if len(found) < 2:
        said = "; ".join(why) or "none is named"
        raise UsageError(f"{model.name}: no two causes can be planned for: {said}")
    return found


def _squares(fit: Fit) -> float:
    return float(sum(np.sum(r**2) for r in fit.residuals))


def rival_of(label: str, fit: Fit, runs: tuple[Run, ...], sigma: Array) -> Rival:
    """A fit as a rival."""
    weights = tuple(np.broadcast_to(1 / sigma**2, (len(run), len(sigma))) for run in runs)
    problem = Problem(fit.model, runs, weights)
    normal = problem.normal(problem.point(fit.values))
    shared = sum(p.shape.coordinates for p in fit.model.parameters if p.scope == "all")
    values = {n: of_last_run(fit.model, n, np.asarray(v)) for n, v in fit.values.items()}
    known = marginal(normal.matrix, shared)
    return Rival(label, fit.model, values, known, 2 * normal.cost)
