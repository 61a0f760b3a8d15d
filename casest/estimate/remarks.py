"""What an engineer should know beside the numbers: sentences about data, noise and fit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from casest.data.renewing import passage_again
from casest.data.stillness import last_decimal
from casest.declaration.shapes import Array
from casest.leastsquares.agreement import between_runs
from casest.leastsquares.problem import LOOKED, Point, Problem
from casest.leastsquares.stated import UNLIKELY, ChiSquare
from casest.leastsquares.sums import repeat_noise, rounding, some_residuals
from casest.leastsquares.weights import scale_of_readings

#: Second-order shift, in standard deviations, from which on it is added to them.
NOTABLE_BIAS = 0.3
#: Gaussian noise passes six standard deviations once in 10⁹ samples.
FAR_OUT = 6.0
#: Of rows that are there twice: digits by which readings must scatter, so that none of it is
#: chance; rows of a run at most.
DIGITS, LONGEST = 10, 20_000
#: Probability under agreement below which runs are said to disagree.
DISAGREE = 1e-3


def notes(
    problem: Problem, point: Point, dof: int, correlated: float, bias: float
) -> Iterator[str]:
    """All that there is to say. `bias` is the second-order shift in standard deviations."""
    if problem.model.remarker is not None:
        yield from _of_the_model(problem, point)
    if dof == 0 and (known_by := _known_by(problem, point)):
        yield (
            "as many unknowns as equations: nothing checks the model; the standard deviations rest "
            f"on {known_by} alone"
        )
    if correlated > 1:
        count = sum(len(run) for run in problem.runs)
        yield (
            f"residuals are correlated over {correlated:.3g} samples: the {count} samples count as "
            f"{count / correlated:.0f}, and standard deviations allow for that"
        )
    if bias > NOTABLE_BIAS:
        yield (
            f"the noise of single readings shifts the values by up to {bias:.1f} standard "
            "deviations (second order), which the printed ones contain: average readings at rest "
            "(--at-rest), or filter them"
        )
    yield from _too_fast(problem)
    yield from _copied(problem, point)
    yield from _runs_that_disagree(problem, point, correlated)
    yield from _furthest_out(problem, point)


def _of_the_model(problem: Problem, point: Point) -> Iterator[str]:
    if max(map(len, problem.runs)) > LOOKED:
        yield f"{problem.model.name} was not asked what it says of more than {LOOKED:.0e} samples"
        return
    assert problem.model.remarker is not None
    yield from problem.model.remarker(problem.model, problem.runs, problem.values(point))


def _known_by(problem: Problem, point: Point) -> str:
    """What shows the noise where no residual does; empty where nothing does."""
    if problem.noise_scale is not None:
        return "the stated noise"
    within = repeat_noise(problem, point) is not None
    return "the scatter within the rest intervals" if within else ""


def of_stated_noise(found: ChiSquare | None) -> Iterator[str]:
    """Whether the residual is as large as the noise that was stated."""
    if found is None:
        return
    said = f"chi-square is {found.value:.4g} with {found.degrees_of_freedom} degrees of freedom"
    larger = f"the residual is {found.times:.2g} times the stated noise"
    if found.larger < UNLIKELY:
        yield (
            f"{said} (p = {found.larger:.1g}): {larger}, which was stated too small, or the model "
            "lacks something; standard deviations are by the residual"
        )
    elif found.smaller < UNLIKELY:
        yield (
            f"{said} (p = {found.smaller:.1g} of so little): {larger}, which was stated too large, "
            "or readings are not independent; standard deviations are by the stated noise all the "
            "same"
        )
    else:
        yield f"{said} (p = {found.larger:.2g}): {larger}, as chance may have it"


def _too_fast(problem: Problem) -> Iterator[str]:
    """Turns between rests that a sensor could not follow."""
    for r, run in enumerate(problem.runs):
        lost = problem.lost(r)
        if len(lost):
            listed = ", ".join(str(int(k)) for k in lost[:5]) + ", …" * (len(lost) > 5)
            yield (
                f"{run.name}: {len(lost)} of {len(run) - 1} turns are left out, since a reading "
                f"stays at its full scale on the way (to rest interval {listed}): turn more slowly"
            )


def _copied(problem: Problem, point: Point) -> Iterator[str]:
    """Rows that are there twice: readings with a noise of many digits do not repeat."""
    noise = scale_of_readings(some_residuals(problem, point))
    for run in problem.runs:
        read = [s.name for s in problem.model.signals if s.name != "t" and s.name in run.signals]
        if run.spread or len(run) > LONGEST or not read:
            continue
        rows = np.hstack([run.signals[name] for name in read])
        measured = problem.model.traced.measured
        digit = last_decimal(run.signals[measured]) if measured else last_decimal(rows)
        if measured and noise < DIGITS * digit:
            continue
        before, length = passage_again(rows)
        if length:
            a, b = (f"{run.rows[k]} to {run.rows[k + length - 1]}" for k in (before[1], before[0]))
            yield (
                f"rows {a} of {run.name} are rows {b} again, to the last digit: a copy tells "
                "nothing, and makes standard deviations too small; leave it out"
            )


def _runs_that_disagree(problem: Problem, point: Point, correlated: float) -> Iterator[str]:
    """Shared parameters that the runs do not agree on."""
    found = between_runs(problem, point, correlated)
    if found is not None and found.p_value < DISAGREE:
        yield (
            f"the runs disagree on what they share (scatter {found.F:.3g} times that of the noise, "
            f"p = {found.p_value:.1g}): {found.worst} is {found.away:.0f} standard deviations off; "
            "say --per-run for what differs, or find what changed"
        )


def _furthest_out(problem: Problem, point: Point) -> Iterator[str]:
    """The sample that lies far outside what the others show."""
    scale = scale_of_readings(some_residuals(problem, point))
    size, k, row = max(_largest(block) for block in problem.residual_blocks(point))
    exact = 10 * rounding(problem, point)  # noise-free data have no outliers
    if problem.residual_count > 2 * problem.unknowns and size > FAR_OUT * max(scale, exact):
        run = problem.runs[k]
        what = "rest interval" if run.spread else "row"
        counted = "" if run.spread else " (rows count from 0)"
        away = size / max(scale, exact)
        yield (
            f"{what} {int(run.rows[row])} of {run.name}{counted} is off by {away:.3g} robust "
            "standard deviations of the residual: look at it first"
        )


def _largest(block: tuple[int, slice, Array]) -> tuple[float, int, int]:
    """Size, run and row of the largest residual of a block."""
    run, span, residual = block
    worst = int(np.argmax(np.abs(residual)))
    return float(np.abs(residual).flat[worst]), run, span.start + worst // residual.shape[1]
