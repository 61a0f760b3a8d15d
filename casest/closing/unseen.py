"""Scores on a record of its own that neither fit nor decision has seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from casest.closing.candidates import prepared
from casest.closing.crossfit import STRETCHES
from casest.closing.loop import Closing
from casest.data.run import Run
from casest.data.splits import interleaved_blocks
from casest.declaring.shapes import Array
from casest.errors import UsageError
from casest.modelling.model import Model
from casest.solve.trust_region import trust_region
from casest.stack import Problem


def scored(
    closing: Closing, runs: Sequence[Run]
) -> tuple[tuple[Run, ...], list[Array], list[Array]]:
    """The samples that are scored, and their residuals before and after.

    Parameters of the record's own (per run) are refitted on half of its blocks with the shared
    ones kept; the other half is scored.
    """
    scored_runs: list[Run] = []
    before: list[Array] = []
    after: list[Array] = []
    for run in prepared(closing.before.model, runs):
        own = _per_run(closing.after.model) or _per_run(closing.before.model)
        half = np.ones(len(run), dtype=np.bool_)
        if own:
            half = np.asarray(interleaved_blocks(run, STRETCHES, 2) == 1)
        scored_runs.append(run.take(half))
        for estimate, found in ((closing.before, before), (closing.after, after)):
            found.append(_residuals(estimate.model, estimate.values, run, half))
    return tuple(scored_runs), before, after


def _per_run(model: Model) -> list[str]:
    return [p.name for p in model.parameters if p.scope == "run"]


def _residuals(
    model: Model, values: Mapping[str, Array], run: Run, half: NDArray[np.bool_]
) -> Array:
    missing = [s.name for s in model.signals if s.name not in run.signals]
    if missing:
        raise UsageError(f"{run.file}: the held-out record has no {missing[0]!r}")
    own = _per_run(model)
    if own:
        shared = {name: value for name, value in values.items() if name not in own}
        held = model.having(**shared)
        fit = Problem(held, (run.take(~half),))
        start = Problem(model, (run,)).start() if model.starter else None
        guess = Problem(model, (run,)).values(start) if start is not None else {}
        found = trust_region(fit, fit.point({n: v for n, v in guess.items() if n in own}))
        values = {**shared, **fit.values(found.point)}
    problem = Problem(model, (run.take(half),))
    return problem.residuals(problem.point(values))[0]
