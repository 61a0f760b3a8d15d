"""Which values of an unknown are worth a start: from the model's structure and what the data span.

What a function of its own scale (a sine, an exponential) takes must move by LEAST over the record
at least, and by no more than half a turn between neighbouring rows (Nyquist). What is added to a
term of the samples, a place or a threshold, lies where that term lies. Bounds are kept.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from casest.declaration.shapes import Array
from casest.leastsquares.neighbours import inputs
from casest.leastsquares.problem import Point, Problem
from casest.solve.arguments import Node, arguments_of

#: An argument that moves by less than this over the record bends nothing.
LEAST = 0.1
#: Neighbouring rows and others that are looked at.
PAIRS = 150
#: Sizes of an unknown that are tried for its reach: every unit is somebody's.
NEXT = 10**0.25
SIZES = NEXT ** np.arange(-60.0, 61.0)
#: Where nothing says how large an unknown is: this many times its start, up and down.
AROUND = 1e3


class Piece(NamedTuple):
    """Values between `low` and `high`, evenly, or by their size (`log`) with a sign."""

    low: float
    high: float
    log: bool = False
    sign: float = 1.0

    def at(self, share: Array) -> Array:
        """The values at shares from 0 to 1 of the way."""
        if self.log:
            return self.sign * self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share

    def within(self, lower: float, upper: float) -> Piece | None:
        """What of it lies within bounds."""
        if self.log:
            near, far = sorted((self.sign * lower, self.sign * upper))
            low, high = max(self.low, near), min(self.high, far)
        else:
            low, high = max(self.low, lower), min(self.high, upper)
        return self._replace(low=low, high=high) if low < high else None


def reach(problem: Problem, start: Point, unknowns: list[int]) -> dict[int, tuple[Piece, ...]]:
    """For every one of these unknowns the pieces of its axis that are worth a start."""
    lower, upper = problem.bounds
    found: dict[int, list[Piece]] = {j: [] for j in unknowns}
    for r in range(len(problem.runs)):
        own, _ = problem.seen(r)
        for k, j in enumerate(own):
            if j in found and not found[j]:
                found[j] = list(_of_one(problem, start, r, k))
    pieces = {}
    for j, own_pieces in found.items():
        inside = [p.within(lower[j], upper[j]) for p in own_pieces]
        kept = [p for p in inside if p is not None]
        pieces[j] = tuple(kept or _nothing_known(float(start.x[j]), lower[j], upper[j]))
    return pieces


def neighbouring(problem: Problem) -> list[tuple[Any, Any]]:
    """Of every run some rows, and pairs of neighbours among them (their places)."""
    return [_rows(inputs(problem.model, samples.dense)) for samples in problem.samples]


def turning(problem: Problem, point: Point, near: list[tuple[Any, Any]]) -> float:
    """How far sines' arguments turn between neighbouring rows, in half turns: 1 is Nyquist's limit.

    The median of the rows; the fastest argument. Zero where there is none.
    """
    arguments, fastest = arguments_of(problem.model), 0.0
    places = [n.argument for n in arguments.nodes if n.periodic and n.place is None]
    for r, (rows, pairs) in enumerate(near if places else ()):
        samples = np.column_stack([c[rows] for c in problem.samples[r].columns])
        u = arguments.replay(problem.parameters(point, r), samples)[0][:, places, 0]
        steps = np.median(np.abs(u[pairs[:, 0]] - u[pairs[:, 1]]), axis=0) / np.pi
        fastest = max(fastest, float(np.max(np.where(np.isfinite(steps), steps, np.inf))))
    return fastest


def periodic_arguments(problem: Problem, point: Point) -> list[tuple[int, Array]]:
    """Unknowns that a sine's argument is a line in, each with its slope in all rows that see it."""
    arguments, slopes = arguments_of(problem.model), dict[int, list[Array]]()
    for r, samples in enumerate(problem.samples):
        own, parameters = problem.seen(r)[0], problem.parameters(point, r)
        for node in arguments.nodes:
            for k in node.unknowns if node.periodic and node.place is None else ():
                three = []
                for value in (-1.0, 0.0, 1.0):
                    parameters[k] = value
                    three.append(arguments.replay(parameters, samples)[0][:, node.argument, 0])
                parameters[k] = point.x[own[k]]
                slope = three[2] - three[1]
                if np.allclose(slope, three[1] - three[0], rtol=1e-9, atol=1e-300):
                    slopes.setdefault(int(own[k]), []).append(slope)
    return [(j, np.concatenate(each)) for j, each in slopes.items()]


def _nothing_known(start: float, lower: float, upper: float) -> list[Piece]:
    if np.isfinite(lower) and np.isfinite(upper):
        return [Piece(lower, upper)]
    size = abs(start) or 1.0
    both = [Piece(size / AROUND, size * AROUND, True, sign) for sign in (1.0, -1.0)]
    kept = [p.within(lower, upper) for p in both]
    return [p for p in kept if p is not None] or [Piece(start, start + size)]


def _of_one(problem: Problem, start: Point, r: int, k: int) -> list[Piece]:
    """Pieces for unknown k, in model order, of what one run sees."""
    arguments = arguments_of(problem.model)
    concerned = [node for node in arguments.nodes if k in node.unknowns]
    if not concerned:
        return []
    samples = problem.samples[r].dense
    rows, pairs = _rows(inputs(problem.model, samples))
    values = _values(problem, start, r, k, samples[rows])
    begin, found = float(start.x[problem.seen(r)[0][k]]), []
    for node in concerned:
        if node.place is None:
            found += _of_rate(values[:, :, node.argument], pairs, node.periodic, begin)
        else:
            found += _of_place(values, node, len(rows), begin)
    return list(dict.fromkeys(found))


def _sizes() -> Array:
    """Values of one unknown at which all nodes are looked at; the first three say if it is a
    line."""
    return np.concatenate([[0.0, 1.0, 2.0], SIZES, -SIZES])


def _values(problem: Problem, start: Point, r: int, k: int, samples: Array) -> Array:
    """All nodes' values, (sizes and the start, rows, nodes), with the other unknowns at the
    start."""
    replay, parameters = arguments_of(problem.model).replay, problem.parameters(start, r)
    tables = []
    for size in [*_sizes(), parameters[k]]:
        parameters[k] = size
        tables.append(replay(parameters, samples)[0][:, :, 0])
    return np.array(tables)


def _of_rate(u: Array, pairs: Any, periodic: bool, start: float) -> list[Piece]:
    """Sizes at which an argument moves enough over the record, and not too fast between rows."""
    u = u[3:-1]
    span = u.max(axis=1) - u.min(axis=1)
    steps = np.quantile(np.abs(u[:, pairs[:, 0]] - u[:, pairs[:, 1]]), 0.5 if periodic else 0.1, 1)
    ways: list[Piece] = []
    signs = (1.0, -1.0) if start >= 0 else (-1.0, 1.0)
    for sign in signs:
        half = slice(0, len(SIZES)) if sign > 0 else slice(len(SIZES), None)
        good = (span[half] >= LEAST) & (steps[half] <= np.pi)
        # What the argument does without this unknown, or rounds to, is no measure of it.
        moved = np.abs(np.gradient(span[half], np.log(SIZES))) > 1e-3 * span[half]
        moved &= span[half] > 1e-9 * np.abs(u[half]).max(axis=1)
        sizes = SIZES[good & moved]
        if len(sizes) < 2:
            continue
        # To the next size: the limits lie between two.
        low, high = float(sizes[0] / NEXT), float(sizes[-1] * NEXT)
        if periodic:
            ways.append(Piece(min(sign * low, sign * high), max(sign * low, sign * high)))
        if not periodic or sign == signs[0]:
            ways.append(Piece(low, high, True, sign))
    return ways


def _of_place(values: Array, node: Node, rows: int, start: float) -> list[Piece]:
    """Where an added term meets that of the samples, evenly and by size."""
    term, own = values[-1, :, node.argument], values[:3, 0, node.place]
    slope, bent = own[1] - own[0], own[2] - 2 * own[1] + own[0]
    span = float(term.max() - term.min())
    if not (np.isfinite(span) and span > 0 and abs(slope) > 0) or abs(bent) > 1e-9 * abs(slope):
        return []
    if node.periodic:
        turn = np.pi / abs(slope)
        return [Piece(start - turn, start + turn)]
    ends = sorted((t - own[0]) / slope for t in (term.min(), term.max()))
    size = span / abs(slope)
    found = [Piece(ends[0] - 0.1 * size, ends[1] + 0.1 * size)]
    return [*found, *(Piece(size / rows / 10, 3 * size, True, sign) for sign in (1.0, -1.0))]


def _rows(x: Array) -> tuple[Any, Any]:
    """Some rows, and pairs of neighbours among them (their places)."""
    distinct = np.unique(x, axis=0, return_index=True)[1]
    if len(distinct) < 3:
        distinct = np.arange(len(x))
    if x.shape[1] == 1:
        near = np.column_stack([distinct[:-1], distinct[1:]])
    else:
        from scipy.spatial import cKDTree

        nearest = np.asarray(cKDTree(x[distinct]).query(x[distinct], 2)[1])[:, 1]
        near = np.column_stack([distinct, distinct[nearest]])
    chosen = near[np.unique(np.linspace(0, len(near) - 1, min(len(near), PAIRS)).astype(int))]
    ends = np.concatenate([x.argmin(axis=0), x.argmax(axis=0)])
    rows, places = np.unique(np.concatenate([chosen.ravel(), ends]), return_inverse=True)
    return rows, places[: chosen.size].reshape(-1, 2)
