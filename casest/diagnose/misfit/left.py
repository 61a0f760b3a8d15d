"""Is what is left noise? As large as an independent estimate of it says, and flat.

`calibrate` and `close` ask the same of a fit, and so agree. A colour that reaches over a few
samples is noise; a slow course is none, whatever it is: its share is said, and that its cause is
not known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.found import Course, Undecided
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.findings import (
    FAULTS,
    Finding,
    findings,
    in_few_rows,
    shared_by_neighbours,
)
from casest.diagnose.noise.noise_model import noise_model
from casest.effects.placing import prepared
from casest.estimate.estimate import Estimate
from casest.leastsquares.neighbours import Scatter
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import robust_scale

#: Longer records are not asked by `calibrate`: all residuals are looked at at once.
LONGEST = 200_000


def doubts(estimate: Estimate) -> list[Finding] | None:
    """What of a calibration's residual is no noise.

    None where nothing is asked: a refused estimate, or one of more than LONGEST samples.
    """
    runs = estimate.problem.runs
    if not estimate.certificate.trusted or sum(map(len, runs)) > LONGEST:
        return None
    problem = Problem(estimate.model, prepared(estimate.model, runs))
    with np.errstate(all="ignore"):
        return findings(problem, problem.point(estimate.values), estimate.correlated_over)


def refused_for(estimate: Estimate) -> str:
    """Why an estimate is refused; first the few rows that most of its residual is in: they may have
    led it astray (a table that stood still in two of thirty rests, a magnet nearby)."""
    problem, why = estimate.problem, list(estimate.certificate.reasons)
    with np.errstate(all="ignore"):
        point = problem.point(estimate.values)
        residuals = problem.residuals(point)
        if all(np.isfinite(r).all() for r in residuals):
            series = sum(map(len, problem.runs)) >= LEVELS.series
            where = _far_rows(problem, residuals) if series else _few_rows(problem, point)
            why = [*(f"{w}: look at these first" for w in where), *why]
    return "; ".join(why)


def _few_rows(problem: Problem, point: Point) -> list[str]:
    return [f.where.replace("of it", "of the residual", 1) for f in in_few_rows(problem, point)]


def _far_rows(problem: Problem, residuals: Sequence[Array]) -> list[str]:
    """Rows of a series far out, no more than faults are among readings, that hold most of it."""
    squares = np.concatenate([np.sum(r**2, axis=1) for r in residuals])
    far = squares > (LEVELS.beyond * robust_scale(residuals)) ** 2
    share = float(squares[far].sum() / max(squares.sum(), 1e-300))
    if not 0 < np.mean(far) <= FAULTS or not share > LEVELS.most:
        return []
    worst = int(np.argmax(squares))
    names = [f"row {k} of {run.name}" for run in problem.runs for k in run.rows]
    return [
        f"{100 * share:.0f} % of the residual is in {int(far.sum())} of {len(far)} rows, which are "
        f"far out, most of all {names[worst]}"
    ]


@dataclass(frozen=True)
class Misfit:
    """What is left beyond noise: share of the held-out variance, and where it lives.

    `noise` holds what is known of the noise itself; `described` names what a slow
    course in it looks like; `rows`: the few that most of it is in, in words, and `ends`: of what
    they are the outermost.
    """

    significant: bool
    fraction: float
    where: str
    noise: Mapping[str, Any]
    described: tuple[str, ...] = ()
    rows: str = ""
    ends: str = ""


def left_over(
    problem: Problem,
    point: Point,
    batches: Sequence[NDArray[np.int_]],
    held_out: Sequence[Array],
    correlated_over: float = 1.0,
    undecided: Undecided | None = None,
    described: Sequence[Course] = (),
    *,
    wanders: bool = False,
    shared: Scatter | None = None,
) -> Misfit:
    """The misfit of a closed model, with the noise beside it.

    `shared`: what rows with nearly the same inputs share, where the model does not explain all.
    """
    noise = noise_model(
        problem.runs,
        problem.residuals(point),
        batches,
        measured=problem.model.traced.measured,
        correlated_over=correlated_over,
        levels=predictions(problem, point),
    )
    found = findings(problem, point, correlated_over, wanders=wanders)
    found += [] if shared is None else shared_by_neighbours(shared)
    everything = np.concatenate([r.ravel() for r in held_out])
    everything = everything[np.isfinite(everything)]  # the rest nothing foretells
    if everything.size:
        everything = everything[np.abs(everything) <= LEVELS.beyond * robust_scale([everything])]
    variance = float(np.mean(everything**2)) if everything.size else np.nan
    # What has no share of its own: all that is more than the noise beside it.
    sigma = min((f.sigma for f in found if not f.share), default=np.sqrt(variance))
    fraction = max(0.0, 1 - sigma**2 / variance) if variance > 0 else 0.0
    fraction = max([fraction, *(f.share for f in found)])
    where = [f.where for f in found[:3]]
    if undecided is not None and not undecided.explains:
        if where:  # a likelihood that held-out data deny is no misfit by itself
            asked = " or ".join(undecided.names[:3])
            where.append(f"{asked} may be there besides, and would take none of it away")
    elif undecided is not None:
        fraction = max(fraction, undecided.share)
        several = " and other shapes" if len(undecided.names) == 1 else ""
        they = f"{' or '.join(undecided.names[:3])}{several} explain"
        most = undecided.share > (1 - LEVELS.alike) * fraction
        part = f"{100 * undecided.share:.2g} %"
        where = [f"which {they} alike" if most else f"of which {they} {part}, alike", *where]
    share = 0.0 if wanders else max((c.share for c in described), default=0.0)
    if share > LEVELS.share and not any(f.slow for f in found):
        # Slow is what it goes with, not what it looks like where the motion is quick.
        fraction = max(fraction, share)
        where.append(f"{100 * share:.0f} % of it is a slow course of unknown cause")
    said = described if where and not wanders else ()
    if said:
        looks = " or ".join(_looks_like(c.what) for c in said)
        where.append(f"its slow course is best described by {looks}")
    names = tuple(c.what.label for c in said)
    rows, ends = next(((f.rows, f.ends) for f in found if f.rows), ("", ""))
    fraction = min(float(fraction), 1.0)
    return Misfit(bool(where), fraction, "; ".join(where), noise.content, names, rows, ends)


def _looks_like(candidate: Candidate) -> str:
    """A description with the first sentence that it says of itself."""
    doc = getattr(candidate.effect, "doc", "").partition("\n\n")[0]
    words = " ".join(doc.split()).removesuffix(".")
    return f"{candidate.label} ({words[:1].lower()}{words[1:]})"


def predictions(problem: Problem, point: Point) -> list[Array] | None:
    """What the model predicts, (N, m) per run; None for an implicit or sequential one."""
    traced = problem.model.along
    predicted = traced.predicted
    if predicted is None or (problem.sequential and not traced.integrates):
        return None
    return [v[0][:, :, 0] for v in problem.evaluate(point, {"p": predicted})]
