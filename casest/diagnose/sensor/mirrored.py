"""A memory that runs backward: what it explains is no response of the sensor.

Noise of an input is as much in the rows before a reading as in those after. So what a memory gains
by averaging it away, the same memory gains if time ran backward. What a sensor does comes late: its
mirror image leads, and gains less. So noise of the inputs has no more of a memory than its mirror
image explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.slopes import slopes
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import Index
from casest.diagnose.evidence.score import Trial, judged
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.rows import Rows
from casest.errors import CasestError

#: What is searched over in a memory that averages: a time constant.
AVERAGING = {"memory", "timescale"}
#: Share of the residual's scatter by which it may differ where time runs backward.
SAME = 1e-6


def gain_backward(rows: Rows, fit: Fit, what: Candidate) -> float:
    """What a memory at its held values would gain beside a fit, were time to run backward; infinite
    where there is no saying: of no memory, of a fit that looks at other times itself.

    Only where it averages (its size is above zero): the mirror image of a lag is a lead, and one
    below zero is the lag again.
    """
    linear = rows.linear(fit)
    if not _averages(what) or not linear.coloured or _looks_elsewhere(fit):
        return np.inf
    runs = tuple(map(_backward, rows.runs))
    forward, there = problem_of(fit, rows.runs)
    problem, point = problem_of(fit, runs)
    residuals = zip(forward.residuals(there), problem.residuals(point), strict=True)
    if any(np.abs(a - b[::-1]).max() > SAME * fit.noise for a, b in residuals):
        return np.inf  # it goes with the time
    index = [len(run) - 1 - own[::-1] for run, own in zip(rows.runs, rows.index, strict=True)]
    ((_, columns),) = slopes(problem, point, [what], index)
    if isinstance(columns, CasestError):
        return np.inf
    columns = np.concatenate([part[::-1] for part in _by_run(columns, index)])
    likelihood = Likelihood(linear)
    return _gain_above_zero(likelihood, columns)


def _gain_above_zero(likelihood: Likelihood, columns: Array) -> float:
    """Twice the log of the likelihood that columns (N, m, k) gain, each with a size above zero."""
    none = likelihood.beside()
    while columns.shape[2]:
        found = judged([Trial(None, "", columns)], likelihood, none)
        if found is None:
            break
        sizes = found.beyond.mix @ found.explained.values[-found.freedom :]
        above = sizes > 0
        if above.all():
            return max(found.gain, 0.0)
        columns = columns[:, :, above]
    return 0.0


def _averages(what: Candidate) -> bool:
    effect = what.effect
    if effect is None or effect.kind != "sequence":
        return False
    times = [n for n, kind in effect.profile if kind in AVERAGING]
    held = dict(what.held)
    return bool(times) and all(held.get(n, 0.0) > 0 for n in times)


def _looks_elsewhere(fit: Fit) -> bool:
    model = fit.model
    return model.along.integrates or any(a.kind in OVER_TIME for a in model.effects)


def _by_run(columns: Array, index: Sequence[Index]) -> list[Array]:
    return np.split(columns, np.cumsum([len(own) for own in index])[:-1])


def _backward(run: Run) -> Run:
    """The run as if time ran backward."""
    time = None if run.time is None else -np.asarray(run.time, float)[::-1]
    signals = {n: np.asarray(v)[::-1] for n, v in run.signals.items()}
    if time is not None and "t" in signals:
        signals["t"] = time[:, None]
    return replace(
        run,
        signals=signals,
        columns={n: v[::-1] for n, v in run.columns.items()},
        time=time,
        rows=np.asarray(run.rows)[::-1],
        block=run.block.max(initial=0) - run.block[::-1],
        count=run.count[::-1],
        spread={n: v[::-1] for n, v in run.spread.items()},
        correlation={n: v[::-1] for n, v in run.correlation.items()},
        read={n: v[::-1] for n, v in run.read.items()},
        whole=None,
        places=None,
        averaged=None,
    )
