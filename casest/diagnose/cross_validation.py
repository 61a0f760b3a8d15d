"""Error on data that the fit never saw: every block predicted by a fit to the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.data.splits import interleaved_blocks
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.errors import DataError
from casest.estimate.estimate import Estimate
from casest.estimate.reasons import PRACTICALLY_NULL
from casest.leastsquares.identifiability import identify
from casest.leastsquares.kinds import whitened
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import weighted
from casest.solve.trust_region import trust_region

#: Share of the squares of its unknowns, each alone, by which a direction moves a prediction at all.
OPEN = 1e-10
#: Standard deviations of the noise from which on what is foretold says nothing.
NOTHING = 1e3
#: Iterations of a fit that begins at the fit to everything, and gain (in σ²) that ends it.
ITERATIONS, ENOUGH = 30, 1e-3


@dataclass(frozen=True)
class Folds:
    """The fold of every sample of every run, and the first sample of each batch."""

    of: tuple[NDArray[np.int_], ...]
    batches: tuple[NDArray[np.int_], ...]
    count: int


def determined(before: Estimate, runs: Sequence[Run], seed: int = 0) -> Folds:
    """Folds of which the rest determines the model: the usual ones, of poses else one for each.

    Poses that alone determine something are never held out then, if they are the fewer. Raises
    DataError where most are such, or nothing can be held out.
    """
    folds = folded(runs, before.correlated_over, seed)
    open_ = _undetermined(before, runs, folds)
    if open_ and sum(map(len, runs)) < LEVELS.series:
        each = _one_each(runs)
        alone = list(_undetermined(before, runs, each))
        of = tuple(np.where(np.isin(fold, alone), -1, fold) for fold in each.of)
        if np.mean(np.concatenate(of) < 0) < 0.5:
            return Folds(of, each.batches, each.count)
    for words in open_.values():
        raise DataError(words)
    return folds


def _one_each(runs: Sequence[Run]) -> Folds:
    """A fold for every pose, or every row where there are few."""
    of = []
    for run in runs:
        whole = np.cumsum(np.r_[False, run.block[1:] != run.block[:-1]], dtype=np.int_)
        of.append(whole if whole[-1] >= 2 * LEVELS.refits else np.arange(len(run)))
    batches = [np.flatnonzero(_changes(run, f)) for run, f in zip(runs, of, strict=True)]
    return Folds(tuple(of), tuple(batches), max(int(f[-1]) + 1 for f in of))


def folded(runs: Sequence[Run], correlated_over: float = 1.0, seed: int = 0) -> Folds:
    """Folds of interleaved stretches, poses or bursts; batches are those stretches.

    Stretches are at least ten correlation times long. Raises DataError where there is nothing left
    to hold out.
    """
    of, batches = [], []
    for run in runs:
        stretches = LEVELS.pieces
        if correlated_over > 1:
            most = len(run) / (10 * correlated_over)
            stretches = int(np.clip(most, 2 * LEVELS.refits, LEVELS.pieces))
        of.append(interleaved_blocks(run, stretches, LEVELS.refits, seed))
        change = np.flatnonzero(_changes(run, of[-1]))
        batches.append(change)
    return Folds(tuple(of), tuple(batches), LEVELS.refits)


def _changes(run: Run, fold: NDArray[np.int_]) -> NDArray[np.bool_]:
    """Where a new batch begins: another fold, or another block."""
    changed = np.ones(len(run), dtype=bool)
    changed[1:] = (fold[1:] != fold[:-1]) | (run.block[1:] != run.block[:-1])
    if (run.count > 1).any():
        changed[:] = True
    return changed


def cross_fitted(
    model: Model, runs: Sequence[Run], values: Mapping[str, Array], folds: Folds
) -> tuple[Array, ...]:
    """Residuals (N, m) of each run, each from a fit that did not see its block.

    `values` are those of the fit to everything: where each fit begins. Effects on the noise count
    through the weights of that fit. NaN where a fit to the others leaves open what a block hangs
    on.
    """
    whole = Problem(model, tuple(runs))
    found = tuple(np.full((len(run), len(model.axes)), np.nan) for run in runs)
    for k in range(folds.count):
        seen = tuple(run.take(fold != k) for run, fold in zip(runs, folds.of, strict=True))
        if any(len(run) == 0 for run in seen):
            raise DataError("a run is too short to hold any of it out; record a longer one")
        problem = weighted(Problem(model, seen), values)
        fit = trust_region(
            problem,
            problem.point(values),
            max_iterations=ITERATIONS,
            tolerance=ENOUGH / max(problem.residual_count, 1),
        )
        point = whole.point(problem.values(fit.point))
        hidden = Problem(
            model, tuple(run.take(f == k) for run, f in zip(runs, folds.of, strict=True))
        )
        if _left_open(problem, fit.point, hidden, point):
            continue
        for r, residual in enumerate(whitened(hidden, point).told_residuals(point)):
            found[r][folds.of[r] == k] = residual
    return found


def _left_open(rest: Problem, fitted: Point, hidden: Problem, point: Point) -> bool:
    """Does what is held out hang on anything that the rest does not determine?

    A fit leaves that as it was at its beginning, which has seen what is held out.
    """
    null = identify(rest, fitted).null
    own = hidden.normal(point).matrix
    moved = np.einsum("ik,ij,jk->k", null, own, null)
    return bool(np.any(moved > OPEN * np.einsum("ik,ii->k", null**2, own)))


def rms(residuals: Sequence[Array]) -> float:
    """Root mean square of all residuals that there are; NaN stands for what nothing foretells."""
    everything = np.concatenate([r.ravel() for r in residuals])
    there = everything[np.isfinite(everything)]
    return float(np.sqrt(np.mean(there**2))) if there.size else float("nan")


def _undetermined(before: Estimate, runs: Sequence[Run], folds: Folds) -> dict[int, str]:
    """Folds of which the rest of a record does not determine what they are held out for, and why.

    What a fit to the rest leaves uncertain of the part, in variances of the noise, is the trace
    of JᵀJ of the part times the inverse of that of the rest.
    """
    found = {}
    for k in range(folds.count):
        parts = [
            tuple(run.take((fold == k) == held) for run, fold in zip(runs, folds.of, strict=True))
            for held in (False, True)
        ]
        if any(len(run) == 0 for run in parts[0]) or not sum(map(len, parts[1])):
            continue  # the fits themselves say so
        if words := _why(before, *parts):
            found[k] = (
                f"without one part in {folds.count} of the record {words}; record more "
                "orientations, or each of them twice"
            )
    return found


def _why(before: Estimate, rest: tuple[Run, ...], part: tuple[Run, ...]) -> str:
    seen, held = (
        whitened(one, one.point(before.values))
        for one in (Problem(before.model, p) for p in (rest, part))
    )
    if seen.residual_count < seen.unknowns:
        return "there are too few equations"
    if words := undetermined(seen, before.values):
        return words
    own = held.normal(held.point(before.values)).matrix
    whole = seen.normal(seen.point(before.values)).matrix
    spread = float(np.trace(np.linalg.solve(whole, own)))
    if spread < LEVELS.uncertain * held.residual_count:
        return ""
    deviations = np.sqrt(spread / held.residual_count)
    if not deviations < NOTHING:
        return "nothing is foretold of the part"
    return f"the part is foretold to {deviations:.2g} standard deviations of the noise"


def undetermined(problem: Problem, values: Mapping[str, Array]) -> str:
    """What the data do not determine, in words: cheaper than to ask for a certificate."""
    point = problem.point(values)
    found = identify(problem, point, problem.factor(point)[0])
    if found.rank < found.unknowns:
        return f"not determined: {found.unobservable[0]}" if found.unobservable else "rank"
    if found.singular_values[-1] < PRACTICALLY_NULL * found.singular_values[0]:
        return f"practically not determined: {found.weakest}"
    return ""
