"""What a slow error goes with: the size of the reference, the same on all axes, or an offset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import Evidence, Trial, judged
from casest.diagnose.found import Course
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.reference import swell
from casest.diagnose.noise.slow_course import FAST, slow_course
from casest.diagnose.protocol.state import Ranking
from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.rows import Rows
from casest.diagnose.sensor.sensor import Sensor
from casest.diagnose.sensor.tried import offset
from casest.effects.course import bias_course, reference_wander

#: Half waves over a run that a course is made of; residuals for each that it costs, at least.
WAVES, RESIDUALS = (6, 12, 24, 48), 10


def courses(sensor: Sensor, fit: Fit, ranking: Ranking) -> tuple[Course, ...]:
    """The effect that a slow course of what is left looks like; both where that is open.

    With as many cosines as there is evidence for: six polynomials follow no field that sways ten
    times. Where a sample has one residual, any slow course of it may be noise to a likelihood.
    """
    known = (e.trials[0].what for e in ranking.descriptions)
    slow = tuple(Course(what) for what in known if not what.column)
    carriers = _carriers(sensor, fit)
    best: dict[str, Evidence] = {}
    for what, carrier in carriers:
        for evidence in _evidences(what, carrier, sensor.rows, ranking):
            if evidence.score > LEVELS.strong and (
                what.label not in best or evidence.score > best[what.label].score
            ):
                best[what.label] = evidence
    most = max((e.score for e in best.values()), default=0.0)
    near = [e for e in best.values() if e.score > most - LEVELS.clear]
    found = tuple(Course(e.trials[0].what, _share(e, ranking)) for e in near)
    if not found and ranking.linear.residual.shape[1] < 2:
        found = _of_a_length(sensor, fit, ranking.linear, carriers)
    return found or slow


def _carriers(sensor: Sensor, fit: Fit) -> list[tuple[Candidate, Array]]:
    """Each effect with the slopes (N, m, k) that its course goes with."""
    every, found = {c.name: c for c in sensor.tried.found(fit)[0]}, []
    for course, probe in ((reference_wander, swell), (bias_course, offset)):
        what, slope = every.get(course.name), sensor.tried.slope(fit, probe)
        if what is not None and slope is not None:
            found.append((what, slope[1]))
    return found


def _of_a_length(
    sensor: Sensor, fit: Fit, linear: Linear, carriers: Sequence[tuple[Candidate, Array]]
) -> tuple[Course, ...]:
    """What a slow course goes with that is plain in the residual (N, 1) itself.

    A reference of another size is slow there, and an offset goes with the direction: where that
    turns slowly, many cosines of one look like few of the other. By Schwarz's criterion, and of
    FAST neighbours one counts: what differs within them is not slow.
    """
    plain = slow_course(sensor.runs, fit.residuals)
    if plain is None or plain.p_value >= LEVELS.misfit or plain.share < LEVELS.share:
        return ()
    cost: dict[str, float] = {}
    for what, carrier in carriers:
        every = _columns(carrier, sensor.rows, linear.residual.size)
        cost[what.label] = min((_cost(linear, columns) for columns in every), default=np.inf)
    near = min(cost.values(), default=np.inf) + FAST * LEVELS.clear
    return tuple(Course(what) for what, _ in carriers if cost[what.label] < near)


def _cost(linear: Linear, columns: Array) -> float:
    """Schwarz's criterion of columns (N, m, k) beside the unknowns."""
    count = linear.residual.size
    flat, r = columns.reshape(count, -1), linear.residual.ravel()
    flat = flat - linear.basis @ (linear.basis.T @ flat)
    left = r - flat @ np.linalg.lstsq(flat, r)[0]
    return count * float(np.log(left @ left)) + flat.shape[1] * float(np.log(count))


def _share(evidence: Evidence, ranking: Ranking) -> float:
    """Of the variance, by which it falls: without what so many unknowns take from any noise."""
    r = ranking.likelihood.residual
    taken = float(np.sum(evidence.explained.left**2)) / (1 - evidence.freedom / len(r))
    return max(0.0, 1 - taken / float(np.sum(r**2)))


def _evidences(what: Candidate, carrier: Array, rows: Rows, ranking: Ranking) -> Iterator[Evidence]:
    for columns in _columns(carrier, rows, ranking.linear.residual.size):
        trial = Trial(what, what.label, columns, len(WAVES))
        found = judged([trial], ranking.likelihood, ranking.none, families=ranking.families)
        if found is not None:
            yield found


def _columns(carrier: Array, rows: Rows, residuals: int) -> Iterator[Array]:
    """A carrier (N, m, k) times cosines, more and more of them: (N, m, k · waves · runs)."""
    for waves in WAVES:
        shapes = rows.cosines(waves)
        if shapes.shape[1] * carrier.shape[2] * RESIDUALS > residuals:
            return
        columns = carrier[:, :, :, None] * shapes[:, None, None, :]
        yield columns.reshape(*carrier.shape[:2], -1)
