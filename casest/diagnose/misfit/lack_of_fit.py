"""Is anything left? Noise as it is, and what of the residual is no noise.

Together the tests call a misfit where there is none in at most one of a hundred records, whatever
the colour, the tails and the inequality of the noise (tests/test_adequacy.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import usable_columns
from casest.diagnose.levels import BEYOND_WALK, CLIPPED, STRETCHES
from casest.diagnose.misfit.dependence import (
    ORDER,
    Dependence,
    Variable,
    dependences,
    shapes,
    slow_shapes,
    variables,
)
from casest.diagnose.misfit.pure_error import PureError, pure_error
from casest.diagnose.noise.noise_model import (
    MIDDLE,
    NoiseModel,
    lag_one,
    likelihood_of_walk,
    likelihood_of_white,
    noise_model,
    power,
    slice_means,
)
from casest.diagnose.noise.spectral_line import strongest_line
from casest.diagnose.noise.tails import even_scale
from casest.leastsquares.agreement import between_runs
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import robust_scale, weighted

#: Chance of each kind of test to call a misfit where there is none: together half of one percent.
REPEATS, SHAPES, LINES, RUNS = 0.001, 0.0025, 0.001, 0.001
#: Batches for each shape of a variable, at least; residuals left over for each shape of an axis.
PER_SHAPE = 5


@dataclass(frozen=True)
class Misfit:
    """What is left beyond noise: share of the held-out variance, and where it lives.

    `noise` holds what is known of the noise itself.
    """

    significant: bool
    fraction: float
    where: str
    noise: Mapping[str, Any]


@dataclass(frozen=True)
class Finding:
    """Evidence of a misfit: where, in words, and σ of the noise beside it."""

    where: str
    p_value: float
    sigma: float


@dataclass(frozen=True)
class State:
    """A fitted model with its residuals (N, m) per run, and σ of one residual."""

    problem: Problem
    point: Point
    residuals: tuple[Array, ...]
    sigma: float
    batches: tuple[NDArray[np.int_], ...]

    @property
    def clipped(self) -> list[Array]:
        """Residuals, those far out counted as less, as the fit does."""
        limit = CLIPPED * self.sigma
        found = [np.clip(r, -limit, limit) for r in self.residuals]
        kept = self.problem.weights
        return found if kept is None else [r * w for r, w in zip(found, kept, strict=True)]


def state_of(problem: Problem, point: Point, batches: Sequence[NDArray[np.int_]]) -> State:
    """What the tests look at."""
    residuals = problem.residuals(point)
    problem = weighted(problem, problem.values(point))
    count = problem.residual_count
    freedom = max(count - problem.unknowns, 1)
    sigma = robust_scale(residuals) * float(np.sqrt(count / freedom))
    return State(problem, point, residuals, sigma, tuple(batches))


def left_over(state: State, held_out: Sequence[Array], correlated_over: float = 1.0) -> Misfit:
    """The misfit of a fitted model, with the noise beside it."""
    problem = state.problem
    noise = noise_model(
        problem.runs,
        state.residuals,
        state.batches,
        measured=problem.model.traced.measured,
        correlated_over=correlated_over,
        levels=predictions(problem, state.point),
    )
    found = findings(state, noise, correlated_over)
    limit = 6 * robust_scale(held_out)
    everything = np.concatenate([r.ravel() for r in held_out])
    everything = everything[np.abs(everything) <= limit]
    variance = float(np.mean(everything**2)) if everything.size else np.nan
    sigma = min((f.sigma for f in found), default=_noise_alone(state))
    fraction = max(0.0, 1 - sigma**2 / variance) if variance > 0 else 0.0
    where = "; ".join(f.where for f in found[:3])
    return Misfit(bool(found), float(fraction), where, noise.content)


def _white(state: State) -> float:
    """σ of the residual without far ones, freedom of the fit counted."""
    problem, limit = state.problem, 6 * state.sigma
    r = np.concatenate([r.ravel() for r in state.residuals])
    r = r[np.abs(r) <= limit]
    return float(np.sqrt(np.sum(r**2) / max(len(r) - problem.unknowns, 1)))


def predictions(problem: Problem, point: Point) -> list[Array] | None:
    """What the model predicts, (N, m) per run; None for an implicit or sequential one."""
    predicted = problem.model.traced.predicted
    if predicted is None or problem.sequential:
        return None
    return [v[0][:, :, 0] for v in problem.evaluate(point, {"p": predicted})]


# -- the tests -------------------------------------------------------------------------------------


def findings(
    state: State, noise: NoiseModel, correlated_over: float = 1.0, *, wander: bool = False
) -> list[Finding]:
    """All that is significant, repeats first; with `wander` also what a random walk explains."""
    found = _repeats(state)
    found += _shapes(state, wander)
    even = even_scale(state.clipped, state.batches, noise.unequal > 1)
    line = strongest_line(state.problem.runs, even)
    if line is not None and line.p_value < LINES:
        where = f"a line at {line.frequency:.4g} {line.unit}"
        found.append(Finding(where, line.p_value, _white(state)))
    if not noise.wander:
        found += _runs(state, correlated_over)
    return found


def _noise_alone(state: State) -> float:
    """σ of the noise where nothing is left beyond it: of repeats or of the residual."""
    tested = _tested_by_repeats(state)
    return max(_white(state), 0.0 if tested is None else tested.sigma)


def _tested_by_repeats(state: State) -> PureError | None:
    return pure_error(state.problem, state.point, state.clipped, state.problem.unknowns)


def _repeats(state: State) -> list[Finding]:
    tested = _tested_by_repeats(state)
    if tested is None or tested.p_value >= REPEATS:
        return []
    where = (
        f"between {tested.between}: the residual is {np.sqrt(tested.F):.1f} times what the scatter "
        "within them explains"
    )
    return [Finding(where, tested.p_value, tested.sigma)]


def _runs(state: State, correlated_over: float) -> list[Finding]:
    scatter = between_runs(state.problem, state.point, correlated_over)
    if scatter is None or scatter.p_value >= RUNS:
        return []
    where = f"between runs: {scatter.worst} is {scatter.away:.0f} standard deviations off"
    return [Finding(where, scatter.p_value, _white(state))]


def _shapes(state: State, wander: bool = False) -> list[Finding]:
    """Dependence on columns, quantities, time and products; a wander is none unless it counts."""
    tests, known = _dependences(state, wander=False)
    if any(t.together < SHAPES for t in tests) and _wanders(state, known, tests):
        jump, slow = _jump(state), tests[0]
        if jump is not None:
            return [jump]
        tests, _ = _dependences(state, wander=True)
        if wander and not any(t.together < SHAPES for t in tests):
            return [Finding(f"wanders, or {slow.words}", slow.together, _white(state))]
    significant = [t for t in tests if t.together < SHAPES]
    if not significant:
        return []
    best = significant[0]
    freedom = max(state.problem.residual_count - state.problem.unknowns, 1)
    share = max(best.gain - best.freedom * best.inflation, 0.0) / freedom
    sigma = _white(state) * float(np.sqrt(max(1 - share, 0.0)))
    return [Finding(best.words, best.together, sigma)]


def independent(state: State, lag1: float | None = None) -> tuple[NDArray[np.int_], ...]:
    """First samples of batches whose noise is independent: blocks, or stretches of a series.

    Long by the correlation of neighbours only (`lag1`, that of the residual unless told): what
    reaches further is wander, or the misfit that is looked for.
    """
    if lag1 is None:
        lag1, _ = lag_one(state.problem.runs, state.clipped)
    rho = min(max(lag1 or 0.0, 0.0), 0.98)
    shortest = 5 * (1 + rho) / (1 - rho)
    found = []
    for run, first in zip(state.problem.runs, state.batches, strict=True):
        count = int(min(STRETCHES, len(run) // shortest))
        several = len(np.unique(run.block)) > 1 or bool(run.spread)
        even = np.arange(count) * len(run) // max(count, 1)
        found.append(first if several or count <= len(first) else even)
    return tuple(found)


def _order(state: State) -> int:
    """Shapes of one variable that the record can bear."""
    batches = sum(map(len, independent(state)))
    problem = state.problem
    each = (problem.residual_count - problem.unknowns) // (3 * len(problem.model.axes))
    return int(min(ORDER, batches // PER_SHAPE, each))


def _dependences(state: State, wander: bool) -> tuple[list[Dependence], list[Variable]]:
    problem, order = state.problem, _order(state)
    found = variables(problem, state.point, usable_columns(problem.model, problem.runs))
    if wander:  # time itself is what a wander has taken
        found = [v for v in found if v.name not in ("time", "place in the record")]
    if order < 1 or not found:
        return [], []
    beside = slow_shapes(problem.runs, MIDDLE) if wander else None
    tests = dependences(
        problem, state.point, state.sigma, independent(state), shapes(found, order), beside
    )
    return tests, found


def _jump(state: State) -> Finding | None:
    """One jump, where it explains the slow part better than a random walk does."""
    found = []
    for run, r in zip(state.problem.runs, state.clipped, strict=True):
        means = slice_means(run, r)
        if means is not None:
            found.append((*_best_jump(means), run, len(r) / len(means)))
    if not found:
        return None
    better, at, run, length = max(found, key=lambda f: f[0])
    if better <= BEYOND_WALK:
        return None
    row = min(int(at * length), len(run) - 1)
    where = f"t = {run.time[row]:.4g} s" if run.time is not None else f"sample {row}"
    # The chance that noise looks so much more like a jump is at most exp(−this).
    return Finding(f"jumps near {where} of {run.name}", float(np.exp(-better)), _white(state))


def _best_jump(means: Array) -> tuple[float, int]:
    """Log-likelihood of the best jump over that of a random walk, and the slice it begins at."""
    n, axes = means.shape
    k = np.arange(2, n - 1)
    total = np.cumsum(means - means.mean(axis=0), axis=0)[k - 1]
    at = int(k[np.argmax(np.sum(total**2, axis=1) / (k * (n - k)))])
    after = means.copy()
    for part in (slice(None, at), slice(at, None)):
        after[part] -= means[part].mean(axis=0)
    level = np.maximum(after.var(axis=0), 1e-300)
    gain = float(np.sum((means.var(axis=0) - after.var(axis=0)) / level)) * n
    cost = 0.5 * axes * (1 + np.log1p(gain / axes)) + np.log(n)
    jump = likelihood_of_white(power(after)) - cost
    return float(jump - likelihood_of_walk(power(means)) + axes), at


def _wanders(state: State, found: Sequence[Variable], tests: Sequence[Dependence]) -> bool:
    """Does a random walk explain the slow part at least as well as the best shapes do?

    Log-likelihoods of what is seen at each slow rate, less what the fitted values cost: half the
    logarithm of their squares over the noise, which a walk pays for the same sizes.
    """
    q, gain = tests[0].freedom, tests[0].gain / tests[0].inflation
    cost = 0.5 * q * (1 + float(np.log1p(gain / q)))
    best = [v for v in found if v.name in tests[0].name.split("·")]
    columns = shapes(best, _order(state)).columns
    walk = shaped = 0.0
    for run, r, c in zip(state.problem.runs, state.clipped, columns, strict=True):
        c = np.column_stack([np.ones(len(c)), c])
        smooth = r - c @ np.linalg.lstsq(c, r, rcond=None)[0]
        before, after = slice_means(run, r), slice_means(run, smooth)
        if before is not None and after is not None:
            walk += likelihood_of_walk(power(before)) - r.shape[1]
            shaped += likelihood_of_white(power(after))
    return walk > shaped - cost - BEYOND_WALK
