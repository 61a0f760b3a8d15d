"""Outside the catalogue: a formula of few terms in what is recorded, chosen with stability.

Every term of the library (see `terms`), on every axis of the output, gets a score in the part
orthogonal to the declared Jacobian, as the catalogue does. Terms are taken one by one, the best
first, each significant among all of the library; and they must be chosen again from most
half-samples of the batches (Meinshausen & Bühlmann 2010), so that no lucky stretch decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from casest.closing.candidates import Candidate, _placed, usable_columns
from casest.closing.crossfit import Folds
from casest.closing.score import LEAST_LEFT, Wide, _slope, _Sums, _sums, _together, scores, widened
from casest.closing.terms import (
    Shape,
    Term,
    Variable,
    formula_effect,
    formula_text,
    library,
    source,
)
from casest.data.run import Run
from casest.declaring.physics import SX
from casest.declaring.shapes import Array, each
from casest.declaring.symbols import Signal, param
from casest.engine import Replay
from casest.errors import CasestError
from casest.modelling.effect import effect
from casest.modelling.model import Model
from casest.modelling.tracing import flat
from casest.noise import weighted
from casest.stack import Point, Problem

if TYPE_CHECKING:
    from casest.closing.loop import Fitted, _Loop

__all__ = ["formula_candidate", "source", "try_formula"]

#: Chance, under a model that lacks nothing, that any term of the library is called significant.
FALSE_ALARM = 0.005
#: Terms of a formula at most.
TERMS = 4
#: Half-samples of the batches, and the share of them that must choose a term again.
HALVES, STABLE = 40, 0.7
#: p-value, uncorrected, of a term that a half-sample chooses.
AGAIN = 0.05
#: Share of a term's squared length that the declared parameters must leave.
LEFT = 1e-4
#: Variables that correlate so nearly perfectly are one.
COPY = 1e-4


@effect(on="output")
def _probe(y: SX, *, k: SX = param(each, "[y]")) -> SX:
    """A shift of each axis: the slope of every term is its value times this one's."""
    return y + k


def formula_candidate(
    model: Model,
    runs: Sequence[Run],
    values: Mapping[str, Array],
    folds: Folds,
    sigma: float,
    batches: Sequence[NDArray[np.int_]],
) -> Candidate | None:
    """The formula that the residual asks for, null at k = 0; None if it asks for none.

    `runs` are prepared, `sigma` the noise of one residual, `batches` the first samples of the
    batches of each run. The candidate's trials are the terms that it was chosen from.
    """
    try:
        probe = Candidate(_placed(_probe, model))
        probe.added_to(model)
    except CasestError:
        return None  # nothing that a term could be added to
    assert probe.effect is not None
    problem = weighted(Problem(model, tuple(runs)), values)
    point, on = problem.point(values), probe.effect.on
    shapes = library(_variables(problem, point, on))
    if not shapes:
        return None
    wide, terms = _wide(problem, point, probe, shapes)
    sums = _sums(wide, sigma, [first[:: _together(batches)] for first in batches])
    search = _Search(sums, problem.unknowns, sigma, problem.residual_count, terms)
    chosen = _stable(search, search.select(FALSE_ALARM / len(terms), TERMS))
    if not chosen:
        return None
    quantity = model.quantities[on]
    made = formula_effect(
        [terms[k] for k in chosen], quantity.declared.numel(), on, _unit(quantity.unit, runs)
    )
    return Candidate(made, trials=len(terms))


def try_formula(loop: _Loop, current: Fitted) -> Fitted | None:
    """The model with a formula, if the residual asks for one and held-out data confirm it."""
    if any(a.effect.name == "formula" for a in current.model.effects):
        return None
    model, runs, folds = current.model, loop.runs, loop.folds
    candidate = formula_candidate(
        model, runs, current.values, folds, current.noise, folds.batches
    )
    if candidate is None:
        return None
    loop.original[candidate.label] = candidate
    wide = widened(model, runs, current.values, [candidate])
    (score,) = scores(wide, [candidate], current.noise, folds.batches)
    fitted = loop._with(current, score)
    accepted = None if fitted is None else loop._accepted(current, score, fitted)
    if accepted is None:
        return None
    better, candidate, gained = accepted
    better, candidate = _with_sizes(better, candidate)
    loop._keep(better, candidate, gained, score, [])
    return better


def _with_sizes(fitted: Fitted, candidate: Candidate) -> tuple[Fitted, Candidate]:
    """The formula with the fitted numbers in place of k1, k2, …"""
    assert candidate.effect is not None
    attached = fitted.model.effects[-1]
    text = candidate.effect.formula
    for p in attached.parameters:
        name, unit = p.name.rpartition(".")[2], p.unit
        size = f"{float(fitted.values[p.name]):.3g}" + (f" {unit}" if unit else "")
        text = text.replace(f"+= {name}·", f"+= {size}·")
    written = replace(candidate.effect, formula=text)
    effects = (*fitted.model.effects[:-1], replace(attached, effect=written))
    candidate = replace(candidate, effect=written, traced=None)
    return replace(fitted, model=replace(fitted.model, effects=effects)), candidate


# -- what terms may read -----------------------------------------------------------------------


def _variables(problem: Problem, point: Point, on: str) -> list[Variable]:
    """Columns, time and components of quantities that an effect on `on` may read; no copies."""
    model, runs = problem.model, problem.runs
    seen: list[tuple[Variable, Array]] = []
    for name in usable_columns(model, runs):
        _add(seen, name, None, runs[0].column_units.get(name) or "", _column(runs, name))
    if all("t" in run.signals for run in runs):
        _add(seen, "t", None, "s", _column(runs, "t"))
    readable = _readable(model, on)
    found = problem.evaluate(point, {n: model.quantities[n].value for n in readable})
    for k, name in enumerate(readable):
        x = np.concatenate([values[k][:, :, 0] for values in found])
        unit = _unit(model.quantities[name].unit, runs)
        for i in range(x.shape[1]):
            _add(seen, name, i if x.shape[1] > 1 else None, unit, x[:, i])
    return [variable for variable, _ in seen]


def _readable(model: Model, on: str) -> list[str]:
    """Columns of numbers among the quantities declared no later than `on`, and that itself."""
    names = list(model.quantities)
    taken = {s.name for s in model.signals}
    return [
        n
        for n in names[: names.index(on) + 1]
        if model.quantities[n].declared.size2() == 1 and n not in taken
    ]


def _column(runs: Sequence[Run], name: str) -> Array:
    return np.concatenate([run.signals[name][:, 0] for run in runs])


def _add(
    seen: list[tuple[Variable, Array]], name: str, index: int | None, unit: str, x: Array
) -> None:
    """Unless it is constant, not finite, or a copy of another."""
    width = float(np.ptp(x)) if np.all(np.isfinite(x)) else 0.0
    if not width > 1e-9 * float(np.abs(x).max(initial=1e-300)):
        return
    if any(abs(float(np.corrcoef(x, other)[0, 1])) > 1 - COPY for _, other in seen):
        if unit != "rad":  # an angle that grows with time still has its sine
            return
    centre, half = _scale(float(x.min()), float(x.max()))
    angle = unit == "rad"
    variable = Variable(name, index, unit, centre, half, angle, angle and width > 2.2 * np.pi)
    seen.append((variable, x))


def _scale(low: float, high: float) -> tuple[float, float]:
    """Middle and half width, in few digits; the middle of what is about 0 is 0."""
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    if abs(centre) < 0.2 * half:
        return 0.0, float(f"{max(-low, high):.3g}")
    digit = 10.0 ** (np.floor(np.log10(half)) - 2)
    return float(f"{round(centre / digit) * digit:.12g}"), float(f"{half:.3g}")


def _unit(unit: str, runs: Sequence[Run]) -> str:
    """The unit with those of the data in place of `[v]`; none where the data have none."""
    for name, own in runs[0].units.items():
        unit = unit.replace(f"[{name}]", own or "1")
    return "" if "[" in unit or unit == "1" else unit


# -- scores of all terms together --------------------------------------------------------------


def _wide(
    problem: Problem, point: Point, probe: Candidate, shapes: Sequence[Shape]
) -> tuple[Wide, list[Term]]:
    """The slopes of the residual in the size of every term on every axis of the output."""
    model, base, signals = problem.model, problem.model.traced, list(problem.model.signals)
    symbols: dict[str, Any] = {s.name: base.symbols[s.name] for s in signals}
    slope, _, _ = _slope(probe, model, symbols)
    for v in {v.name: v for shape in shapes for v in shape.variables}.values():
        if v.name not in symbols and v.name not in model.quantities:
            symbols[v.name] = ca.SX.sym(v.name)
            signals.append(Signal(v.name, 1, None))
    axes = slope.size2()
    terms = [Term(s, j if axes > 1 else None) for s in shapes for j in range(axes)]
    columns = [
        slope[:, term.axis or 0] * term.shape.expression(_read(term.shape, model, symbols))
        for term in terms
    ]
    sample = ca.vertcat(*[flat(symbols[s.name]) for s in signals])
    inputs = [ca.vertcat(base.coordinates, base.references), sample]
    outputs = [ca.densify(ca.horzcat(*columns))]
    function = ca.Function("slopes", inputs, outputs, ["parameters", "sample"], ["G"])
    n, own = problem.unknowns, np.arange(len(terms))
    places = ((n + own,) * len(problem.runs),)
    width = n + len(terms)
    return Wide(problem, point, Replay(function), tuple(signals), (own,), places, width), terms


def _read(shape: Shape, model: Model, symbols: Mapping[str, Any]) -> list[SX]:
    """What it reads, in the model's symbols."""
    found = []
    for v in shape.variables:
        known = model.quantities.get(v.name)
        value = symbols[v.name] if known is None or v.name in symbols else known.value
        found.append(value if v.index is None else value[v.index])
    return found


@dataclass(frozen=True)
class _Search:
    """Sums over batches of the declared columns, the first `declared`, and those of the terms."""

    sums: _Sums
    declared: int
    sigma: float
    count: int
    terms: Sequence[Term]

    def half(self, kept: NDArray[np.int_]) -> _Search:
        """The same of some of the batches."""
        s = self.sums
        some = replace(s, matrices=s.matrices[kept], gradients=s.gradients[kept])
        return replace(self, sums=some, count=self.count * len(kept) // len(s.gradients))

    def select(self, limit: float, most: int) -> list[int]:
        """Terms one by one, each significant beside those before it, the strongest first."""
        chosen: list[int] = []
        while len(chosen) < most:
            strength, p = self._scores(chosen)
            strength = np.where(p <= limit, strength, -1.0)
            best = int(np.argmax(strength))
            if strength[best] < 0:
                break
            chosen.append(best)
        return chosen

    def _scores(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Gain over inflation and p-value of each term beside the chosen ones.

        As `score.scores`, for many candidates of one unknown each. Terms live in few batches, and
        there are many: the freedom of the inflation is no more than the number of batches.
        """
        n = self.declared
        d = np.concatenate([np.arange(n), n + np.asarray(chosen, dtype=int)])
        f = n + np.arange(len(self.terms))
        B, g = self.sums.matrices, self.sums.gradients
        A = B.sum(axis=0)
        absorbed = np.linalg.pinv(A[np.ix_(d, d)], rcond=1e-10, hermitian=True) @ A[np.ix_(d, f)]
        whole = np.diag(A)[f]
        left = whole - np.sum(A[np.ix_(d, f)] * absorbed, axis=0)
        alive = left > LEFT * np.maximum(whole, 1e-12)
        left = np.where(alive, left, 1.0)
        whitened = (g[:, f] - g[:, d] @ absorbed) / np.sqrt(left) / self.sigma
        cross = B[:, d[:, None], f]
        inner = np.einsum("bdf,df->bf", B[:, d[:, None], d] @ absorbed - 2 * cross, absorbed)
        share = np.clip((np.einsum("bii->bi", B)[:, f] + inner) / left, 0.0, 1.0)
        total = whitened.sum(axis=0)
        noise = (whitened - share * total) / np.sqrt(np.clip(1 - share, LEAST_LEFT, None))
        inflation = np.maximum(np.sum(noise**2, axis=0), 1.0)
        effective = 1 / np.maximum(np.sum(share**2, axis=0), 1e-12)
        second = np.maximum(np.minimum(self.count - len(d) - 1, effective), 1.0)
        strength = np.where(alive, total**2 / inflation, 0.0)
        return strength, np.where(alive, fdtrc(1, second, strength), 1.0)


def _stable(search: _Search, chosen: list[int]) -> list[int]:
    """Those that most half-samples choose again: them, or others of the same variables."""
    batches = len(search.sums.gradients)
    if not chosen or batches < 4:
        return []
    rng = np.random.default_rng(0)
    hits = np.zeros(len(chosen))
    for _ in range(HALVES):
        kept = np.sort(rng.permutation(batches)[: batches // 2])
        again = search.half(kept).select(AGAIN, len(chosen))
        read = {search.terms[k].reads for k in again}
        hits += [search.terms[k].reads in read for k in chosen]
    return [k for k, hit in zip(chosen, hits, strict=True) if hit >= STABLE * HALVES]
