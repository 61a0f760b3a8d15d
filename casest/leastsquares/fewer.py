"""A problem on a few of its samples: enough to come near a solution, never for a result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casest.data.run import Run, Series
from casest.declaration.model import Model
from casest.leastsquares.problem import Problem

#: Samples of each run that are enough to come near a solution of a longer record, evenly chosen;
#: and one after the other, where samples need those before.
NEARBY, IN_A_ROW = 2000, 1000


def few_of(problem: Problem) -> Problem | None:
    """The problem on as few of its samples as are enough to come near the solution of all.

    None where it has no more than that, where a look at all of them has told more, or where its
    samples need all the others: equations are integrated from the record's beginning, turns from
    rest to rest.
    """
    if problem.told:
        return None
    axes, runs = len(problem.model.axes), len(problem.runs)
    if not problem.sequential:
        every = problem.residual_count // (NEARBY * axes * runs)
        return None if every < 2 else problem.thinned(every)
    if problem.model.traced.integrates or problem.model.resting:
        return None
    if problem.residual_count < 2 * IN_A_ROW * axes * runs:
        return None
    if "liveliest" not in problem.shortened:
        problem.shortened["liveliest"] = _liveliest(problem)
    return problem.shortened["liveliest"]


def _liveliest(problem: Problem) -> Problem:
    """On the stretch of each run in which its readings change most: what happened before it is
    forgotten, but what late signals were is known."""
    model = problem.model
    short = problem.shorter([_span(run, model) for run in problem.runs])
    late = {a.on for a in model.effects if a.kind == "time"}
    runs = zip(short.runs, problem.runs, strict=True)
    return replace(short, runs=tuple(_apart(run, whole, late, model) for run, whole in runs))


def _span(run: Run, model: Model) -> slice:
    moves = np.zeros(max(len(run) - 1, 0))
    for name in model.traced.readings or [s.name for s in model.signals]:
        change = np.diff(np.asarray(run.signals[name], float), axis=0)
        size = np.nanstd(run.signals[name]) or 1.0
        moves += np.nan_to_num(np.sum((change / size) ** 2, axis=1))
    if len(moves) < IN_A_ROW:
        return slice(0, len(run))
    so_far = np.concatenate([[0.0], np.cumsum(moves)])
    first = int(np.argmax(so_far[IN_A_ROW:] - so_far[:-IN_A_ROW]))
    return slice(first, first + IN_A_ROW)


def _apart(run: Run, whole: Run, late: set[str], model: Model) -> Run:
    """A stretch as a record of its own; of late signals all that was recorded."""
    assert whole.time is not None
    known = {
        name: Series(
            whole.file, whole.time, whole.signals[name], whole.block,
            rotation=model[name].kind == "rotation",
        )
        for name in late
        if name not in whole.elsewhere
    }  # fmt: skip
    return replace(run, whole=None, places=None, elsewhere={**run.elsewhere, **known})
