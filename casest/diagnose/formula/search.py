"""Outside the catalogue: a description of at most a few terms in what is recorded.

Terms may read columns, time, the quantities of the model, and products of two. A description names
no cause: it is tried beside the names, and stands only where it leads them by far.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.declaration.tracing import flat
from casest.diagnose.candidates.candidates import Candidate, usable_columns
from casest.diagnose.evidence.likelihood import Explained, Likelihood
from casest.diagnose.evidence.score import Evidence, Trial, judged, on_fewer_axes
from casest.diagnose.formula.terms import Shape, Term, Variable, formula_effect, library
from casest.diagnose.levels import LEVELS
from casest.engine import Columns, Replay
from casest.leastsquares.problem import Point, Problem

#: The name of the effect.
NAME = "formula"
#: Columns, and quantities, that correlate so nearly perfectly are one.
COPY, ALMOST = 1e-4, 1e-2
#: An angle that goes round more than this (rad) is a clock, but for its sine.
ROUND = 2.2 * np.pi
#: Of a shape's length what the fit and the shapes before it must leave.
NEW = 1e-4


@dataclass(frozen=True)
class Read:
    """What terms may read: variables with their values (N, axes or 1) in the rows looked at; what a
    shift of the output `on` does to the residual (N, m, axes)."""

    on: str
    unit: str
    slope: Array
    variables: tuple[Variable, ...]
    values: tuple[Array, ...]

    def columns(self, shape: Shape) -> Array:
        """Of a shape on every axis (N, m, axes)."""
        numbers = {v: k for k, v in enumerate(self.variables)}
        x = [self.values[numbers[v]] for v in shape.variables]
        return np.asarray(self.slope * np.nan_to_num(shape.values(x))[:, None, :])


def described(
    read: Read, likelihood: Likelihood, none: Explained, families: int
) -> Evidence | None:
    """The best description: terms are added while they are worth their price.

    None of the output alone: a bend of the response would stand for its gain and its offset, which
    would say nothing of the sensor any more. That there is one is said without it.
    """
    every = library([v for v in read.variables if v.half > 0])
    shapes = [s for s in every if {v.name for v in s.variables} != {read.on}]
    if not shapes:
        return None
    chosen, best = _pursued(read, shapes, likelihood, none), None
    for count in range(1, len(chosen) + 1):
        found = _judged(read, chosen[:count], likelihood, none, families, len(shapes))
        if found is not None and (best is None or found.score > best.score):
            best = found
    return best


def _pursued(
    read: Read, shapes: Sequence[Shape], likelihood: Likelihood, none: Explained
) -> list[Shape]:
    """Shapes in the order in which they explain most, each on all axes (orthogonal pursuit)."""
    root = 1 / np.sqrt(none.spectrum)
    Q = np.linalg.qr(likelihood.declared * root[:, None])[0]
    r = likelihood.residual * root
    r -= Q @ (Q.T @ r)
    Z = []
    for shape in shapes:
        flat = read.columns(shape)
        flat = flat / np.maximum(np.linalg.norm(flat, axis=(0, 1)), 1e-300)
        z = likelihood.by_frequency(flat) * root[:, None]
        size = np.sum(z**2, axis=0)
        z = z - Q @ (Q.T @ z)
        left = np.sum(z**2, axis=0)
        z[:, left < NEW * size] = 0
        Z.append(z / np.sqrt(np.where(left > 0, left, 1)))
    axes = Z[0].shape[1]
    A = np.concatenate(Z, axis=1)
    H, g = A.T @ A, A.T @ r
    price, chosen = float(np.log(len(r))), list[Shape]()
    for _ in range(LEVELS.terms):
        gains = [_gain(H, g, slice(k * axes, (k + 1) * axes), price) for k in range(len(shapes))]
        k = int(np.argmax(gains))
        if gains[k] <= 0 or shapes[k] in chosen:
            break
        chosen.append(shapes[k])
        s = slice(k * axes, (k + 1) * axes)
        C = H[:, s] @ np.linalg.pinv(H[s, s], rcond=NEW, hermitian=True)
        g, H = g - C @ g[s], H - C @ H[s, :]
    return chosen


def _gain(H: Array, g: Array, own: slice, price: float) -> float:
    values, vectors = np.linalg.eigh(H[own, own])
    kept = values > NEW
    if not kept.any():
        return 0.0
    return float(np.sum((vectors.T @ g[own])[kept] ** 2 / values[kept]) - price * kept.sum())


def _judged(
    read: Read, chosen: Sequence[Shape], likelihood: Likelihood, none: Explained, families: int,
    looked: int,
) -> Evidence | None:  # fmt: skip
    """Several terms together, on the axes where they are worth their price."""
    size = read.slope.shape[2]
    columns = np.concatenate([read.columns(s) for s in chosen], axis=2)
    axes = np.tile(np.arange(size), len(chosen))
    variants = float(looked) ** len(chosen)
    trial = Trial(_candidate(read, chosen, range(size)), NAME, columns, variants, axes)
    whole = judged([trial], likelihood, none, families=families)
    kept = on_fewer_axes(whole, likelihood) if whole is not None else None
    if whole is None or kept is None:
        return whole
    own = np.isin(axes, kept)
    less = Trial(_candidate(read, chosen, kept), NAME, columns[:, :, own], variants)
    found = judged([less], likelihood, none, start=whole.explained, families=families)
    return found if found is not None and found.score > whole.score else whole


def _candidate(read: Read, chosen: Sequence[Shape], axes: Sequence[int]) -> Candidate:
    size = read.slope.shape[2]
    terms = [Term(s, a if size > 1 else None) for s in chosen for a in axes]
    return Candidate(formula_effect(terms, size, read.on, read.unit))


def readable(problem: Problem, point: Point, slope: Array, on: str, rows: Sequence[Any]) -> Read:
    """What terms may read in these rows of a fit; `slope` (N, m, axes) of a shift of `on`."""
    model, size = problem.model, slope.shape[2]
    signals = list(model.signals)
    symbols: dict[str, Any] = {s.name: model.traced.symbols[s.name] for s in signals}
    found = list(_readable(model, problem.runs, on, symbols, signals, size))
    unit = _unit(model.quantities[on].unit, problem.runs)
    if not found:
        return Read(on, unit, slope, (), ())
    X = ca.vertcat(*[ca.repmat(x.T if x.numel() > 1 else x, 1, 1 if x.numel() > 1 else size)
                     for _, x in found])  # fmt: skip
    inputs = [
        ca.vertcat(model.traced.coordinates, model.traced.references),
        ca.vertcat(*[flat(symbols[s.name]) for s in signals]),
    ]
    replay = Replay(ca.Function("read", inputs, [ca.densify(X)], ["parameters", "sample"], ["X"]))
    seen = []
    for r, run in enumerate(problem.runs):
        samples = Columns([run.signals[s.name] for s in signals])
        seen.append(replay(problem.parameters(point, r), samples)[0][rows[r]])
    values = np.concatenate(seen)
    columns = len([v for v, _ in found if v.name not in model.quantities])
    variables = _scaled([v for v, _ in found], columns, values)
    return Read(on, unit, slope, tuple(variables), tuple(values[:, k] for k in range(len(found))))


def with_sizes(effect: Any, sizes: dict[str, float]) -> Any:
    """The formula with the fitted numbers in place of k1, k2, …"""
    text = effect.formula
    for name, size in sizes.items():
        unit = dict(effect.declarations)[name].unit
        text = text.replace(f"+= {name}·", f"+= {size:.3g}" + (f" {unit}·" if unit else "·"))
    return replace(effect, formula=text)


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
