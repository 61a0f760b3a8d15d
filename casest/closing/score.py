"""Score tests: what each candidate would gain, without a refit.

The model with all candidates in it, at their null values, has the Jacobian [J G]. What the
declared parameters can imitate is taken out, G⊥ = (1 − P)G, and the score s = G⊥ᵀr is compared with
its covariance under noise alone (Rao 1948). The gain in the sum of squares that a refit would bring
is sᵀ(G⊥ᵀG⊥)⁻¹s to first order. The covariance is estimated from sums over batches of samples,
so that noise may be coloured and differ from place to place (Liang & Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.closing.candidates import Candidate
from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.declaring.symbols import Signal
from casest.engine import Columns, Replay
from casest.modelling.model import Model
from casest.modelling.tracing import flat
from casest.stack import Point, Problem

#: Share of a candidate's own length that must survive the projection: below, it is invisible.
SURVIVES = 1e-6
#: Samples whose slopes are held at once.
PIECE = 8192
#: A residual counts as at most this many robust standard deviations: a few bad samples ask for
#: nothing.
CLIPPED = 3.5


@dataclass(frozen=True)
class Score:
    """What one candidate would gain.

    gain: lowered sum of squares over σ² (χ² with `freedom` degrees of freedom under white noise);
    inflation: variance of the score over that under white noise; p_value: of F, corrected for
    inflation and for the trials of the profile, not for the number of candidates. `step` (q,)
    estimates its unknowns, `survives` (q,) the share of each that the declared ones leave,
    `bias` (n, q) the shift of the declared unknowns per unit of it, `information` (q, q) G⊥ᵀG⊥/σ².
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
    problem = Problem(model, tuple(runs))
    base, signals = model.traced, list(model.signals)
    symbols = {s.name: base.symbols[s.name] for s in signals}
    slopes, columns, places, count, width = [], [], [], 0, problem.unknowns
    for candidate in found:
        slope, scopes, more = _slope(candidate, model, symbols)
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


def _slope(
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


def scores(
    wide: Wide,
    found: Sequence[Candidate],
    sigma: float,
    batches: Sequence[NDArray[np.int_]],
) -> list[Score]:
    """The score of every candidate. `batches` holds the first sample of each batch of each run."""
    normal, sums = _sums(wide, sigma, batches)
    d = np.arange(wide.problem.unknowns)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    A = normal / np.outer(scale, scale)
    inverse = np.linalg.pinv(A[np.ix_(d, d)], rcond=1e-10, hermitian=True)
    count = wide.problem.residual_count
    return [
        _score(candidate, np.unique(np.concatenate(own)), A, inverse, scale, sums, d, sigma, count)
        for candidate, own in zip(found, wide.places, strict=True)
    ]


def _sums(wide: Wide, sigma: float, batches: Sequence[NDArray[np.int_]]) -> tuple[Array, Array]:
    """[J G]ᵀ[J G] (n, n), and [J G]ᵀr of every batch (batches, n), far residuals clipped."""
    problem, n = wide.problem, wide.width
    matrix = np.zeros((n, n))
    sums = [np.zeros((len(first), n)) for first in batches]
    for r, span, index, residual, J in _rows(wide):
        flattened = J.reshape(-1, J.shape[2])
        matrix[np.ix_(index, index)] += flattened.T @ flattened
        clipped = np.clip(residual, -CLIPPED * sigma, CLIPPED * sigma)
        if problem.weights is not None:
            clipped = clipped * problem.weights[r][span]
        gradient = np.einsum("nm,nmk->nk", clipped, J)
        own = np.arange(span.start, span.stop)
        number = np.searchsorted(batches[r], own, side="right") - 1
        first = np.flatnonzero(np.diff(number, prepend=-1))
        sums[r][np.ix_(number[first], index)] += np.add.reduceat(gradient, first)
    return matrix, np.vstack(sums)


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


def _score(
    candidate: Candidate,
    own: NDArray[np.int_],
    A: Array,
    inverse: Array,
    scale: Array,
    sums: Array,
    d: NDArray[np.int_],
    sigma: float,
    count: int,
) -> Score:
    absorbed = inverse @ A[np.ix_(d, own)]
    left = A[np.ix_(own, own)] - A[np.ix_(own, d)] @ absorbed
    survives = np.clip(np.diag(left), 0, None)
    each = (sums / scale)[:, own] - (sums / scale)[:, d] @ absorbed
    size = np.sqrt(np.where(survives > 0, survives, 1.0))
    # What the declared parameters imitate is no part of the test.
    alive = np.flatnonzero(survives > SURVIVES**2)
    values, inner = np.linalg.eigh((left / np.outer(size, size))[np.ix_(alive, alive)])
    vectors, kept = np.zeros((len(own), len(values))), values > 1e-8
    vectors[alive] = inner
    root = vectors[:, kept] / np.sqrt(values[kept])
    whitened = (each / size) @ root / sigma
    total, freedom = whitened.sum(axis=0), int(kept.sum())
    step = -(root @ total) * sigma / size / scale[own] if freedom else np.zeros(len(own))
    gain = float(total @ total)
    inflation = _inflation(whitened)
    p = _p_value(gain, freedom, inflation, len(sums), count - len(d)) if freedom else 1.0
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
        whitened,
    )


def _inflation(whitened: Array) -> float:
    """Variance of the score over that under white noise: one number, its directions averaged."""
    if not whitened.size:
        return 1.0
    count, freedom = whitened.shape
    centred = whitened - whitened.mean(axis=0)
    return float(max(np.sum(centred**2) / freedom * count / max(count - 1, 1), 1.0))


def _p_value(gain: float, freedom: int, inflation: float, batches: int, left: int) -> float:
    from scipy.special import fdtrc

    # What the residual's size is known by: its own freedom, or the number of batches.
    second = max(min(left - freedom, 20 * batches), 1)
    return float(fdtrc(freedom, second, gain / inflation / freedom))
