"""What a slow error goes with: the size of the reference, the same on all axes, or an offset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.linear import Index
from casest.diagnose.evidence.score import Evidence, Trial, judged
from casest.diagnose.found import Course
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.reference import swell
from casest.diagnose.protocol.state import Ranking
from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.sensor import Sensor
from casest.diagnose.sensor.tried import offset
from casest.effects.course import bias_course, reference_wander

#: Half waves over a run that a course is made of; residuals for each that it costs, at least.
WAVES, RESIDUALS = (6, 12, 24, 48), 10


def courses(sensor: Sensor, fit: Fit, ranking: Ranking) -> tuple[Course, ...]:
    """The effect that a slow course of what is left looks like; both where that is open.

    With as many cosines as there is evidence for: six polynomials follow no field that sways ten
    times. Where a sample has one residual, its direction tells nothing: then the polynomials.
    """
    known = (e.trials[0].what for e in ranking.descriptions)
    slow = tuple(Course(what) for what in known if not what.column)
    if ranking.linear.residual.shape[1] < 2:
        return slow
    best: dict[str, Evidence] = {}
    every = {c.name: c for c in sensor.tried.found(fit)[0]}
    for course, probe in ((reference_wander, swell), (bias_course, offset)):
        what, slope = every.get(course.name), sensor.tried.slope(fit, probe)
        if what is None or slope is None:
            continue
        for evidence in _evidences(what, slope[1], sensor.runs, sensor.rows.index, ranking):
            if evidence.score > LEVELS.strong and (
                what.label not in best or evidence.score > best[what.label].score
            ):
                best[what.label] = evidence
    most = max((e.score for e in best.values()), default=0.0)
    near = [e for e in best.values() if e.score > most - LEVELS.clear]
    return tuple(Course(e.trials[0].what, _share(e, ranking)) for e in near) or slow


def _share(evidence: Evidence, ranking: Ranking) -> float:
    """Of the variance, by which it falls: without what so many unknowns take from any noise."""
    r = ranking.likelihood.residual
    taken = float(np.sum(evidence.explained.left**2)) / (1 - evidence.freedom / len(r))
    return max(0.0, 1 - taken / float(np.sum(r**2)))


def _evidences(
    what: Candidate, carrier: Array, runs: Sequence[Run], index: Sequence[Index], ranking: Ranking
) -> Iterator[Evidence]:
    for waves in WAVES:
        shapes = _shapes(runs, index, waves)
        count = shapes.shape[1] * carrier.shape[2]
        if count * RESIDUALS > ranking.linear.residual.size:
            return
        columns = carrier[:, :, :, None] * shapes[:, None, None, :]
        trial = Trial(what, what.label, columns.reshape(*carrier.shape[:2], -1), len(WAVES))
        found = judged([trial], ranking.likelihood, ranking.none, families=ranking.families)
        if found is not None:
            yield found


def _shapes(runs: Sequence[Run], index: Sequence[Index], waves: int) -> Array:
    """Cosines (N, waves · runs) of the rows that are looked at, each of one run."""
    found = np.zeros((sum(map(len, index)), len(runs), waves))
    first = 0
    for k, (run, rows) in enumerate(zip(runs, index, strict=True)):
        time = np.arange(len(run)) if run.time is None else np.asarray(run.time)
        share = (time[rows] - time[0]) / max(float(np.ptp(time)), 1e-300)
        own = slice(first, first + len(rows))
        found[own, k] = np.cos(np.pi * share[:, None] * np.arange(1, waves + 1))
        first += len(rows)
    return found.reshape(len(found), -1)
