"""Slopes of the residual in what a candidate would add, at its null value: no refit.

All candidates share the symbols of the model as it is, so that one evaluation serves many. What
acts on the sequence of samples is differentiated through its recursion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME
from casest.declaration.flow import Flow
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.declaration.tracing import Traced, flat
from casest.diagnose.candidates.candidates import Candidate
from casest.engine import Columns, Replay
from casest.errors import CasestError
from casest.leastsquares.problem import Point, Problem

Index = NDArray[np.int_]
#: Columns that are evaluated at once.
WIDEST = 120


def rows_of(runs: Sequence[Run], most: int) -> list[Index]:
    """Of each run the rows that are looked at: all, or evenly chosen ones of a long record."""
    every = -(-sum(map(len, runs)) // most)
    return [np.arange(0, len(run), every) for run in runs]


def slopes(
    problem: Problem, point: Point, found: Sequence[Candidate], rows: Sequence[Index]
) -> Iterator[tuple[Candidate, Array | CasestError]]:
    """Every candidate with its columns (N, m, k) in the rows of all runs; or why there are none.

    Per-run unknowns have columns of their own for each run.
    """
    axes = len(problem.model.axes)
    direct = [c for c in found if not (_sequential(c, problem) or _all_held(c, problem))]
    size = max(1, WIDEST // (3 * axes))
    given = [problem.given(point, r) for r in range(len(problem.runs))] if direct else []
    for k in range(0, len(direct), size):
        yield from _direct(problem, point, direct[k : k + size], rows, given)
    states = problem.followed(point) if len(direct) < len(found) else None
    for candidate in found:
        if candidate not in direct:
            try:
                yield candidate, _through_record(problem, point, candidate, rows, states)
            except CasestError as error:
                yield candidate, error


def _sequential(candidate: Candidate, problem: Problem) -> bool:
    """Does what it adds act on other samples than its own?

    It does if it looks at them itself, or changes what an effect of the model that does so takes.
    """
    if candidate.effect is not None and candidate.effect.kind in OVER_TIME:
        return True
    if not problem.sequential:
        return False
    if problem.model.resting:  # rests share what they are uncertain by
        return True
    try:
        extended = candidate.traced_on(problem.model)
    except CasestError:
        return False  # it is said why where its slope is asked for
    taken = ca.vertcat(*(stage.entered for stage in extended.staged.stages))
    places = _coordinates(extended)
    own = ca.vertcat(*(places[p.name] for p in candidate.parameters(extended)))
    return bool(ca.jacobian(taken, own).nnz())


def _all_held(candidate: Candidate, problem: Problem) -> bool:
    try:
        return candidate.all_held(problem.model)
    except CasestError:
        return False  # it is said why where its slope is asked for


def _moves_states(candidate: Candidate, extended: Model) -> bool:
    """Does it change what differential equations of the model follow?"""
    stages, places = extended.staged.stages, _coordinates(extended)
    entered = [stage.entered for stage in stages if isinstance(stage, Flow)]
    added = [
        s.given for s in stages if s.attached is not None and s.attached.label == candidate.label
    ]
    names = extended.unknowns_of(candidate.label) | {candidate.freed} & places.keys()
    own = [places[name] for name in names]
    return bool(ca.depends_on(ca.vertcat(*entered), ca.vertcat(ca.SX(0, 1), *own, *added)))


def _coordinates(model: Model) -> dict[str, SX]:
    """The coordinates of each parameter among those of the traced body."""
    place, found = 0, {}
    for p in model.parameters:
        found[p.name] = _traced(model).coordinates[place : place + p.shape.coordinates]
        place += p.shape.coordinates
    return found


def _traced(model: Model) -> Traced:
    """The body, with a symbol in the place of what effects on other samples give."""
    return model.staged if model.sequential else model.traced


def _direct(
    problem: Problem,
    point: Point,
    found: Sequence[Candidate],
    rows: Sequence[Index],
    given: Sequence[Array],
) -> Iterator[tuple[Candidate, Array | CasestError]]:
    """All at once; `given` (N, k) of each run: what the model's effects on other samples give."""
    model, kept = problem.model, list[Candidate]()
    slopes, scopes = list[Any](), list[NDArray[np.bool_]]()
    signals = list(model.columns)
    symbols = {s.name: _traced(model).symbols[s.name] for s in signals}
    for candidate in found:
        try:
            slope, scope, more = slope_of(candidate, model, symbols)
        except CasestError as error:
            yield candidate, error
            continue
        signals += more
        kept.append(candidate)
        slopes.append(slope)
        scopes.append(np.array(scope, bool))
    if not kept:
        return
    base = _traced(model)
    inputs = [
        ca.vertcat(base.coordinates, base.references),
        ca.vertcat(*[flat(symbols[s.name]) for s in signals], *(s.given for s in base.stages)),
    ]
    together = ca.densify(ca.horzcat(*slopes))
    replay = Replay(ca.Function("slopes", inputs, [together], ["parameters", "sample"], ["G"]))
    values = []
    for r, run in enumerate(problem.runs):
        samples = Columns([*(run.signals[s.name] for s in signals), given[r]])
        every = slice(None, None, rows[r][1] - rows[r][0]) if len(rows[r]) > 1 else slice(None)
        (G,) = replay(problem.parameters(point, r), samples[every])
        weight = None if problem.weights is None else problem.weights[r][rows[r]]
        values.append(np.nan_to_num(G if weight is None else G * np.sqrt(weight)[:, :, None]))
    place = 0
    for candidate, per_run in zip(kept, scopes, strict=True):
        own = slice(place, place + len(per_run))
        place = own.stop
        yield candidate, _side_by_side([v[:, :, own] for v in values], per_run)


def _side_by_side(parts: Sequence[Array], per_run: NDArray[np.bool_]) -> Array:
    """Columns of the runs below each other; those per run beside each other."""
    if len(parts) == 1 or not per_run.any():
        return np.concatenate(parts)
    own = int(per_run.sum())
    shared = int((~per_run).sum())
    found = np.zeros((sum(map(len, parts)), parts[0].shape[1], shared + own * len(parts)))
    row = 0
    for r, part in enumerate(parts):
        here = slice(row, row + len(part))
        found[here, :, :shared] = part[:, :, ~per_run]
        found[here, :, shared + r * own : shared + (r + 1) * own] = part[:, :, per_run]
        row = here.stop
    return found


def _through_record(
    problem: Problem,
    point: Point,
    candidate: Candidate,
    rows: Sequence[Index],
    states: tuple[Array, ...] | None,
) -> Array:
    """Columns of the candidate's own unknowns in the extended problem.

    `states` along the records are the same for what does not act on their rates.
    """
    extended = candidate.traced_on(problem.model)
    moves = states is None or _moves_states(candidate, extended)
    wide = Problem(
        extended,
        problem.runs,
        whitening=problem.whitening,
        states=None if moves else states,
    )
    begun, known = wide.values(wide.start()), dict(candidate.held)
    held = {f"{candidate.label}.{name}": value for name, value in known.items()}
    sizes = {n: np.full(np.shape(begun[n]), value) for n, value in held.items() if n in begun}
    at = wide.point({**begun, **problem.values(point), **sizes})
    own = candidate.parameters(extended)
    if not own:
        return _secant(problem, point, wide, at, candidate, rows)
    names = {p.name for p in own}
    parts = []
    for r, chosen in enumerate(rows):
        part = wide.columns(at, r, names)
        if candidate.effect is not None and candidate.effect.kind == "sequence":
            _as_the_next(part, problem.runs[r].block)
        part = part[chosen]
        if problem.weights is not None:
            part = part * np.sqrt(problem.weights[r][chosen])[:, :, None]
        parts.append(np.nan_to_num(part))
    per_run = [p.scope == "run" for p in own for _ in range(p.shape.coordinates)]
    return _side_by_side(parts, np.array(per_run, bool))


def _as_the_next(part: Array, block: Index) -> None:
    """The first row of each stretch like its second, in place.

    What an effect with a memory began from nobody recorded, and it begins at rest: where the input
    is already on its way that moves the first row alone, and one odd reading is no evidence.
    """
    first = np.flatnonzero(np.r_[True, block[1:] != block[:-1]][:-1])
    first = first[block[first] == block[first + 1]]
    part[first] = part[first + 1]


def _secant(
    problem: Problem,
    point: Point,
    wide: Problem,
    at: Point,
    candidate: Candidate,
    rows: Sequence[Index],
) -> Array:
    """What it changes where all of it is held, for each unit of that: a lag, or a time constant,
    may be longer than any slope reaches."""
    ((_, size),) = candidate.held
    pairs = zip(wide.residuals(at), problem.residuals(point), strict=True)
    changes = [(a - b) / size for a, b in pairs]
    if candidate.effect is not None and candidate.effect.kind == "sequence":
        for change, run in zip(changes, problem.runs, strict=True):
            _as_the_next(change, run.block)
    parts = [change[chosen] for change, chosen in zip(changes, rows, strict=True)]
    if problem.weights is not None:
        weights = zip(parts, problem.weights, rows, strict=True)
        parts = [part * np.sqrt(w[chosen]) for part, w, chosen in weights]
    return np.nan_to_num(np.concatenate(parts))[:, :, None]


def slope_of(
    candidate: Candidate, model: Model, symbols: dict[str, Any]
) -> tuple[Any, list[bool], list[Signal]]:
    """∂r/∂(its unknowns) at null in the model's symbols; which are per run; signals it adds."""
    extended = candidate.traced_on(model)
    traced, base = _traced(extended), _traced(model)
    held = {f"{candidate.label}.{name}": value for name, value in candidate.held}
    own = {p.name for p in candidate.parameters(extended)}
    if not own:
        raise CasestError(f"{candidate.label}: nothing of it is unknown, and it has no slope")
    more = [s for s in extended.columns if s.name not in symbols]
    for s in more:
        symbols[s.name] = ca.SX.sym(s.name, s.size)
    here, there = _coordinates(extended), _coordinates(model)
    mine, scopes, new = [], [], []
    for p in extended.parameters:
        if p.name in own:
            mine.append(here[p.name])
            scopes += [p.scope == "run"] * p.shape.coordinates
        start = p.start_value() if p.name in own else None
        if p.name in held:
            start = np.full(p.shape.coordinates, held[p.name])
        new.append(there[p.name] if start is None else ca.DM(start))
    slope = ca.jacobian(traced.expression, ca.vertcat(*mine))
    old = [traced.coordinates, traced.references]
    old += [stage.given for stage in traced.stages]
    old += [flat(traced.symbols[s.name]) for s in extended.columns]
    new += [base.references, *(stage.given for stage in base.stages)]
    new += [flat(symbols[s.name]) for s in extended.columns]
    return ca.substitute(slope, ca.vertcat(*old), ca.vertcat(*new)), scopes, more
