"""Score tests: what each candidate would gain, without a refit.

The model with all candidates in it, at their null values, has the Jacobian [J G]. What the
declared parameters can imitate is taken out, G⊥ = (1 − P)G, and the score s = G⊥ᵀr is compared with
its covariance under noise alone (Rao 1948). The gain in the sum of squares that a refit would bring
is sᵀ(G⊥ᵀG⊥)⁻¹s to first order. The covariance is estimated from sums over batches of samples,
so that noise may be coloured and differ from place to place (Liang & Zeger 1986). What the
candidate itself explains is taken out of those sums first, with its leverage given back (Bell &
McCaffrey 2002): an effect that is strong in a few batches must not pass for unequal noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.declaration.tracing import flat
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.levels import CLIPPED, PIECE, SURVIVES
from casest.engine import Columns, Replay
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import weighted

#: A direction of a candidate counts where this share of its best one is left: two delays that a
#: phase imitates together are one, and what only rounding or noise tells apart is not told apart.
DISTINCT = 1e-3
#: The slopes of an implicit residual contain the residual itself: what survives must be larger
#: than the noise by this factor.
BEYOND_NOISE = 5.0
#: Batches of a record: more are put together.
MOST_BATCHES = 100
#: Inflation from which on noise counts as coloured, and what a batch says of it if it is not.
COLOURED, WHITE = 1.3, 20
#: Freedom of a noise that repeats show.
KNOWN = 10_000
#: Effective batches whose inflation counts as much as what is usual.
STEADY = 10.0
#: Batches that must speak for an effect: what is seen in one only may be an accident.
LEAST_BATCHES = 1.8
#: Share of a batch's noise that its leverage leaves, at least.
LEAST_LEFT = 0.05


@dataclass(frozen=True)
class Score:
    """What one candidate would gain.

    gain: lowered sum of squares over σ² (χ² with `freedom` degrees of freedom under white noise);
    inflation: variance of the score over that under white noise; p_value: of F, corrected for
    inflation and for the trials of the profile, not for the number of candidates. `step` (q,)
    estimates its unknowns, `survives` (q,) the share of each that the declared ones leave,
    `bias` (n, q) the shift of the declared unknowns per unit of it, `information` (q, q) G⊥ᵀG⊥/σ².
    `batches` (batches, freedom): what noise contributes to the whitened score; `effective` how many
    batches there would be, were each worth as much.
    """

    candidate: Candidate
    gain: float
    freedom: int
    inflation: float
    p_value: float
    step: Array
    survives: Array
    bias: Array
    information: Array
    batches: Array
    effective: float = 1.0
    rest: int = 1


@dataclass(frozen=True)
class Wide:
    """The declared problem and, sample by sample, the columns G of all candidates.

    `places[c][r]` are the columns of candidate c, and `columns[c]` what it has in `slopes`.
    """

    problem: Problem
    point: Point
    slopes: Replay
    signals: tuple[Signal, ...]
    columns: tuple[NDArray[np.int_], ...]
    places: tuple[tuple[NDArray[np.int_], ...], ...]
    width: int


def widened(
    model: Model,
    runs: Sequence[Run],
    values: Mapping[str, Array],
    found: Sequence[Candidate],
) -> Wide:
    """The slopes of the residual in every candidate's unknowns, at their null values.

    Each candidate is put into the model alone; all share the symbols of the model as it is, so
    that one evaluation serves them all.
    """
    problem = weighted(Problem(model, tuple(runs)), values)
    base, signals = model.traced, list(model.signals)
    symbols = {s.name: base.symbols[s.name] for s in signals}
    slopes, columns, places, count, width = [], [], [], 0, problem.unknowns
    for candidate in found:
        slope, scopes, more = slope_of(candidate, model, symbols)
        signals += more
        slopes.append(slope)
        own = np.arange(count, count + slope.size2())
        columns.append(own)
        count += slope.size2()
        by_run = []
        shared = width + np.arange(len(own))
        width += len(own)
        for r in range(len(runs)):
            place = shared.copy()
            if r and any(scopes):
                mine = np.flatnonzero(scopes)
                place[mine] = width + np.arange(len(mine))
                width += len(mine)
            by_run.append(place)
        places.append(tuple(by_run))
    sample = ca.vertcat(*[flat(symbols[s.name]) for s in signals])
    inputs = [ca.vertcat(base.coordinates, base.references), sample]
    together = ca.horzcat(*slopes) if slopes else ca.SX(len(model.axes), 0)
    function = ca.Function("slopes", inputs, [together], ["parameters", "sample"], ["G"])
    return Wide(
        problem,
        problem.point(values),
        Replay(function),
        tuple(signals),
        tuple(columns),
        tuple(places),
        width,
    )


def slope_of(
    candidate: Candidate, model: Model, symbols: dict[str, Any]
) -> tuple[Any, list[bool], list[Signal]]:
    """∂r/∂(its unknowns) at null in the model's symbols; which are per run; signals it adds."""
    extended = candidate.added_to(model)
    traced, base = extended.traced, model.traced
    own = {p.name for p in candidate.parameters(extended)}
    more = [s for s in extended.signals if s.name not in symbols]
    for s in more:
        symbols[s.name] = ca.SX.sym(s.name, s.size)
    place, mine, scopes, old, new, k = 0, [], [], [], [], 0
    for p in extended.parameters:
        width = p.shape.coordinates
        here = traced.coordinates[place : place + width]
        if p.name in own:
            mine.append(here)
            scopes += [p.scope == "run"] * width
            old.append(here)
            new.append(ca.DM(p.start_value()))
        else:
            old.append(here)
            new.append(base.coordinates[k : k + width])
            k += width
        place += width
    slope = ca.jacobian(traced.expression, ca.vertcat(*mine))
    old += [traced.references, *(flat(traced.symbols[s.name]) for s in extended.signals)]
    new += [base.references, *(flat(symbols[s.name]) for s in extended.signals)]
    return ca.substitute(slope, ca.vertcat(*old), ca.vertcat(*new)), scopes, more


@dataclass(frozen=True)
class ScoreSums:
    """Of every batch [J G]ᵀ[J G] (batches, n, n) and [J G]ᵀr (batches, n), scaled by `scale`.

    `squares`: rᵀr of all. Far residuals are clipped, except in `unclipped`, its rᵀr coming second.
    """

    matrices: Array
    gradients: Array
    unclipped: Array
    scale: Array
    squares: tuple[float, float]

    @cached_property
    def whole(self) -> Array:
        """[J G]ᵀ[J G] of all batches, (n, n)."""
        return np.asarray(self.matrices.sum(axis=0))


def scores(
    wide: Wide,
    found: Sequence[Candidate],
    sigma: float,
    batches: Sequence[NDArray[np.int_]],
    known: float | None = None,
) -> list[Score]:
    """The score of every candidate. `batches` holds the first sample of each batch of each run.

    `sigma` is the residual's, for what is far out; `known` that of the noise where repeats show it.
    """
    sums = _sums(wide, sigma, [first[:: _together(batches)] for first in batches])
    A, d = sums.whole, np.arange(wide.problem.unknowns)
    inverse = np.asarray(np.linalg.pinv(A[np.ix_(d, d)], rcond=1e-10, hermitian=True), float)
    test = ScoreTest(sums, d, inverse, sigma, known, _least_survival(wide.problem, sigma))
    return [
        scored(candidate, np.unique(np.concatenate(own)), test, wide.problem.residual_count)
        for candidate, own in zip(found, wide.places, strict=True)
    ]


@dataclass(frozen=True)
class ScoreTest:
    """What the scores of all candidates share: sums, the declared unknowns, the noise."""

    sums: ScoreSums
    declared: NDArray[np.int_]
    inverse: Array
    residual: float
    known: float | None
    least: float

    @property
    def sigma(self) -> float:
        """Of the noise: what repeats show, where the residual is larger."""
        return min(self.residual, self.known) if self.known else self.residual


def _least_survival(problem: Problem, sigma: float) -> float:
    """Share of a candidate that must survive the projection."""
    if not problem.model.implicit:
        return SURVIVES
    names = [s.name for s in problem.model.signals if s.name != "t" and s.kind == "plain"]
    sizes = [
        float(np.sqrt(np.mean(np.concatenate([run.signals[n] for run in problem.runs]) ** 2)))
        for n in names
        if n not in problem.runs[0].columns
    ]
    return max(SURVIVES, BEYOND_NOISE * sigma / max(min(sizes, default=np.inf), 1e-300))


def _together(batches: Sequence[NDArray[np.int_]]) -> int:
    """How many neighbouring batches are put together."""
    return -(-sum(map(len, batches)) // MOST_BATCHES)


def _sums(wide: Wide, sigma: float, batches: Sequence[NDArray[np.int_]]) -> ScoreSums:
    """Sums over every batch, far residuals clipped."""
    problem, n = wide.problem, wide.width
    offsets = np.cumsum([0, *map(len, batches)])
    matrices, gradients = np.zeros((offsets[-1], n, n)), np.zeros((2, offsets[-1], n))
    squares, far = 0.0, 0.0
    for r, span, index, residual, J in _rows(wide):
        clipped = np.clip(residual, -CLIPPED * sigma, CLIPPED * sigma)
        if problem.weights is not None:
            root = np.sqrt(problem.weights[r][span])
            clipped, J = clipped * root, J * root[:, :, None]
        squares += float(np.sum(clipped**2))
        far += float(np.sum(residual**2))
        samples = np.arange(span.start, span.stop)
        number = np.searchsorted(batches[r], samples, side="right") - 1
        first = np.flatnonzero(np.diff(number, prepend=-1))
        for start, stop in zip(first, [*first[1:], len(samples)], strict=True):
            part = J[start:stop].reshape(-1, J.shape[2])
            b = offsets[r] + number[start]
            matrices[b][np.ix_(index, index)] += part.T @ part
            gradients[0, b][index] += part.T @ clipped[start:stop].ravel()
            gradients[1, b][index] += part.T @ residual[start:stop].ravel()
    scale = np.sqrt(np.maximum(np.einsum("bii->i", matrices), 1e-300))
    clipped, unclipped = gradients / scale
    return ScoreSums(matrices / np.outer(scale, scale), clipped, unclipped, scale, (squares, far))


def _rows(wide: Wide) -> Iterator[tuple[int, slice, NDArray[np.int_], Array, Array]]:
    """Run, span, columns, residuals (N, m) and [J G] (N, m, columns), piece by piece."""
    problem = wide.problem
    for block in problem.blocks(wide.point):
        run = problem.runs[block.run]
        samples = Columns([run.signals[s.name] for s in wide.signals])
        index = np.concatenate([block.x, *(place[block.run] for place in wide.places)])
        parameters = problem.parameters(wide.point, block.run)
        for start in range(block.span.start, block.span.stop, PIECE):
            span = slice(start, min(start + PIECE, block.span.stop))
            local = slice(span.start - block.span.start, span.stop - block.span.start)
            (G,) = wide.slopes(parameters, samples[span])
            J = np.concatenate([block.jacobian[local], G], axis=2)
            yield block.run, span, index, block.residual[local], np.where(np.isfinite(J), J, 0.0)


def scored(candidate: Candidate, own: NDArray[np.int_], test: ScoreTest, count: int) -> Score:
    """The score of a candidate whose columns are `own`, of `count` residuals."""
    sums, d, inverse, sigma = test.sums, test.declared, test.inverse, test.sigma
    A, scale = sums.whole, sums.scale
    absorbed = inverse @ A[np.ix_(d, own)]
    left = A[np.ix_(own, own)] - A[np.ix_(own, d)] @ absorbed
    survives = np.clip(np.diag(left), 0, None)
    size = np.sqrt(np.where(survives > 0, survives, 1.0))
    # What the declared parameters imitate is no part of the test.
    alive = np.flatnonzero(survives > test.least**2)
    values, inner = np.linalg.eigh((left / np.outer(size, size))[np.ix_(alive, alive)])
    vectors, kept = np.zeros((len(own), len(values))), values > DISTINCT * values.max(initial=0.0)
    vectors[alive] = inner
    root = vectors[:, kept] / np.sqrt(values[kept]) / size[:, None]
    # What of each of the two makes up the whitened score: (unknowns, freedom).
    both = np.concatenate([d, own])
    maker = np.vstack([-absorbed @ root, root])
    far_out = _is_far_out(candidate)
    gradients = sums.unclipped if far_out else sums.gradients
    whitened = gradients[:, both] @ maker / sigma
    total, freedom = whitened.sum(axis=0), int(kept.sum())
    step = -(root @ total) * sigma / scale[own] if freedom else np.zeros(len(own))
    gain = float(total @ total)
    noise, effective = _of_noise(whitened, sums.matrices, both, maker)
    rest = max(count - len(d) - freedom, 1)
    inflation, p = 1.0, 1.0
    if freedom:
        least = 1.0
        if test.known is None:
            least = _left_over(gain * sigma**2 / sums.squares[far_out], freedom / rest)
        else:
            rest = KNOWN
        inflation = float(max(np.sum(noise**2) / freedom, least))
        p = _p_value(gain, freedom, inflation, effective, rest)
    bias = (absorbed * scale[own]) / scale[d][:, None]
    information = left * np.outer(scale[own], scale[own]) / sigma**2
    return Score(
        candidate,
        gain,
        freedom,
        inflation,
        min(1.0, p * candidate.trials),
        step,
        np.sqrt(survives),
        bias,
        information,
        noise,
        effective,
        rest,
    )


def steadied(found: Sequence[Score]) -> list[Score]:
    """Scores of few batches with an inflation that others share: three batches say little of it.

    The other candidates' lower quartile is what the noise's colour makes of most of them; what is
    above may be an effect that they do not explain.
    """
    known = [s.inflation for s in found if s.effective >= STEADY and s.candidate.trials == 1]
    usual = float(np.quantile(known, 0.25)) if known else 1.0
    return [_pulled(score, usual) for score in found]


def _pulled(score: Score, usual: float) -> Score:
    weight = score.effective / (score.effective + STEADY)
    inflation = weight * score.inflation + (1 - weight) * usual
    if not score.freedom or inflation <= score.inflation:
        return score
    p = _p_value(score.gain, score.freedom, inflation, score.effective, score.rest)
    return replace(score, inflation=inflation, p_value=min(1.0, p * score.candidate.trials))


def _is_far_out(candidate: Candidate) -> bool:
    """Is it by its nature in few samples, and far out in them? What is cut off at a level is."""
    return candidate.effect is not None and "level" in dict(candidate.effect.profile).values()


def _of_noise(
    whitened: Array, matrices: Array, both: NDArray[np.int_], maker: Array
) -> tuple[Array, float]:
    """Contributions of the batches without the effect itself, and the effective number of batches.

    Each batch has a share Mᵦ of the information (ΣMᵦ = 1); wᵦ − Mᵦw has lost this share of its
    noise as well, and (1 − Mᵦ)^(−½) gives it back.
    """
    if not whitened.size:
        return whitened, 1.0
    shares = maker.T @ (matrices[:, both[:, None], both] @ maker)
    values, vectors = np.linalg.eigh(0.5 * (shares + shares.transpose(0, 2, 1)))
    without = whitened - shares @ whitened.sum(axis=0)
    turned = np.einsum("bji,bj->bi", vectors, without)
    given_back = turned / np.sqrt(np.clip(1 - values, LEAST_LEFT, None))
    noise = np.einsum("bij,bj->bi", vectors, given_back)
    by_share = whitened.shape[1] / max(float(np.sum(values**2)), 1e-12)
    return noise, min(by_share, _as_many(noise))


def _as_many(noise: Array) -> float:
    """Batches of equal noise that would tell as much of its variance: some may be far noisier."""
    squares = np.sum(noise**2, axis=1)
    usual = 1 + 2 / noise.shape[1]  # |e|⁴ over (|e|²)² of normal noise
    return float(usual * np.sum(squares) ** 2 / max(float(np.sum(squares**2)), 1e-300))


def _left_over(explained: float, price: float) -> float:
    """Variance of the noise over what it was taken for while the effect was part of it.

    Of few residuals an effect is a good part: without this it would hide itself.
    """
    return float(np.clip((1 - explained) * (1 + price), 0.05, 1.0))


def _p_value(gain: float, freedom: int, inflation: float, effective: float, rest: int) -> float:
    if effective < LEAST_BATCHES:
        return 1.0
    second = max(min(rest, second_freedom(freedom, inflation, effective)), 1)
    return float(fdtrc(freedom, second, gain / inflation / freedom))


def second_freedom(freedom: int, inflation: float, effective: float) -> float:
    """How well the inflation is known, as degrees of freedom.

    Of coloured noise it is an estimate from the batches, and from what is usual; of white noise it
    is one, and the estimate is only there to be sure.
    """
    if inflation <= COLOURED:
        return effective * max(freedom, WHITE)
    return (effective + 0.5 * STEADY) * freedom
