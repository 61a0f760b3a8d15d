"""The mirror image of a memory, about its own mean delay: what it explains may be noise and a lag.

Noise of an input is as much in the rows before a reading as in those after. So what a memory gains
by averaging it away, its mirror image gains as well, moved to be as late on average: what is left
between the two is how a sensor responds, at once and then more and more slowly. Noise of the inputs
has no more of a memory than its mirror image explains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.score import Trial, judged
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.rows import Rows
from casest.leastsquares.problem import Problem

#: What is searched over in a memory that averages: a time constant.
AVERAGING = {"memory", "timescale"}
#: Share of the residual's scatter by which it may differ where time runs backward.
SAME = 1e-6


def gain_backward(rows: Rows, fit: Fit, what: Candidate) -> float:
    """What the mirror image of a memory at its held values gains beside a fit; infinite where there
    is no saying: of no memory, of a fit that looks at other times itself.

    Only where it averages (its size is above zero).
    """
    linear, measured = rows.linear(fit), fit.model.traced.measured
    if not _averages(what) or not linear.coloured or _looks_elsewhere(fit) or not measured:
        return np.inf
    runs = tuple(map(_backward, rows.runs))
    forward, there = problem_of(fit, rows.runs)
    before, plain = forward.residuals(there), Problem(fit.model, runs)
    same = zip(before, plain.residuals(plain.point(fit.values)), strict=True)
    if not max(np.abs(a - b[::-1]).max() for a, b in same) <= SAME * fit.noise:
        return np.inf  # it goes with the time, or is no number somewhere
    whole = what.free().added_to(fit.model)
    new = {p.name: p.shape.dims for p in whole.parameters if p.name not in fit.values}
    times = {f"{what.label}.{n}": v for n, v in what.held}
    sizes = [name for name in new if name not in times]  # of one all of the response is late
    values = {name: np.full(dims, times.get(name, 1.0)) for name, dims in new.items()}
    problem = Problem(whole, runs)
    residuals = problem.residuals(problem.point({**fit.values, **values}))
    delay = 2 * max(v for n, v in what.held if n in _times(what))
    moved = []
    for run, r, own in zip(rows.runs, before, residuals, strict=True):
        mirror = _late(run.signals[measured] - own[::-1], run, delay)
        change = mirror - (run.signals[measured] - r)
        each = change[:, :, None] * np.eye(change.shape[1]) if sizes else change[:, :, None]
        moved.append(each)
    return _gain_above_zero(Likelihood(linear), rows.of(moved) * linear.root[:, :, None])


def _late(x: Array, run: Run, delay: float) -> Array:
    """Values (N, m) of each stretch as they were some time before; what was before it nobody
    knows."""
    assert run.time is not None
    found, t = x.copy(), np.asarray(run.time, float)
    for block in np.unique(run.block):
        own = run.block == block
        for k in range(x.shape[1]):
            found[own, k] = np.interp(t[own] - delay, t[own], x[own, k])
    return found


def _gain_above_zero(likelihood: Likelihood, columns: Array) -> float:
    """Twice the log of the likelihood that columns (N, m, k) gain, each with a size above zero."""
    none = likelihood.beside()
    while columns.shape[2]:
        found = judged([Trial(None, "", columns)], likelihood, none)
        if found is None:
            break
        above = found.beyond.mix @ found.explained.values[-found.freedom :] > 0
        if above.all():
            return max(found.gain, 0.0)
        columns = columns[:, :, above]
    return 0.0


def _averages(what: Candidate) -> bool:
    effect = what.effect
    if effect is None or effect.kind != "sequence":
        return False
    held = dict(what.held)
    return bool(_times(what)) and all(held.get(n, 0.0) > 0 for n in _times(what))


def _times(what: Candidate) -> set[str]:
    profile = what.effect.profile if what.effect is not None else ()
    return {n for n, kind in profile if kind in AVERAGING}


def _looks_elsewhere(fit: Fit) -> bool:
    model = fit.model
    return model.along.integrates or any(a.kind in OVER_TIME for a in model.effects)


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
