"""What of a fit's residual is no noise: each test, and what it found in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.data.stillness import last_decimal
from casest.data.timing import blocks
from casest.declaration.effect import TAILS
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import usable_columns
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.few_rows import at_the_ends, few_rows
from casest.diagnose.misfit.noisy_inputs import beside_noise_of_inputs
from casest.diagnose.misfit.pure_error import pure_error
from casest.diagnose.misfit.reference import along_reference
from casest.diagnose.misfit.structure import (
    Structure,
    more_than_courses_do,
    more_than_its_colour_does,
    structures,
)
from casest.diagnose.misfit.variables import variables
from casest.diagnose.noise.noise_model import step_of
from casest.diagnose.noise.slow_course import MEMORY, slow_course
from casest.diagnose.noise.spectral_line import strongest_line
from casest.estimate.before import against_prior
from casest.estimate.correlation import TABLE, is_series
from casest.leastsquares.agreement import between_runs
from casest.leastsquares.neighbours import Scatter
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.stated import chi_square
from casest.leastsquares.sums import rounding
from casest.leastsquares.weights import scale_of_readings, weighted

#: Residual over the scatter from which on that is rounding: readings that only repeat.
REPEATED = 1e6
#: Residuals of so many rounding errors of one are exact.
ROUNDED = 10.0
#: Variance of neighbours' differences from the line between them, in that of the noise, where noise
#: remembers as exp(−k/MEMORY).
_KIN = float(np.exp(-1 / MEMORY))
OF_COLOUR = (1.5 - 2 * _KIN + 0.5 * _KIN**2) / 1.5


#: Means within a window by which it is told how strong a slow course is there.
WITHIN = 8
#: Share of faults among readings, at most: 1 to 10 % are usual (F. Hampel et al., 1986, 1.2c).
FAULTS = 0.1


@dataclass(frozen=True)
class Finding:
    """Evidence of a misfit: where, in words; its share of the squares, or else σ of the noise
    beside it; `slow`: it is a course of unknown cause; `rows`: the few that it is in, in words, and
    `ends`: of what they are the outermost.
    """

    where: str
    p_value: float
    share: float = 0.0
    sigma: float = np.inf
    slow: bool = False
    rows: str = ""
    ends: str = ""


def findings(
    problem: Problem, point: Point, correlated_over: float = 1.0, *, wanders: bool = False
) -> list[Finding]:
    """All that is significant: between repeats, in time, over what is recorded, between runs.

    Of noise that was declared to wander no slow course is asked, and none from repeat to repeat.
    """
    residuals = problem.residuals(point)
    if scale_of_readings(residuals) <= ROUNDED * rounding(problem, point):
        return []  # nothing but the computer's own last digits is left
    problem = weighted(problem, problem.values(point))
    freedom = max(problem.residual_count - problem.unknowns, 1)
    sigma = scale_of_readings(residuals) * float(np.sqrt(problem.residual_count / freedom))
    clipped = _clipped(problem, residuals, sigma)
    found = _before(problem, point) + _stated(problem, point)
    found += in_few_rows(problem, point) + _far_out(problem, sigma)
    found += _repeats(problem, point, clipped, wanders=wanders)
    course = None if wanders else _slow(problem, point, clipped, sigma)
    slow, over = course or (None, 0)
    follows, by_chance = _follows(
        problem, point, clipped, over, correlated_over, in_time=not (slow or wanders)
    )
    found += follows
    if slow and by_chance and by_chance[0].share > LEVELS.most * slow.share:
        why = f": {by_chance[0].name} goes with it, as slow courses may by chance"
        slow = replace(slow, where=slow.where + why)
    found += [slow] if slow else []
    line = strongest_line(problem.runs, clipped)
    if line is not None and line.p_value < LEVELS.misfit:
        where = f"a line at {line.frequency:.4g} {line.unit}"
        found.append(Finding(where, line.p_value, line.share))
    if not any(f.slow for f in found):
        found += _runs(problem, point, correlated_over)
    return found


def _clipped(problem: Problem, residuals: Sequence[Array], sigma: float) -> list[Array]:
    """Residuals, those far out counted as less, as the fit does: none that a step away may be."""
    least = LEVELS.half * step_of(problem.runs, problem.model.traced.measured)
    limit, kept = LEVELS.clip * max(sigma, least), problem.weights
    found = [np.clip(r, -limit, limit) for r in residuals]
    return found if kept is None else [r * w for r, w in zip(found, kept, strict=True)]


def _repeats(
    problem: Problem, point: Point, clipped: Sequence[Array], *, wanders: bool
) -> list[Finding]:
    tested = pure_error(problem, point, clipped, problem.unknowns, wanders=wanders)
    if tested is None or tested.p_value >= LEVELS.misfit:
        return []
    size = float(np.sqrt(np.mean(np.concatenate(clipped) ** 2)))
    if size < LEVELS.half * step_of(problem.runs, problem.model.traced.measured):
        return []  # what is held between two steps is read as one of them
    ratio = float(np.sqrt(tested.F))
    where = f"between {tested.between}: the residual is {ratio:.1f} times what the scatter "
    where += "within them explains"
    if ratio > REPEATED:
        where = f"between {tested.between}: within them readings only repeat, and explain nothing"
    return [Finding(where, tested.p_value, sigma=tested.sigma)]


def _far_out(problem: Problem, sigma: float) -> list[Finding]:
    """More rows that count for nothing, far out as they are, than faults are among readings."""
    if problem.weights is None or not any(a.effect.seen_in == TAILS for a in problem.model.effects):
        return []
    share = float(np.mean(np.concatenate([(w <= 0).any(axis=1) for w in problem.weights])))
    if share <= FAULTS:
        return []
    where = f"{100 * share:.0f} % of the rows are far out: too many to be faults"
    return [Finding(where, 0.0, sigma=sigma)]


def in_few_rows(problem: Problem, point: Point) -> list[Finding]:
    """Rows of a table that the others speak against, or that are at the ends of something, and hold
    most of what is left."""
    runs, tails = problem.runs, any(a.effect.seen_in == TAILS for a in problem.model.effects)
    if sum(map(len, runs)) >= LEVELS.series or tails or problem.sequential:
        return []
    residual = np.concatenate(problem.residuals(point))
    J = np.nan_to_num(problem.jacobian(point)).reshape(*residual.shape, -1)
    columns = usable_columns(problem.model, runs)
    read = variables(problem, point, columns)
    if problem.model.implicit:  # a reading that is off is beyond the others in what it makes
        read = [v for v in read if v.clock or v.name in columns]
    found = few_rows(residual, J, _rounding(problem), read)
    if found is None:
        return []
    listed = " and ".join(_named(runs, found.rows))
    ends = at_the_ends(found.rows, read)
    why = f"at {ends}" if ends else "which the others speak against"
    where = f"{100 * found.share:.0f} % of it is in {listed}, {why}"
    return [Finding(where, found.p_value, found.share, rows=listed, ends=ends)]


def _named(runs: Sequence[Run], rows: NDArray[np.int_]) -> list[str]:
    """Rows, counted through all runs, as they are called in their files."""
    said, first = [], 0
    for run in runs:
        own = [str(run.rows[k - first]) for k in rows if first <= k < first + len(run)]
        if own:
            what = "rest interval" if run.spread else "row"
            *most, last = own
            several = f"{what}s {', '.join(most)} and" if most else what
            said.append(f"{several} {last} of {run.name}")
        first += len(run)
    return said


def _rounding(problem: Problem) -> float:
    """Standard deviation of what rounding to the last decimal leaves of a reading; 0 unknown."""
    measured = problem.model.traced.measured
    if not measured or problem.noise_scale is not None:
        return 0.0
    readings = np.concatenate([run.signals[measured].ravel() for run in problem.runs])
    return last_decimal(readings[np.isfinite(readings)]) / float(np.sqrt(12))


def _before(problem: Problem, point: Point) -> list[Finding]:
    """Data that do not agree with what was known before."""
    found, scale = against_prior(problem, point), problem.noise_scale
    if found is None or scale is None or found.agrees:
        return []
    return [Finding(found.words, found.chi_square.larger, sigma=scale)]


def _stated(problem: Problem, point: Point) -> list[Finding]:
    """A residual that is larger than the noise that was stated, by χ²."""
    found, scale = chi_square(problem, point, problem.unknowns), problem.noise_scale
    if found is None or scale is None or found.larger >= LEVELS.misfit:
        return []
    where = (
        f"chi-square is {found.value:.4g} with {found.degrees_of_freedom} degrees of freedom: the "
        f"residual is {found.times:.2g} times the stated noise"
    )
    return [Finding(where, found.larger, sigma=scale)]


def _slow(
    problem: Problem, point: Point, clipped: Sequence[Array], sigma: float
) -> tuple[Finding, int] | None:
    """A slow course of unknown cause, of an axis or along the reference, and over how many samples.

    What rounding to a step leaves of a slow input is known.
    """
    along = along_reference(problem, point, clipped)
    if along:
        clipped = [np.hstack(both) for both in zip(clipped, along, strict=True)]
    found = slow_course(problem.runs, clipped)
    if found is None or found.p_value >= LEVELS.misfit or found.share < LEVELS.share:
        return None
    if sigma < LEVELS.rounded * step_of(problem.runs, problem.model.traced.measured):
        return None
    it = (
        "what of it goes with the size of the input"
        if found.axis == len(problem.model.axes)
        else "it"
    )
    where = (
        f"{100 * found.share:.0f} % of {it} is a slow course over about {found.samples} samples"
        f"{_when(problem, clipped, found.samples)}, of unknown cause"
    )
    return Finding(where, found.p_value, found.share, slow=True), found.samples


def _when(problem: Problem, clipped: Sequence[Array], samples: int) -> str:
    """Where it is strongest: a stretch of time, across no gap."""
    from scipy.ndimage import uniform_filter1d

    best: tuple[float, str] = (0.0, "")
    for run, r in zip(problem.runs, clipped, strict=True):
        if run.time is None or len(r) < 3 * samples:
            continue
        first, last = _windows(blocks(run.time, run.block, np.arange(len(r))), samples)
        # Not by its mean: where it turns round it has none.
        course = uniform_filter1d(r, max(samples // WITHIN, 1), axis=0, mode="nearest")
        squares = np.concatenate([[0.0], np.cumsum(np.sum(course**2, axis=1))])
        taken = (squares[last] - squares[first]) / (last - first)
        k = int(np.argmax(taken))
        if taken[k] > best[0]:
            a, b = run.time[first[k]], run.time[min(last[k], len(r)) - 1]
            best = (float(taken[k]), f", strongest from t = {a:.4g} to {b:.4g} s")
    return best[1]


def _windows(stretch: NDArray[np.int_], samples: int) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """First rows and ends of windows of so many samples, half over each other; shorter stretches
    are one each."""
    found = list[tuple[int, int]]()
    starts = np.flatnonzero(np.diff(stretch, prepend=stretch[0] - 1)).tolist()
    for a, b in pairwise([*starts, len(stretch)]):
        edges = range(a, max(b - samples, a) + 1, max(samples // 2, 1))
        found += [(edge, min(edge + samples, b)) for edge in edges]
    first, last = np.array(found).T
    return first, last


def _follows(
    problem: Problem,
    point: Point,
    clipped: Sequence[Array],
    over: int,
    correlated_over: float,
    *,
    in_time: bool,
) -> tuple[list[Finding], list[Structure]]:
    """What it follows: a column, a quantity; the time only where no slow course says so.

    Apart, the most first, what a slow course (`over` so many samples, else 0) may follow by chance.
    """
    if any(run.spread for run in problem.runs):
        return [], []
    columns = usable_columns(problem.model, problem.runs)
    read = [v for v in variables(problem, point, columns) if in_time or not v.clock]
    table = sum(map(len, problem.runs)) < TABLE and not any(map(is_series, problem.runs))
    every = structures(clipped, read, unknowns=_taken(problem, point) if table else None)
    # Of few rows no chance is small: it is that of naming anything in poses.
    chance = LEVELS.chance if table else LEVELS.misfit
    found = [s for s in every if s.p_value < chance and s.share > LEVELS.share]
    one = {v.name: v for v in read}
    by_chance = [
        s for s in found if over and not more_than_courses_do(s, clipped, one[s.name], over)
    ]
    by_chance.sort(key=lambda s: -s.share)
    found = [s for s in found if s not in by_chance]
    if correlated_over > 1 and not over:
        found = [
            s for s in found if more_than_its_colour_does(clipped, one[s.name], correlated_over)
        ]
    if found and not table:
        beside = [
            s
            for f in found
            for s in structures(
                beside_noise_of_inputs(
                    problem, point, clipped, one[f.name], lambda p: variables(p, point, columns)
                ),
                [one[f.name]],
                among=read,
            )
        ]
        found = [s for s in beside if s.p_value < chance and s.share > LEVELS.share]
    if not found:
        return [], by_chance
    # In the order of the record lies whatever was changed with it: what has a name comes first.
    clocks = {v.name for v in read if v.clock}
    most = (1 - LEVELS.alike) * max(s.share for s in found)
    best = max(found, key=lambda s: (s.share > most and s.name not in clocks, s.share))
    where = f"{100 * best.share:.0f} % of it follows {best.name}"
    return [Finding(where, best.p_value, best.share)], by_chance


def _taken(problem: Problem, point: Point) -> Array:
    """Orthonormal columns (N·m, p) of what the unknowns of a small problem take."""
    J = np.nan_to_num(problem.jacobian(point))
    U, s, _ = np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), 1e-300), full_matrices=False)
    return np.asarray(U[:, s > 1e-9 * s.max(initial=0.0)])


def _runs(problem: Problem, point: Point, correlated_over: float) -> list[Finding]:
    scatter = between_runs(problem, point, correlated_over)
    if scatter is None or scatter.p_value >= LEVELS.misfit:
        return []
    where = f"between runs: {scatter.worst} is {scatter.away:.0f} standard deviations off"
    return [Finding(where, scatter.p_value, scatter.share)]


def shared_by_neighbours(found: Scatter) -> list[Finding]:
    """A course that rows with nearly the same inputs share, beyond what neighbours in time share of
    noise with a colour, and the model does not have."""
    from scipy.special import fdtrc

    within = found.left / OF_COLOUR
    chance = float(fdtrc(*found.freedom, found.residual / max(within, 1e-300)))
    if chance >= LEVELS.misfit:
        return []
    where = (
        f"the residual is {np.sqrt(found.residual / max(found.left, 1e-300)):.3g} times what it "
        "differs by between rows with nearly the same inputs"
    )
    share = 1 - found.left / found.residual
    return [Finding(where, chance, share)]
