"""The normal equations of one problem at many points at once.

A search asks for the cost at thousands of points of a small record: one call for all of them, with
the unknowns beside the signals, costs a hundredth of as many calls.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from casest.data.run import Index
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import function_of, sample_symbol
from casest.engine import Columns, Replay
from casest.engine.graph import Graph
from casest.engine.operations import BY_CODE
from casest.leastsquares.problem import Problem

#: Rows (points times samples) that are evaluated at once.
ROWS = 200_000
#: Models with more unknowns have theirs chosen one after the other, not as the largest set.
ALL_SETS = 10


class Normals(NamedTuple):
    """Costs (P,), slopes (P, k) and Gauss-Newton matrices (P, k, k) of P points."""

    cost: Array
    slope: Array
    matrix: Array

    def at(self, places: Any) -> Normals:
        """Those of some of the points."""
        return Normals(*(each[places] for each in self))

    def put(self, places: Any, others: Normals) -> None:
        """Others in their place."""
        for each, other in zip(self, others, strict=True):
            each[places] = other


def normals(problem: Problem, references: Array, x: Array, of: Index) -> Iterator[Normals]:
    """Costs (P,), slopes (P, k) and matrices (P, k, k) for the unknowns `of` (k,), in parts.

    x: (points, n). One tuple for every part of the points, in their order. Not weighted.
    """
    length = max(1, ROWS // max(len(run) for run in problem.runs))
    for start in range(0, len(x), length):
        yield _normals(problem, references, x[start : start + length], of)


def _normals(problem: Problem, references: Array, x: Array, of: Index) -> Normals:
    points, k = len(x), len(of)
    total, slope, matrix = np.zeros(points), np.zeros((points, k)), np.zeros((points, k, k))
    whole = np.zeros(problem.unknowns)
    for r, samples in enumerate(problem.samples):
        own, ref = problem.seen(r)
        wanted = [j for j, unknown in enumerate(own) if unknown in set(of.tolist())]
        place = np.array([np.flatnonzero(of == own[j])[0] for j in wanted], dtype=int)
        count = len(samples)
        every = [np.tile(column, points) for column in samples.dense.T]
        beside = Columns([*every, *(np.repeat(x[:, j], count) for j in own)])
        fixed = np.concatenate([references[ref], whole[:1]])
        found = _at_points(problem.model, tuple(wanted)).by_entry(fixed, beside)
        for axis, slopes in zip(*found, strict=True):
            residual = axis.reshape(points, count, 1)
            J = slopes.reshape(-1, points, count).transpose(1, 0, 2)
            total += 0.5 * np.einsum("pik,pik->p", residual, residual)
            slope[:, place] += (J @ residual)[:, :, 0]
            matrix[:, place[:, None], place] += J @ J.transpose(0, 2, 1)
    return Normals(total, slope, matrix)


@lru_cache(maxsize=64)
def _at_points(model: Model, columns: tuple[int, ...]) -> Replay:
    """r and those columns of its Jacobian, of (references and a nought, [sample, unknowns])."""
    t = model.traced
    J = ca.jacobian(t.expression, t.coordinates)[:, list(columns)]
    # Never empty, which Replay could not tell from a mistake.
    parameters = ca.vertcat(t.references, ca.SX.sym("none"))
    sample = ca.vertcat(sample_symbol(model), t.coordinates)
    function = ca.Function(
        "many", [parameters, sample], [t.expression, J], ["parameters", "sample"], ["r", "J"]
    )
    return Replay(function)


@lru_cache(maxsize=64)
def separable(model: Model) -> tuple[int, ...]:
    """The most unknowns (of one run) in which the residual is linear while the others are held.

    Golub & Pereyra 1973: those need not be searched for.
    """
    t = model.traced
    n, each = t.coordinates.numel(), ca.symvar(t.coordinates)
    J = ca.jacobian(t.expression, t.coordinates)
    # By what the derivative is written in, not by its value: an angle that is wrapped has a slope
    # of one everywhere, and is no line.
    bent = np.array([[ca.depends_on(J[:, j], x) for x in each] for j in range(n)], dtype=bool)
    bent |= bent.T
    broken = _broken(model)
    flat = [j for j in range(n) if not bent[j, j] and j not in broken]
    if len(flat) <= ALL_SETS:
        sets = (s for k in range(len(flat), 0, -1) for s in combinations(flat, k))
        return next((s for s in sets if not bent[np.ix_(s, s)].any()), ())
    chosen: list[int] = []
    for j in sorted(flat, key=lambda j: int(bent[j].sum())):
        if not bent[j, chosen].any():
            chosen.append(j)
    return tuple(sorted(chosen))


def _broken(model: Model) -> set[int]:
    """Unknowns that a function with corners or steps is asked of, whose slope does not show it."""
    graph = Graph(function_of(model, {"r": model.traced.expression}))
    count, found = model.traced.coordinates.numel(), set()
    for value in graph.values:
        if value.kind == "operation" and BY_CODE[value.code].broken:
            below = (graph.values[i] for i in graph.needed(value.operands))
            found |= {v.code for v in below if v.kind == "parameter" and v.code < count}
    return found
