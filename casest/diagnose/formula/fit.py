"""Outside the catalogue: a formula of few terms in what is recorded.

Terms may read columns, time, the quantities of the model, and products of two. Which of them a
residual asks for is told by `matching_pursuit`; then the formula has to pass what any effect of the
catalogue has to: a certificate, and the error on held-out data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.effect import effect
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array, each
from casest.declaration.symbols import Signal, param
from casest.declaration.tracing import flat
from casest.diagnose.candidates.candidates import Candidate, usable_columns
from casest.diagnose.candidates.score_test import Score, scores, slope_of, widened
from casest.diagnose.formula.matching_pursuit import Chosen, Rows, matching_pursuit
from casest.diagnose.formula.terms import Shape, Term, Variable, formula_effect, library
from casest.diagnose.levels import CLIPPED, PIECE
from casest.diagnose.misfit.dependence import slow_shapes
from casest.diagnose.misfit.lack_of_fit import State, independent, state_of
from casest.diagnose.noise.noise_model import MIDDLE
from casest.diagnose.selection.acceptance import accepted
from casest.diagnose.selection.found import Found, Undecided
from casest.diagnose.selection.model_evidence import SMALL, Fitted, by_evidence
from casest.diagnose.selection.random_walk import is_random_walk
from casest.diagnose.selection.refit import joined
from casest.diagnose.selection.state import Work
from casest.effects.placing import placed_in
from casest.engine import Columns, Replay
from casest.errors import CasestError
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import robust_scale

#: Searches: with other batches, or beside a wander.
ATTEMPTS = 4
#: The name of the effect, and the terms from which on it gets no more.
NAME, TERMS = "formula", 9
#: Columns, and quantities, that correlate so nearly perfectly are one.
COPY, ALMOST = 1e-4, 1e-2
#: An angle that goes round more than this (rad) is a clock, but for its sine.
ROUND = 2.2 * np.pi


@effect(on="output")
def _probe(y: SX, *, k: SX = param(each, "[y]")) -> SX:
    """A shift of each axis: the slope of every term is its value times this one's."""
    return y + k


def try_formula(work: Work, current: Fitted) -> Fitted | None:
    """The model with a formula, if the residual asks for one and held-out data confirm it.

    A formula that is there already gets more terms.
    """
    sought = _sought(work, current)
    if sought is None:
        return None
    score, fitted = sought
    fitted, replaced = _alone(work, fitted)
    return _kept(work, current, score, fitted, replaced)


def formula_instead(
    work: Work, declared: Fitted, current: Fitted, complete: Callable[[Fitted], bool]
) -> Fitted | None:
    """The declared model with one formula, if that is clearly better than what was added to it.

    A course over temperature that no effect has can look like a slope and then a step in time.
    Beside a formula it is enough that they are not clearly better than another one alone; or, if
    one of them follows time, that this one is `complete`: that nothing else would be added to it.
    """
    replaced = [f for f in work.found if f.score is not None and f.names]
    beside = bool(_terms(current.model))
    if len(replaced) < 2 if beside else not any(f.candidate.column for f in replaced):
        return None
    sought = _sought(work, declared)
    if sought is None or all(_has_a_name(t, declared.model) for t in _terms(sought[1].model)):
        return None
    crossed = work.crossed(sought[1])
    if crossed is None or (beside and crossed.unknowns > current.unknowns):
        return None
    timed = any(_follows_time(f.candidate) for f in replaced)
    if beside and work.confirmed(crossed, current) and not (timed and complete(crossed)):
        return None
    if not beside and not work.confirmed(current, crossed):
        return None
    return _kept(work, declared, sought[0], crossed, replaced)


def _follows_time(candidate: Candidate) -> bool:
    """Is it an effect of the catalogue that a moment or the time decides?"""
    if candidate.effect is None or candidate.label == NAME:
        return False
    return any(s.name == "t" for s in candidate.effect.extras)


def _has_a_name(term: Term, model: Model) -> bool:
    """Is it an effect of the catalogue: an offset or a gain that follows a column?"""
    shape = term.shape
    if shape.kind == "product":
        return any(v.name in model.quantities for v in shape.variables)
    return (shape.kind, shape.order) == ("power", 1)


def _kept(
    work: Work, before: Fitted, score: Score, fitted: Fitted, replaced: Sequence[Found]
) -> Fitted | None:
    """The fit with the formula in the place of these effects, if it is accepted."""
    passed = accepted(work, before, score, fitted)
    if passed is None:
        return None
    share = passed[2] / passed[0].noise ** 2
    rival = _better_untrusted(work, score, passed[0])
    if rival:
        work.refuse(score.candidate, f"{rival} explains more, though its fit is refused")
        work.undecided = Undecided((rival, NAME), share)
        return None
    if share < SMALL and not replaced and not _terms(before.model):
        work.refuse(score.candidate, "so small a course may as well have another shape")
        work.undecided = Undecided((score.candidate.label,), share)
        return None
    work.found = [f for f in work.found if f not in replaced and f.candidate.label != NAME]
    for found in replaced:
        if found.candidate.label != NAME:
            work.refuse(found.candidate, "no longer needed beside the formula")
    better, candidate, gained = passed
    better, candidate = _with_sizes(better, candidate)
    work.keep(better, candidate, gained, score, {})
    return better


def _better_untrusted(work: Work, score: Score, fitted: Fitted) -> str:
    """What has more evidence than a formula, but a fit that is refused: its label, if any."""
    tried = by_evidence([(score, fitted), *work.untrusted])
    return "" if tried[0][1] is fitted else tried[0][0].candidate.label


def _sought(work: Work, current: Fitted) -> tuple[Score, Fitted] | None:
    """The formula that the residual asks for, fitted; its score."""
    library, known = _Library.of(work, current), _terms(current.model)
    if library is None or len(known) >= TERMS:
        return None
    # What is missing makes neighbours alike: how alike noise makes them, is seen without it.
    batches, wander = independent(library.state, 0.0), False
    for _ in range(ATTEMPTS):
        chosen = library.search(batches, wander)
        tried = chosen and _tried(work, current, library.candidate(chosen, known), chosen)
        if not tried or chosen is None:
            return None
        score, fitted = tried
        enough = library.independent_after(fitted)
        if sum(map(len, enough)) < sum(map(len, batches)):
            batches = enough
        elif not wander and is_random_walk(work.runs, current, fitted, chosen.score):
            wander = True
        else:
            break
    else:
        return None
    return score, fitted


def _terms(model: Model) -> tuple[Term, ...]:
    """Those of the formula that the model has."""
    own = [a.effect.function for a in model.effects if a.label == NAME]
    return getattr(own[0], "terms", ()) if own else ()


def _alone(work: Work, fitted: Fitted) -> tuple[Fitted, list[Found]]:
    """Without the effects that only stood for what the formula says; and those."""
    replaced = []
    for found in work.found:
        label = found.candidate.label
        if found.score is None or not found.names or found.candidate.freed or label == NAME:
            continue
        without = work.crossed(work.fitted(*fitted.without(label)))
        whole = work.crossed(fitted)
        if without is not None and (whole is None or not work.confirmed(without, whole)):
            fitted = without
            replaced.append(found)
    return fitted, replaced


def _tried(
    work: Work, current: Fitted, candidate: Candidate, chosen: Chosen
) -> tuple[Score, Fitted] | None:
    """The model refitted with the formula, in place of one that it has; the score."""
    work.original[candidate.label] = candidate
    model, values = current.without(NAME)
    wide = widened(model, work.runs, values, [candidate])
    (score,) = scores(wide, [candidate], current.noise, work.folds.batches)
    score = replace(score, p_value=min(1.0, chosen.score.p_value * candidate.trials))
    fitted = joined(work, replace(current, model=model, values=values), score)
    return None if fitted is None else (score, fitted)


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


@dataclass(frozen=True)
class _Library:
    """All shapes for one model and its record, and what evaluates them.

    `values` computes the residual's slope in a shift of the output (m, axes) and what the shapes
    read, one row for each variable, one column for each axis.
    """

    state: State
    on: str
    unit: str
    variables: tuple[Variable, ...]
    shapes: tuple[Shape, ...]
    values: Replay
    signals: tuple[Signal, ...]
    size: int

    @classmethod
    def of(cls, work: Work, current: Fitted) -> _Library | None:
        """None where there is no output that anything could be added to, or nothing to read."""
        problem = Problem(current.model, work.runs)
        if problem.sequential:
            return None
        state = state_of(problem, problem.point(current.values), work.folds.batches)
        try:
            probe = Candidate(placed_in(_probe, current.model))
            return _library(state, probe)
        except CasestError:
            return None

    def independent_after(self, fitted: Fitted) -> tuple[NDArray[np.int_], ...]:
        """First samples of batches that are independent in what a formula leaves."""
        return independent(replace(self.state, residuals=fitted.residuals, sigma=fitted.noise))

    def search(self, batches: Sequence[NDArray[np.int_]], wander: bool) -> Chosen | None:
        """What the residual asks for; beside what a wander may have done, or not."""
        problem = self.state.problem
        slow = slow_shapes(problem.runs, MIDDLE) if wander else None
        axes = len(problem.model.axes)
        unknowns = problem.unknowns + (MIDDLE * axes if wander else 0)

        def rows(shapes: Sequence[int]) -> Iterator[Rows]:
            return self._rows([self.shapes[k] for k in shapes], batches, slow)

        reads = [shape.reads for shape in self.shapes]
        count = sum(map(len, batches))
        return matching_pursuit(
            rows, unknowns, self.size, reads, self.state.sigma, problem.residual_count, count
        )

    def _rows(
        self,
        shapes: Sequence[Shape],
        batches: Sequence[NDArray[np.int_]],
        slow: Sequence[Array] | None,
    ) -> Iterator[Rows]:
        problem, limit = self.state.problem, self._limit()
        numbers = {v: k for k, v in enumerate(self.variables)}
        offsets = np.cumsum([0, *map(len, batches)])
        for block in problem.blocks(self.state.point):
            r, run = block.run, problem.runs[block.run]
            samples = Columns([run.signals[s.name] for s in self.signals])
            parameters = problem.parameters(self.state.point, r)
            for start in range(block.span.start, block.span.stop, PIECE):
                span = slice(start, min(start + PIECE, block.span.stop))
                local = slice(span.start - block.span.start, span.stop - block.span.start)
                slope, X = self.values(parameters, samples[span])
                read = [[X[:, numbers[v]] for v in s.variables] for s in shapes]
                B = np.stack([s.values(x) for s, x in zip(shapes, read, strict=True)], axis=1)
                J, residual = block.jacobian[local], np.clip(block.residual[local], -limit, limit)
                place = block.x
                if slow is not None:
                    J, place = _beside(J, place, slow[r][span], problem.unknowns)
                if problem.weights is not None:
                    root = np.sqrt(problem.weights[r][span])
                    J, residual = J * root[:, :, None], residual * root
                    slope = slope * root[:, :, None]
                G = slope[:, :, None, :] * np.nan_to_num(B)[:, None, :, :]
                number = np.searchsorted(batches[r], np.arange(span.start, span.stop), "right") - 1
                yield place, np.nan_to_num(J), G, residual, offsets[r] + np.maximum(number, 0)

    def _limit(self) -> Array:
        """What a residual counts as at most, on each axis: one may be all misfit."""
        residuals = self.state.residuals
        own = [robust_scale([r[:, [a]] for r in residuals]) for a in range(residuals[0].shape[1])]
        return np.asarray(CLIPPED * np.maximum(own, self.state.sigma))

    def candidate(self, chosen: Chosen, known: Sequence[Term]) -> Candidate:
        """The formula of the known terms and these shapes, null at k = 0."""
        terms = [*known] + [
            Term(self.shapes[k], int(axis) if self.size > 1 else None)
            for k, on in zip(chosen.shapes, chosen.axes, strict=True)
            for axis in on
        ]
        made = formula_effect(terms, self.size, self.on, self.unit)
        return Candidate(made, trials=len(self.shapes))


def _beside(
    J: Array, place: NDArray[np.int_], slow: Array, unknowns: int
) -> tuple[Array, NDArray[np.int_]]:
    """The Jacobian with slow shapes (N, k) of every axis of the residual after it."""
    axes, k = J.shape[1], slow.shape[1]
    more = np.zeros((len(J), axes, axes, k))
    for a in range(axes):
        more[:, a, a] = slow
    own = unknowns + np.arange(axes * k)
    return np.concatenate([J, more.reshape(len(J), axes, -1)], axis=2), np.append(place, own)


def _library(state: State, probe: Candidate) -> _Library | None:
    problem, model = state.problem, state.problem.model
    assert probe.effect is not None
    on, signals = probe.effect.on, list(model.signals)
    symbols: dict[str, Any] = {s.name: model.traced.symbols[s.name] for s in signals}
    slope, _, _ = slope_of(probe, model, symbols)
    size = int(slope.size2())
    rows = list(_readable(model, problem.runs, on, symbols, signals, size))
    if not rows:
        return None
    X = ca.vertcat(*[ca.repmat(x.T if x.numel() > 1 else x, 1, 1 if x.numel() > 1 else size)
                     for _, x in rows])  # fmt: skip
    sample = ca.vertcat(*[flat(symbols[s.name]) for s in signals])
    inputs = [ca.vertcat(model.traced.coordinates, model.traced.references), sample]
    outputs = [ca.densify(slope), ca.densify(X)]
    names = ["parameters", "sample"]
    values = Replay(ca.Function("shapes", inputs, outputs, names, ["slope", "X"]))
    seen = []
    for r, run in enumerate(problem.runs):
        samples = Columns([run.signals[s.name] for s in signals])
        seen.append(values(problem.parameters(state.point, r), samples)[1])
    columns = len([v for v, _ in rows if v.name not in model.quantities])
    variables = _scaled([v for v, _ in rows], columns, np.concatenate(seen))
    # Rows that are no variables of their own stay, so that the numbers fit.
    shapes = tuple(library([v for v in variables if v.half > 0]))
    if not shapes:
        return None
    unit = _unit(model.quantities[on].unit, problem.runs)
    return _Library(state, on, unit, tuple(variables), shapes, values, tuple(signals), size)


def _readable(
    model: Model,
    runs: Sequence[Run],
    on: str,
    symbols: dict[str, Any],
    signals: list[Signal],
    size: int,
) -> Iterator[tuple[Variable, SX]]:
    """Columns, time, and quantities declared no later than `on`, with their symbols."""
    names = usable_columns(model, runs)
    names += ["t"] if all("t" in run.signals for run in runs) else []
    for name in names:
        if name not in symbols:
            symbols[name] = ca.SX.sym(name)
            signals.append(Signal(name, 1, None))
        unit = "s" if name == "t" else runs[0].column_units.get(name) or ""
        yield Variable(name, None, unit, 0.0, 0.0), symbols[name]
    order, taken = list(model.quantities), {s.name for s in model.signals}
    for name in reversed(order[: order.index(on) + 1]):
        quantity = model.quantities[name]
        if name in taken or quantity.declared.size2() != 1:
            continue
        unit, value = _unit(quantity.unit, runs), quantity.value
        if value.numel() == size > 1:
            yield Variable(name, None, unit, 0.0, 0.0, own=True), value
        for i in range(value.numel()):
            index = i if value.numel() > 1 else None
            yield Variable(name, index, unit, 0.0, 0.0), value[i]


def _scaled(variables: Sequence[Variable], columns: int, X: Array) -> list[Variable]:
    """With centre and half width; half 0 for what is constant, not finite, or a copy.

    The first `columns` of them are columns of the record.
    """
    found, kept = [], list[tuple[bool, Array]]()
    for k, variable in enumerate(variables):
        x = X[:, k] if variable.own else X[:, k, :1]
        width = float(np.ptp(x, axis=0).max()) if np.all(np.isfinite(x)) else 0.0
        if not width > 1e-9 * float(np.abs(x).max(initial=1e-300)):
            found.append(variable)
            continue
        angle = variable.unit == "rad" and width > ROUND
        centred = x - x.mean(axis=0)
        centred /= np.maximum(np.linalg.norm(centred, axis=0), 1e-300)
        far = COPY if k < columns else ALMOST
        copies = (
            np.all(np.abs(np.sum(centred * o, axis=0)) > 1 - far)
            for own, o in kept
            if own == variable.own
        )
        if not angle and any(copies):  # an angle that grows with time still has its sine
            found.append(variable)
            continue
        kept.append((variable.own, centred))
        centre, half = _scale(x) if not variable.own else (0.0, float(f"{np.abs(x).max():.3g}"))
        found.append(replace(variable, centre=centre, half=half, angle=angle))
    return found


def _scale(x: Array) -> tuple[float, float]:
    """Mean and largest distance from it, in few digits; a mean near 0 is 0."""
    centre, half = float(x.mean()), float(np.abs(x - x.mean()).max())
    if abs(centre) < 0.2 * half:
        return 0.0, float(f"{np.abs(x).max():.3g}")
    digit = 10.0 ** (np.floor(np.log10(half)) - 2)
    return float(f"{round(centre / digit) * digit:.12g}"), float(f"{half:.3g}")


def _unit(unit: str, runs: Sequence[Run]) -> str:
    """The unit with those of the data in place of `[v]`; none where the data have none."""
    for name, own in runs[0].units.items():
        unit = unit.replace(f"[{name}]", own or "1")
    return "" if "[" in unit or unit == "1" else unit


__all__ = ["formula_instead", "try_formula"]
