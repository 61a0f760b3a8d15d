"""What a residual may depend on: time or order, columns, and the quantities of the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.noise import at_true
from casest.declaration.shapes import Array
from casest.declaration.tracing import function_of, reading_symbol, sample_symbol
from casest.engine import Replay
from casest.leastsquares.problem import Point, Problem


@dataclass(frozen=True)
class Variable:
    """Something that a residual may depend on: its values (N,) for each run.

    `turns`: an angle that goes round more than once; `clock`: it says when, and nothing else.
    """

    name: str
    values: tuple[Array, ...]
    turns: bool = False
    clock: bool = False


def variables(problem: Problem, point: Point, columns: Sequence[str]) -> list[Variable]:
    """Time (or order), the named columns, and the components of every quantity."""
    runs = problem.runs
    timed = all("t" in run.signals for run in runs)
    name = "time" if timed else "place in the record"
    when = Variable(name, tuple(_when(run, timed) for run in runs), clock=True)
    found = [Variable(n, tuple(run.signals[n][:, 0] for run in runs)) for n in columns]
    if not problem.sequential:
        found += _quantities(problem, point)
    # A table that was sorted by something says that, and not the place of its rows.
    return _distinct([when, *found] if timed else [*found, when])


def _when(run: Run, timed: bool) -> Array:
    return run.signals["t"][:, 0] if timed else np.arange(len(run), dtype=float)


def _quantities(problem: Problem, point: Point) -> Iterator[Variable]:
    """Components of the quantities, moved to where the residual would vanish.

    The noise of an implicit model's reading is in its quantities too, and would correlate.
    """
    traced, implicit = problem.model.traced, problem.model.implicit
    given = [s.name for s in problem.model.signals if s.name not in traced.readings]
    for quantity in traced.quantities.values():
        value = ca.vec(ca.SX(quantity.value))
        if not ca.depends_on(value, sample_symbol(problem.model)):
            continue
        if implicit:
            value = _consistent(problem, value)
        if problem.model.noise is not None:  # at true values the noise of inputs is no order
            value = at_true(traced, problem.model.noise, value)
        replay = Replay(function_of(problem.model, {"q": ca.densify(value)}))
        per_run = [
            replay(problem.parameters(point, r), s)[0][:, :, 0]
            for r, s in enumerate(problem.samples)
        ]
        for k in range(per_run[0].shape[1]):
            values = tuple(v[:, k] for v in per_run)
            own = quantity.name + (f"[{k}]" if per_run[0].shape[1] > 1 else "")
            name = next((n for n in given if _is_signal(problem, n, values)), own)
            turns = quantity.unit == "rad" and max(map(np.ptp, values)) > 2 * np.pi
            yield Variable(name, values, bool(turns))


def _is_signal(problem: Problem, name: str, values: Sequence[Array]) -> bool:
    """Is a component just what the user gave for this signal, whatever the model calls it?"""
    given = [run.signals[name] for run in problem.runs]
    both = list(zip(given, values, strict=True))
    return all(g.shape[1:] == (1,) and np.array_equal(g[:, 0], v) for g, v in both)


def _consistent(problem: Problem, value: Any) -> Any:
    """A quantity with the reading moved the shortest way to a vanishing residual.

    What effects read stays: a recorded current is not in error by what the reading is.
    """
    reading, residual = reading_symbol(problem.model), problem.model.traced.expression
    G = ca.jacobian(residual, reading)
    step = G.T @ ca.solve(G @ G.T, residual)
    return value - ca.jacobian(value, reading) @ step


def _distinct(found: Sequence[Variable]) -> list[Variable]:
    """Without what is constant, not finite, or the copy of another."""
    kept: list[Variable] = []
    seen: list[Array] = []
    for variable in found:
        x = np.concatenate(variable.values)
        if not np.all(np.isfinite(x)) or np.ptp(x) <= 1e-9 * max(np.abs(x).max(), 1e-300):
            continue
        x = (x - x.mean()) / np.ptp(x)  # first: the squares of 1e-300 are zero
        x /= np.linalg.norm(x)
        # An angle that time is a copy of still goes round.
        if variable.turns or all(abs(x @ other) < 0.9999 for other in seen):
            kept.append(variable)
        if not variable.turns:
            seen.append(x)
    return kept
