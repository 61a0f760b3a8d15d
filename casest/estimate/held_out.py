"""Scores on records of their own that no fit has seen.

Parameters of such a record alone (per run) are refitted on half of its blocks with the shared ones
kept; the other half is scored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import fdtrc

from casest.data.run import Run
from casest.data.splits import interleaved_blocks
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.estimate.estimate import Estimate
from casest.leastsquares.kinds import whitened
from casest.leastsquares.problem import Problem
from casest.leastsquares.stated import UNLIKELY
from casest.solve.horizon import grown
from casest.solve.trust_region import trust_region

#: Stretches that a held-out record is cut into; every other one is scored.
STRETCHES = 40
#: Errors on another record over those of the fit from which on they are said to be larger; standard
#: deviations of the fit that one of them counts as at most.
LARGER, CLIP = 1.5, 3.5
#: What is said of effects that are not there in a record that is scored.
ALONE = (
    "happened in the record of the fit; another one is foretold without what passed, and with the "
    "mean over that of what stayed"
)


def foretold(found: Estimate, runs: Sequence[Run]) -> list[Array]:
    """Residuals (N, m) of the estimate on each of the runs, which it did not see."""
    model = lasting(found)
    halves = [split(run, (model,)) for run in runs]
    return [residuals(model, model.among(found.values), *half) for half in halves]


def times_worse(found: Estimate, other: Sequence[Array]) -> float | None:
    """How many times the errors of a fit those on another record (N, m) are; None where chance, a
    few rows or the unknowns' own errors may be why."""
    problem = whitened(found.problem, found.point)
    own = problem.told_residuals(found.point)
    freedom = sum(int(np.isfinite(r).sum()) for r in own) - problem.unknowns
    return times_larger(own, other, freedom, found.correlated_over)


def times_larger(
    fitted: Sequence[Array], other: Sequence[Array], freedom: float, over: float
) -> float | None:
    """The same of residuals, those fitted with so many degrees of `freedom`, all alike `over` so
    many rows: F, clipped as a robust fit's are, since a spike is no record."""
    own, there = _finite(fitted), _finite(other)
    sigma = float(np.sqrt(np.mean(own**2))) if own.size else 0.0
    if not there.size or not sigma > 0:
        return None
    clipped = np.sqrt(np.mean(np.clip(there / sigma, -CLIP, CLIP) ** 2))
    chance = fdtrc(there.size / over, freedom / over, clipped**2 * freedom / own.size)
    times = float(np.sqrt(np.mean(there**2)) / sigma)
    return times if clipped >= LARGER and chance < UNLIKELY else None


def _finite(residuals: Sequence[Array]) -> Array:
    every = np.concatenate([r.ravel() for r in residuals])
    return np.asarray(every[np.isfinite(every)])


def happened_once(found: Estimate) -> tuple[str, ...]:
    """Effects that say nothing of another record than the fitted one."""
    kept = lasting(found).effects
    return tuple(a.label for a in found.model.effects if a not in kept)


def lasting(found: Estimate) -> Model:
    """The fitted model as it is for other records."""
    return found.model.elsewhere([run.span for run in found.problem.runs])


def split(run: Run, models: Sequence[Model]) -> tuple[Run | None, Run]:
    """The half that per-run parameters are fitted to, if any model has them, and what is scored."""
    if not any(map(per_run, models)):
        return None, run
    half = np.asarray(interleaved_blocks(run, STRETCHES, 2) == 1)
    return run.take(~half), run.take(half)


def residuals(model: Model, values: Mapping[str, Array], fitted: Run | None, scored: Run) -> Array:
    """Residuals (N, m) of the scored samples, the record's own parameters from the fitted ones."""
    missing = [s.name for s in model.signals if s.name not in scored.signals]
    if missing:
        raise UsageError(f"{scored.file}: the held-out record has no {missing[0]!r}")
    if fitted is not None and per_run(model):
        values = with_own(model, values, (fitted,))
    problem = Problem(model, (scored,))
    point = problem.point(values)
    return whitened(problem, point).residuals(point)[0]


def per_run(model: Model) -> list[str]:
    """Names of the parameters that each run has of its own."""
    return [p.name for p in model.parameters if p.scope == "run"]


def with_own(model: Model, values: Mapping[str, Array], runs: Sequence[Run]) -> dict[str, Array]:
    """The values with those parameters fitted that each of these runs has of its own."""
    own = per_run(model)
    shared = {name: value for name, value in values.items() if name not in own}
    fit = Problem(model.having(**shared), tuple(runs))
    alone = Problem(model, tuple(runs))
    guess = alone.values(alone.start()) if model.starter else {}
    start = fit.point({n: v for n, v in guess.items() if n in own})
    # From anywhere else equations lose step with a record: they are fitted from its beginning on.
    found = (grown if model.traced.integrates else trust_region)(fit, start)
    return {**shared, **fit.values(found.point)}
